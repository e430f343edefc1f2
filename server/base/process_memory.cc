#include "server/base/process_memory.h"

#include <malloc.h>
#include <unistd.h>

#include <algorithm>
#include <chrono>
#include <cstddef>
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

std::chrono::nanoseconds Now() {
  return std::chrono::steady_clock::now().time_since_epoch();
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

std::optional<std::int64_t> ControlGroupLimit(const std::string& root) {
  std::optional<std::int64_t> least;
  // Lines such as 0::/system.slice/revisitd.service (version 2: no
  // controllers), or 5:cpu,memory:/docker/1f3a (version 1).
  std::ifstream groups(root + "/proc/self/cgroup");
  for (std::string line; std::getline(groups, line);) {
    const std::size_t first = line.find(':');
    const std::size_t second = line.find(':', first + 1);
    if (first == std::string::npos || second == std::string::npos) continue;
    const std::string controllers =
        "," + line.substr(first + 1, second - first - 1) + ",";
    const bool is_second_version = controllers == ",,";
    if (!is_second_version &&
        controllers.find(",memory,") == std::string::npos) {
      continue;
    }
    const std::string mount =
        root + (is_second_version ? "/sys/fs/cgroup" : "/sys/fs/cgroup/memory");
    const char* const name =
        is_second_version ? "/memory.max" : "/memory.limit_in_bytes";
    // A container may see its own group as the mount, and be told its path on
    // the host: what is not there sets no limit.
    std::string group = line.substr(second + 1);
    while (true) {
      if (group == "/") group.clear();
      std::ifstream file(mount + group + name);
      std::int64_t limit = 0;
      // "max" is no limit.
      if (file >> limit && limit > 0) {
        least = std::min(least.value_or(limit), limit);
      }
      const std::size_t slash = group.rfind('/');
      if (slash == std::string::npos) break;
      group.erase(slash);
    }
  }
  return least;
}

std::int64_t DefaultMemoryLimit() {
  const std::int64_t machine =
      static_cast<std::int64_t>(sysconf(_SC_PHYS_PAGES)) *
      sysconf(_SC_PAGESIZE);
  return std::min(machine, ControlGroupLimit().value_or(machine)) / 4 * 3;
}

void Trimmer::TrimIfWorthwhile() {
  const std::optional<Memory> memory = LookIfDue();
  if (!memory) return;
  if (memory->unused - least_unused_ >= kWorthTrimming ||
      trimmed_in_use_ - memory->in_use >= kStillShrinking) {
    Trim();
  } else {
    least_unused_ = std::min(least_unused_, memory->unused);
    trimmed_in_use_ = 0;
  }
}

void Trimmer::TrimIfMuch() {
  const std::optional<Memory> memory = LookIfDue();
  if (memory && memory->unused - least_unused_ >= kMuchToTrim) Trim();
}

std::optional<Trimmer::Memory> Trimmer::LookIfDue() {
  const std::chrono::nanoseconds begin = Now();
  if (!looks_.MayBegin(begin)) return std::nullopt;
  const Memory memory = Look();
  looks_.Ended(begin, Now());
  return memory;
}

// Goes through all chunks that are free.
Trimmer::Memory Trimmer::Look() {
  const struct mallinfo2 heap = mallinfo2();
  const auto in_use = static_cast<std::int64_t>(heap.uordblks + heap.hblkhd);
  return {in_use, ResidentBytes() - in_use};
}

void Trimmer::Trim() {
  malloc_trim(0);
  const Memory memory = Look();
  least_unused_ = memory.unused;
  trimmed_in_use_ = memory.in_use;
}

}  // namespace revisit::server
