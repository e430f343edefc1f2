#include "server/base/process_memory.h"

#include <malloc.h>
#include <unistd.h>

#include <algorithm>
#include <fstream>

namespace revisit::server {
namespace {

// Least unused bytes that are worth giving back.
constexpr std::int64_t kWorthTrimming = std::int64_t{8} << 20;
// Unused bytes that are given back at once: callers who are cut off one after
// another leave that much within a second.
constexpr std::int64_t kMuchToTrim = std::int64_t{32} << 20;
// The heap counts as shrinking if it lost this much between two looks.
constexpr std::int64_t kStillShrinking = std::int64_t{256} << 10;

struct Memory {
  // Bytes on the heap and in mapped blocks.
  std::int64_t in_use;
  // Bytes resident but not in use. That is more than could be given back, so
  // that only its growth is informative.
  std::int64_t unused;
};

Memory Look() {
  const struct mallinfo2 heap = mallinfo2();
  const auto in_use = static_cast<std::int64_t>(heap.uordblks + heap.hblkhd);
  return {in_use, ResidentBytes() - in_use};
}

}  // namespace

std::int64_t ResidentBytes() {
  // The file holds pages: those of the whole program, then those in memory.
  std::ifstream file("/proc/self/statm");
  std::int64_t total = 0;
  std::int64_t resident = 0;
  file >> total >> resident;
  return file ? resident * sysconf(_SC_PAGESIZE) : 0;
}

std::int64_t DefaultMemoryLimit() {
  std::int64_t bytes = static_cast<std::int64_t>(sysconf(_SC_PHYS_PAGES)) *
                       sysconf(_SC_PAGESIZE);
  // Control groups of version 2 and 1. "max" in place of a number is no limit.
  for (const char* path : {"/sys/fs/cgroup/memory.max",
                           "/sys/fs/cgroup/memory/memory.limit_in_bytes"}) {
    std::ifstream file(path);
    std::int64_t limit = 0;
    if (file >> limit && limit > 0) bytes = std::min(bytes, limit);
  }
  return bytes / 4 * 3;
}

void Trimmer::TrimIfWorthwhile() {
  const Memory memory = Look();
  if (memory.unused - least_unused_ >= kWorthTrimming ||
      trimmed_in_use_ - memory.in_use >= kStillShrinking) {
    Trim();
  } else {
    least_unused_ = std::min(least_unused_, memory.unused);
    trimmed_in_use_ = 0;
  }
}

void Trimmer::TrimIfMuch() {
  if (Look().unused - least_unused_ >= kMuchToTrim) Trim();
}

void Trimmer::Trim() {
  malloc_trim(0);
  const Memory memory = Look();
  least_unused_ = memory.unused;
  trimmed_in_use_ = memory.in_use;
}

}  // namespace revisit::server
