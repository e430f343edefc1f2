// What memory this process has, may have, and can give back.
#ifndef REVISIT_SERVER_BASE_PROCESS_MEMORY_H_
#define REVISIT_SERVER_BASE_PROCESS_MEMORY_H_

#include <cstdint>

namespace revisit::server {

// Resident bytes of this process; 0 if the system does not say.
std::int64_t ResidentBytes();

// Three quarters of what the machine or the control group lets the process
// have.
std::int64_t DefaultMemoryLimit();

// Gives back to the system what the C library keeps of memory that was freed,
// where that is worth the time: some milliseconds per 100 MB.
// Thread-compatible.
class Trimmer {
 public:
  // Trims after unloaded vehicles, and after many calls or streams at once. A
  // crowd may be leaving still when trimming is first worthwhile, and what the
  // last of it frees may not be worth it alone; so a trim is followed by others
  // until the heap shrinks no more.
  void TrimIfWorthwhile();

  // Trims where so much lies unused that it should not wait for the next
  // TrimIfWorthwhile().
  void TrimIfMuch();

  void Trim();

 private:
  // Unused bytes after the last trim, or the fewest seen since.
  std::int64_t least_unused_ = 0;
  // Bytes in use after the last look, if that trimmed; else 0.
  std::int64_t trimmed_in_use_ = 0;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_BASE_PROCESS_MEMORY_H_
