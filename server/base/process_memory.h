// The memory that this process has, may have, and can give back.
#ifndef REVISIT_SERVER_BASE_PROCESS_MEMORY_H_
#define REVISIT_SERVER_BASE_PROCESS_MEMORY_H_

#include <cstdint>
#include <optional>
#include <string>

#include "server/base/share_of_time.h"

namespace revisit::server {

// Resident bytes of this process; 0 if the system does not say.
std::int64_t ResidentBytes();

// The least memory limit, in bytes, of the control groups of this process: its
// own and all above it, of version 2 and 1. Nothing if none has one. `root` is
// put before the paths of the system's files, for tests.
std::optional<std::int64_t> ControlGroupLimit(const std::string& root = "");

// Three quarters of the memory that the machine or the control groups grant the
// process.
std::int64_t DefaultMemoryLimit();

// Returns freed memory that the C library keeps to the system, if that is worth
// the time: some milliseconds per 100 MB. To look whether it is takes tens of
// milliseconds of a heap in small pieces, so the conditional calls rest
// a hundred times as long as the last look took. Thread-compatible.
class Trimmer {
 public:
  // Trims after vehicles were unloaded, and after many calls or streams ended
  // at once. A crowd may still be leaving when trimming is first worthwhile,
  // and the memory that the last of it frees may not be worth a trim alone; so
  // a trim is followed by others until the heap shrinks no more.
  void TrimIfWorthwhile();

  // Trims if so much is unused that it should not wait for the next
  // TrimIfWorthwhile().
  void TrimIfMuch();

  void Trim();

 private:
  struct Memory {
    // Bytes on the heap and in mapped blocks.
    std::int64_t in_use;
    // Bytes resident but not in use. That is more than could be given back, so
    // that only its growth is informative.
    std::int64_t unused;
  };

  static Memory Look();
  // Nothing if looks have taken their share of the time.
  std::optional<Memory> LookIfDue();

  // Unused bytes after the last trim, or the fewest seen since.
  std::int64_t least_unused_ = 0;
  // Bytes in use after the last look, if that trimmed; else 0.
  std::int64_t trimmed_in_use_ = 0;
  ShareOfTime looks_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_BASE_PROCESS_MEMORY_H_
