// A recording of a store's files consists of the events that the shim
// writes (recorder.h) and crash states are made of (crash_states.h).
//
// The events of all processes of a recording lie one behind the other in one
// file, in the order in which they came about. Each is an EventHeader, a name
// and data. Files and directories go by their inode, so that they keep their
// identity under other names; a kCreate or kMakeDirectory begins a new one,
// should the system use the number again.
#ifndef REVISIT_TESTS_FAULTS_RECORDING_H_
#define REVISIT_TESTS_FAULTS_RECORDING_H_

#include <cstdint>

namespace revisit::faults {

enum class EventKind : std::uint32_t {
  // The directory that is recorded: `name` is its path. The first event.
  kRoot = 1,
  // What was there before the first process goes on as if it had just been
  // made; here that ends, and all of it is on the device.
  kBegin = 2,
  // A new entry `name` of the directory `parent`.
  kMakeDirectory = 3,
  kCreate = 4,
  kLink = 5,
  // Removes the entry `name` of `parent`.
  kUnlink = 6,
  // `name` is both names, a zero byte between them; `parent` and `target` are
  // the directories.
  kRename = 7,
  // `data` at `offset`.
  kWrite = 8,
  // The size becomes `offset`.
  kTruncate = 9,
  // A flush of the file or directory, and its success: what came before it
  // began is on the device. By the same thread of the same process.
  kSyncBegin = 10,
  kSyncEnd = 11,
  // `data` at `offset` is what shared memory holds that is mapped onto the
  // file; it may get to the device at any time.
  kMapped = 12,
};

struct EventHeader {
  // CLOCK_MONOTONIC, taken before what the event tells was done; of kSyncEnd
  // after it.
  std::uint64_t time_ns;
  std::uint64_t inode;
  std::uint64_t parent;
  std::uint64_t target;
  std::uint64_t offset;
  std::uint32_t name_bytes;
  std::uint32_t data_bytes;
  EventKind kind;
  std::uint32_t thread;
};

}  // namespace revisit::faults

#endif  // REVISIT_TESTS_FAULTS_RECORDING_H_
