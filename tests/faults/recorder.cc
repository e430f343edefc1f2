#include "recorder.h"

#include <fcntl.h>
#include <limits.h>
#include <sys/file.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/uio.h>
#include <unistd.h>

#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <ctime>
#include <filesystem>
#include <mutex>
#include <utility>
#include <vector>

namespace revisit::faults {
namespace {

// One flush in so many also records what shared memory holds.
constexpr int kSyncsPerLookAtMemory = 8;

// None of the calls below may come back to the shim, hence the bare ones.
int OpenBare(const char* path, int flags) {
  return static_cast<int>(
      syscall(SYS_openat, AT_FDCWD, path, flags | O_CLOEXEC, 0644));
}

std::uint64_t Now() {
  timespec now;
  clock_gettime(CLOCK_MONOTONIC, &now);
  return static_cast<std::uint64_t>(now.tv_sec) * 1'000'000'000u +
         static_cast<std::uint64_t>(now.tv_nsec);
}

std::string PathOf(int file) {
  char link[64];
  char path[PATH_MAX];
  std::snprintf(link, sizeof(link), "/proc/self/fd/%d", file);
  const ssize_t size = readlink(link, path, sizeof(path));
  return size <= 0 ? "" : std::string(path, static_cast<std::size_t>(size));
}

// Without links on the way there; the last part as it is.
std::string Resolved(const char* path) {
  const std::filesystem::path given(path);
  const std::string directory =
      given.has_parent_path() ? given.parent_path().string() : ".";
  char resolved[PATH_MAX];
  if (realpath(directory.c_str(), resolved) == nullptr) return "";
  return std::string(resolved) + "/" + given.filename().string();
}

std::string NameOf(const std::string& path) {
  return path.substr(path.rfind('/') + 1);
}

std::uint64_t InodeOf(int file) {
  struct stat status;
  return fstat(file, &status) == 0 ? status.st_ino : 0;
}

std::uint64_t InodeOf(const std::string& path) {
  struct stat status;
  return lstat(path.c_str(), &status) == 0 ? status.st_ino : 0;
}

std::uint64_t ParentOf(const std::string& path) {
  return InodeOf(path.substr(0, path.rfind('/')));
}

class Recorder {
 public:
  Recorder() {
    const char* const log = getenv("REVISIT_TEST_RECORD");
    const char* const root = getenv("REVISIT_TEST_RECORD_BELOW");
    char resolved[PATH_MAX];
    if (log == nullptr || root == nullptr ||
        realpath(root, resolved) == nullptr) {
      return;
    }
    root_ = resolved;
    log_ = OpenBare(log, O_WRONLY | O_CREAT | O_APPEND);
    if (log_ < 0) abort();
    Lock();
    struct stat status;
    if (fstat(log_, &status) == 0 && status.st_size == 0) RecordTree();
    Unlock();
  }

  bool is_on() const { return log_ >= 0; }

  bool Watches(const std::string& path) const {
    return path.size() > root_.size() &&
           path.compare(0, root_.size(), root_) == 0 &&
           path[root_.size()] == '/';
  }

  void Lock() {
    mutex_.lock();
    while (flock(log_, LOCK_EX) != 0) continue;
    time_ = Now();
  }

  void Unlock() {
    flock(log_, LOCK_UN);
    mutex_.unlock();
  }

  // REQUIRES: the lock is held.
  void Write(EventHeader header, const std::string& name = "",
             const void* data = nullptr, std::size_t size = 0) {
    header.time_ns = header.kind == EventKind::kSyncEnd ? Now() : time_;
    header.thread = static_cast<std::uint32_t>(syscall(SYS_gettid));
    header.name_bytes = static_cast<std::uint32_t>(name.size());
    header.data_bytes = static_cast<std::uint32_t>(size);
    const iovec parts[] = {{&header, sizeof(header)},
                           {const_cast<char*>(name.data()), name.size()},
                           {const_cast<void*>(data), size}};
    const auto whole = static_cast<long>(sizeof(header) + name.size() + size);
    // A recording with a hole would prove nothing.
    if (syscall(SYS_writev, log_, parts, 3) != whole) abort();
  }

  void Write(EventKind kind, std::uint64_t inode, std::uint64_t parent = 0,
             const std::string& name = "") {
    EventHeader header{};
    header.kind = kind;
    header.inode = inode;
    header.parent = parent;
    Write(header, name);
  }

  void WriteData(EventKind kind, std::uint64_t inode, std::uint64_t offset,
                 const void* data, std::size_t size) {
    EventHeader header{};
    header.kind = kind;
    header.inode = inode;
    header.offset = offset;
    Write(header, "", data, size);
  }

  void KeepMemory(std::uint64_t inode, void* memory, std::size_t size,
                  std::uint64_t offset) {
    mapped_.push_back({inode, memory, size, offset});
  }

  void ForgetMemory(void* memory) {
    for (std::size_t i = mapped_.size(); i > 0; --i) {
      if (mapped_[i - 1].memory == memory) {
        mapped_.erase(mapped_.begin() + static_cast<std::ptrdiff_t>(i - 1));
      }
    }
  }

  void LookAtMemory() {
    if (++syncs_ % kSyncsPerLookAtMemory != 0) return;
    for (const Memory& memory : mapped_) {
      // Others write to it meanwhile.
      const std::string seen(static_cast<const char*>(memory.memory),
                             memory.size);
      WriteData(EventKind::kMapped, memory.inode, memory.offset, seen.data(),
                seen.size());
    }
  }

 private:
  struct Memory {
    std::uint64_t inode;
    void* memory;
    std::size_t size;
    std::uint64_t offset;
  };

  void RecordTree() {
    Write(EventKind::kRoot, InodeOf(root_), 0, root_);
    RecordDirectory(root_);
    Write(EventKind::kBegin, 0);
  }

  void RecordDirectory(const std::string& directory) {
    for (const auto& entry : std::filesystem::directory_iterator(directory)) {
      const std::string path = entry.path().string();
      const std::uint64_t inode = InodeOf(path);
      const bool is_directory = entry.is_directory();
      Write(is_directory ? EventKind::kMakeDirectory : EventKind::kCreate,
            inode, InodeOf(directory), NameOf(path));
      if (is_directory) {
        RecordDirectory(path);
      } else {
        RecordContent(path, inode);
      }
    }
  }

  void RecordContent(const std::string& path, std::uint64_t inode) {
    const int file = OpenBare(path.c_str(), O_RDONLY);
    std::vector<char> buffer(1 << 20);
    std::uint64_t offset = 0;
    ssize_t size;
    while ((size = pread(file, buffer.data(), buffer.size(),
                         static_cast<off_t>(offset))) > 0) {
      WriteData(EventKind::kWrite, inode, offset, buffer.data(),
                static_cast<std::size_t>(size));
      offset += static_cast<std::uint64_t>(size);
    }
    if (size < 0) abort();
    close(file);
  }

  int log_ = -1;
  std::string root_;
  std::mutex mutex_;
  std::uint64_t time_ = 0;
  std::vector<Memory> mapped_;
  int syncs_ = 0;
};

// Never destroyed: threads may write to the very end.
Recorder& TheRecorder() {
  static Recorder& recorder = *new Recorder;
  return recorder;
}

// What is there before the program begins is on the device.
[[gnu::constructor]] void BeginRecording() { TheRecorder(); }

}  // namespace

Recording::Recording(int file) {
  if (TheRecorder().is_on()) Begin(PathOf(file));
}

Recording::Recording(const char* path) {
  if (TheRecorder().is_on()) Begin(Resolved(path));
}

void Recording::Begin(std::string path) {
  path_ = std::move(path);
  active_ = TheRecorder().Watches(path_);
  if (!active_) return;
  TheRecorder().Lock();
  inode_ = InodeOf(path_);
  was_there_ = inode_ != 0;
}

Recording::~Recording() {
  if (active_) TheRecorder().Unlock();
}

void Recording::Wrote(int file, const void* data, ssize_t written,
                      off64_t offset) {
  if (!active_ || written <= 0) return;
  TheRecorder().WriteData(EventKind::kWrite, InodeOf(file),
                          static_cast<std::uint64_t>(offset), data,
                          static_cast<std::size_t>(written));
}

void Recording::SizeBecame(int file) {
  struct stat status;
  if (!active_ || fstat(file, &status) != 0) return;
  TheRecorder().WriteData(EventKind::kTruncate, status.st_ino,
                          static_cast<std::uint64_t>(status.st_size), nullptr,
                          0);
}

void Recording::Opened(int file, int flags) {
  if (!active_) return;
  if (!was_there_) {
    TheRecorder().Write(EventKind::kCreate, InodeOf(file), ParentOf(path_),
                        NameOf(path_));
  } else if ((flags & O_TRUNC) != 0) {
    SizeBecame(file);
  }
}

void Recording::MadeDirectory() {
  if (!active_) return;
  TheRecorder().Write(EventKind::kMakeDirectory, InodeOf(path_),
                      ParentOf(path_), NameOf(path_));
}

void Recording::Linked(const char* other_path) {
  if (!active_) return;
  const std::string other = Resolved(other_path);
  TheRecorder().Write(EventKind::kLink, inode_, ParentOf(other), NameOf(other));
}

void Recording::Unlinked() {
  if (!active_) return;
  TheRecorder().Write(EventKind::kUnlink, inode_, ParentOf(path_),
                      NameOf(path_));
}

void Recording::RenamedTo(const char* other_path) {
  if (!active_) return;
  const std::string other = Resolved(other_path);
  EventHeader header{};
  header.kind = EventKind::kRename;
  header.inode = inode_;
  header.parent = ParentOf(path_);
  header.target = ParentOf(other);
  TheRecorder().Write(header, NameOf(path_) + '\0' + NameOf(other));
}

void Recording::Mapped(int file, void* memory, std::size_t size,
                       off64_t offset) {
  if (!active_) return;
  TheRecorder().KeepMemory(InodeOf(file), memory, size,
                           static_cast<std::uint64_t>(offset));
}

void RecordSyncBegin(int file) {
  Recorder& recorder = TheRecorder();
  if (!recorder.is_on() || !recorder.Watches(PathOf(file) + "/")) return;
  recorder.Lock();
  recorder.LookAtMemory();
  recorder.Write(EventKind::kSyncBegin, InodeOf(file));
  recorder.Unlock();
}

void RecordSyncEnd(int file) {
  Recorder& recorder = TheRecorder();
  if (!recorder.is_on() || !recorder.Watches(PathOf(file) + "/")) return;
  recorder.Lock();
  recorder.Write(EventKind::kSyncEnd, InodeOf(file));
  recorder.Unlock();
}

void ForgetMapped(void* memory) {
  Recorder& recorder = TheRecorder();
  if (!recorder.is_on()) return;
  recorder.Lock();
  recorder.ForgetMemory(memory);
  recorder.Unlock();
}

}  // namespace revisit::faults
