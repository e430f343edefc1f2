#include "crash_states.h"

#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <utility>

namespace revisit::faults {
namespace {

[[noreturn]] void Fail(const std::string& message) {
  std::fprintf(stderr, "%s\n", message.c_str());
  std::abort();
}

bool EndsWith(const std::string& text, const std::string& end) {
  return text.size() >= end.size() &&
         text.compare(text.size() - end.size(), end.size(), end) == 0;
}

void WriteFile(const std::string& path, const std::string& content) {
  std::ofstream file(path, std::ios::binary);
  file.write(content.data(), static_cast<std::streamsize>(content.size()));
  file.close();
  if (!file) Fail("cannot write " + path);
}

std::size_t Below(Device::Random* random, std::size_t end) {
  return std::uniform_int_distribution<std::size_t>(0, end - 1)(*random);
}

bool Chance(Device::Random* random, double probability) {
  return std::bernoulli_distribution(probability)(*random);
}

std::string Garbage(Device::Random* random, std::size_t size) {
  std::string bytes(size, '\0');
  for (std::size_t i = 0; i < size; i += sizeof(std::uint64_t)) {
    const std::uint64_t word = (*random)();
    std::memcpy(&bytes[i], &word, std::min(sizeof(word), size - i));
  }
  return bytes;
}

}  // namespace

std::vector<Event> ReadRecording(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  std::vector<Event> events;
  EventHeader header;
  while (file.read(reinterpret_cast<char*>(&header), sizeof(header))) {
    Event event{header, std::string(header.name_bytes, '\0'),
                std::string(header.data_bytes, '\0')};
    file.read(event.name.data(), header.name_bytes);
    file.read(event.data.data(), header.data_bytes);
    if (!file) break;
    events.push_back(std::move(event));
  }
  if (!file.eof() || file.gcount() != 0 || events.empty() ||
      events.front().header.kind != EventKind::kRoot) {
    Fail(path + " is not a recording");
  }
  return events;
}

// How much of what was not flushed one state has.
struct Device::Draw {
  enum class Part { kAll, kNone, kFirst, kSome };
  std::size_t block_bytes;
  // Which of the blocks are there.
  Part part;
  double share;
  // Whether blocks that were not written may hold anything.
  bool has_garbage;
  // Which of the entries are there.
  Part entries;
};

bool Device::Inode::is_shared_memory() const { return EndsWith(name, "-shm"); }

std::size_t Device::Add(const Event& event, bool is_directory) {
  Inode inode;
  inode.name = event.name;
  inode.is_directory = is_directory;
  inodes_.push_back(std::move(inode));
  by_number_[event.header.inode] = inodes_.size() - 1;
  return inodes_.size() - 1;
}

void Device::ChangeEntry(std::uint64_t directory, EntryChange change) {
  change.event = events_;
  inodes_[by_number_.at(directory)].entry_changes.push_back(std::move(change));
}

void Device::Apply(const Event& event) {
  const EventHeader& header = event.header;
  switch (header.kind) {
    case EventKind::kRoot:
      Add(event, true);
      break;
    case EventKind::kBegin:
      for (Inode& inode : inodes_) Flush(&inode, events_);
      break;
    case EventKind::kMakeDirectory:
    case EventKind::kCreate:
      ChangeEntry(header.parent,
                  {0, Add(event, header.kind == EventKind::kMakeDirectory), "",
                   event.name});
      break;
    case EventKind::kLink:
      ChangeEntry(header.parent,
                  {0, by_number_.at(header.inode), "", event.name});
      break;
    case EventKind::kUnlink:
      ChangeEntry(header.parent,
                  {0, by_number_.at(header.inode), event.name, ""});
      break;
    case EventKind::kRename: {
      if (header.parent != header.target) Fail("renamed across directories");
      const std::size_t between = event.name.find('\0');
      const std::size_t inode = by_number_.at(header.inode);
      inodes_[inode].name = event.name.substr(between + 1);
      ChangeEntry(header.parent, {0, inode, event.name.substr(0, between),
                                  inodes_[inode].name});
      break;
    }
    case EventKind::kWrite:
    case EventKind::kTruncate:
      inodes_[by_number_.at(header.inode)].changes.push_back(
          {events_, header.kind == EventKind::kTruncate, header.offset,
           event.data});
      break;
    case EventKind::kSyncBegin:
      syncs_[header.thread] = {by_number_.at(header.inode), events_};
      break;
    case EventKind::kSyncEnd: {
      const Sync& sync = syncs_.at(header.thread);
      Inode& inode = inodes_[sync.inode];
      const bool is_honoured =
          dishonoured_.empty() ||
          (inode.is_directory ? dishonoured_ != "/"
                              : !EndsWith(inode.name, dishonoured_));
      if (is_honoured) Flush(&inode, sync.begin);
      break;
    }
    case EventKind::kMapped:
      Apply({0, false, header.offset, event.data},
            &inodes_[by_number_.at(header.inode)].mapped);
      break;
  }
  ++events_;
}

void Device::Flush(Inode* inode, std::size_t before) {
  auto change = inode->changes.begin();
  for (; change != inode->changes.end() && change->event < before; ++change) {
    Apply(*change, &inode->content);
  }
  inode->changes.erase(inode->changes.begin(), change);
  auto entry = inode->entry_changes.begin();
  for (; entry != inode->entry_changes.end() && entry->event < before;
       ++entry) {
    Apply(*entry, &inode->entries);
  }
  inode->entry_changes.erase(inode->entry_changes.begin(), entry);
}

void Device::Apply(const Change& change, std::string* content) {
  if (change.is_size) {
    content->resize(change.offset);
    return;
  }
  if (content->size() < change.offset + change.data.size()) {
    content->resize(change.offset + change.data.size());
  }
  content->replace(change.offset, change.data.size(), change.data);
}

void Device::Apply(const EntryChange& change,
                   std::map<std::string, std::size_t>* entries) {
  if (!change.from.empty()) {
    const auto found = entries->find(change.from);
    if (found != entries->end() && found->second == change.inode) {
      entries->erase(found);
    }
  }
  if (!change.to.empty()) (*entries)[change.to] = change.inode;
}

std::string Device::DrawContent(const Inode& inode, const Draw& draw,
                                Random* random) {
  if (inode.is_shared_memory()) {
    switch (Below(random, 3)) {
      case 0:
        return inode.mapped;
      case 1:
        return std::string(inode.mapped.size(), '\0');
      default:
        return Garbage(random, Below(random, 65536));
    }
  }
  const std::vector<Change>& changes = inode.changes;
  // How many of the changes the size is of.
  const auto draw_moment = [&]() -> std::size_t {
    switch (draw.part) {
      case Draw::Part::kAll:
        return changes.size();
      case Draw::Part::kNone:
        return 0;
      default:
        return Chance(random, draw.share) ? changes.size()
                                          : Below(random, changes.size() + 1);
    }
  };
  const std::size_t sized = draw_moment();

  struct Block {
    std::size_t moment;
    bool is_written = false;
  };
  std::map<std::uint64_t, Block> blocks;
  std::string content = inode.content;
  std::uint64_t size = content.size();
  for (std::size_t i = 0; i < changes.size(); ++i) {
    const Change& change = changes[i];
    if (change.is_size) {
      // Freed blocks are not written to, and new ones not of this file, unless
      // the truncation got to the device.
      if (i >= sized && change.offset < size) break;
      if (i < sized) {
        size = change.offset;
        if (size < content.size()) content.resize(size);
      }
      continue;
    }
    const std::uint64_t end = change.offset + change.data.size();
    if (i < sized) size = std::max(size, end);
    std::uint64_t at = change.offset;
    while (at < end) {
      const std::uint64_t number = at / draw.block_bytes;
      const std::uint64_t next = std::min(end, (number + 1) * draw.block_bytes);
      auto found = blocks.find(number);
      if (found == blocks.end()) {
        const std::size_t moment =
            draw.part == Draw::Part::kFirst ? sized : draw_moment();
        found = blocks.emplace(number, Block{moment}).first;
      }
      if (i < found->second.moment) {
        found->second.is_written = true;
        if (content.size() < next) content.resize(next);
        content.replace(at, next - at, change.data, at - change.offset,
                        next - at);
      }
      at = next;
    }
  }
  content.resize(size);
  if (draw.has_garbage) {
    for (const auto& [number, block] : blocks) {
      const std::uint64_t begin = number * draw.block_bytes;
      if (block.is_written || begin < inode.content.size() || begin >= size) {
        continue;
      }
      const std::uint64_t bytes =
          std::min<std::uint64_t>(draw.block_bytes, size - begin);
      content.replace(begin, bytes, Garbage(random, bytes));
    }
  }
  return content;
}

void Device::WriteDirectory(const Inode& directory, const Draw& draw,
                            Random* random, const std::string& path) const {
  std::map<std::string, std::size_t> entries = directory.entries;
  const std::size_t changes = directory.entry_changes.size();
  const std::size_t first = Below(random, changes + 1);
  for (std::size_t i = 0; i < changes; ++i) {
    const bool is_kept =
        draw.entries == Draw::Part::kAll ||
        (draw.entries == Draw::Part::kFirst && i < first) ||
        (draw.entries == Draw::Part::kSome && Chance(random, draw.share));
    if (is_kept) Apply(directory.entry_changes[i], &entries);
  }
  std::filesystem::create_directories(path);
  for (const auto& [name, number] : entries) {
    const Inode& inode = inodes_[number];
    if (inode.is_directory) {
      WriteDirectory(inode, draw, random, path + "/" + name);
    } else if (!inode.is_shared_memory() || Chance(random, 0.7)) {
      WriteFile(path + "/" + name, DrawContent(inode, draw, random));
    }
  }
}

void Device::WriteState(Random random, const std::string& directory) const {
  constexpr Draw::Part kParts[] = {Draw::Part::kAll,   Draw::Part::kNone,
                                   Draw::Part::kFirst, Draw::Part::kSome,
                                   Draw::Part::kSome,  Draw::Part::kSome};
  Draw draw;
  draw.block_bytes = Chance(&random, 0.5) ? 512 : 4096;
  draw.part = kParts[Below(&random, 6)];
  draw.share = std::uniform_real_distribution<double>(0.0, 1.0)(random);
  draw.has_garbage = Chance(&random, 0.25);
  draw.entries = kParts[Below(&random, 6)];
  WriteDirectory(inodes_.front(), draw, &random, directory);
}

void Device::WriteAll(const std::string& directory) const {
  Random random;
  WriteDirectory(inodes_.front(),
                 {4096, Draw::Part::kAll, 1.0, false, Draw::Part::kAll},
                 &random, directory);
}

}  // namespace revisit::faults
