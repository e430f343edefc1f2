// What a device may hold after the power was lost, made from a recording of
// what was written and flushed.
//
// What was flushed is there. Of what was written since the last flush of a file
// any part may have got to the device in any order, in blocks of 512 or 4096
// bytes, each as it was at some moment; the file may have any size that it had
// since. A new block that was not written holds zeros or, for some states,
// anything. Of entries that a directory got or lost since its own flush any may
// be missing or back again; flushing a new file does not flush its entry. What
// shared memory is mapped to holds anything, or is not there.
#ifndef REVISIT_TESTS_FAULTS_CRASH_STATES_H_
#define REVISIT_TESTS_FAULTS_CRASH_STATES_H_

#include <cstddef>
#include <cstdint>
#include <map>
#include <random>
#include <string>
#include <vector>

#include "recording.h"

namespace revisit::faults {

struct Event {
  EventHeader header;
  std::string name;
  std::string data;
};

// Ends the process if the file is not a recording.
std::vector<Event> ReadRecording(const std::string& path);

class Device {
 public:
  using Random = std::mt19937_64;

  // Flushes of files whose name ends so are not honoured: what the device does
  // that lies. "/": those of directories. Empty: all are.
  explicit Device(std::string dishonoured) : dishonoured_(dishonoured) {}

  // In the order of the recording.
  void Apply(const Event& event);

  // Writes one of the states that the device may be in into a directory.
  void WriteState(Random random, const std::string& directory) const;
  // As if everything had been flushed, and without shared memory: what a
  // program sees that reads the files now.
  void WriteAll(const std::string& directory) const;

 private:
  // A change of a file's content: `data` at `offset`, or its size.
  struct Change {
    std::size_t event;
    bool is_size;
    std::uint64_t offset;
    std::string data;
  };
  // A change of a directory: `from` no longer names the inode, `to` does.
  struct EntryChange {
    std::size_t event;
    std::size_t inode;
    std::string from;
    std::string to;
  };
  struct Inode {
    std::string name;
    bool is_directory = false;
    // On the device.
    std::string content;
    std::map<std::string, std::size_t> entries;
    // Perhaps.
    std::vector<Change> changes;
    std::vector<EntryChange> entry_changes;
    // As shared memory held it when it was last looked at.
    std::string mapped;

    bool is_shared_memory() const;
  };
  struct Sync {
    std::size_t inode;
    std::size_t begin;
  };
  struct Draw;

  std::size_t Add(const Event& event, bool is_directory);
  void ChangeEntry(std::uint64_t directory, EntryChange change);
  void Flush(Inode* inode, std::size_t before);
  static void Apply(const Change& change, std::string* content);
  static void Apply(const EntryChange& change,
                    std::map<std::string, std::size_t>* entries);
  static std::string DrawContent(const Inode& inode, const Draw& draw,
                                 Random* random);
  void WriteDirectory(const Inode& directory, const Draw& draw, Random* random,
                      const std::string& path) const;

  const std::string dishonoured_;
  std::size_t events_ = 0;
  // By their order; the numbers of the recording are used again.
  std::vector<Inode> inodes_;
  std::map<std::uint64_t, std::size_t> by_number_;
  std::map<std::uint32_t, Sync> syncs_;
};

}  // namespace revisit::faults

#endif  // REVISIT_TESTS_FAULTS_CRASH_STATES_H_
