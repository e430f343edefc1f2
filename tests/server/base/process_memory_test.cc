#include "server/base/process_memory.h"

#include <gtest/gtest.h>

#include <filesystem>
#include <fstream>
#include <string>

#include "tests/server/temporary_directory.h"

namespace revisit::server {
namespace {

constexpr std::int64_t kGiB = std::int64_t{1} << 30;

// Files of the system as a process sees them.
class MadeSystem {
 public:
  MadeSystem& Write(const std::string& path, const std::string& content) {
    const std::filesystem::path file = directory_.File("root") + path;
    std::filesystem::create_directories(file.parent_path());
    std::ofstream(file) << content << "\n";
    return *this;
  }
  std::optional<std::int64_t> Limit() const {
    return ControlGroupLimit(directory_.File("root"));
  }

 private:
  TemporaryDirectory directory_;
};

TEST(ProcessMemoryTest, MemoryOfThisProcessIsKnown) {
  EXPECT_GT(ResidentBytes(), 1 << 20);
  EXPECT_GT(DefaultMemoryLimit(), ResidentBytes());
}

TEST(ProcessMemoryTest, LimitOfTheServicesOwnGroupCounts) {
  MadeSystem system;
  system.Write("/proc/self/cgroup", "0::/system.slice/revisitd.service")
      .Write("/sys/fs/cgroup/memory.max", "max")
      .Write("/sys/fs/cgroup/system.slice/memory.max", "max")
      .Write("/sys/fs/cgroup/system.slice/revisitd.service/memory.max",
             "2147483648");
  EXPECT_EQ(system.Limit(), 2 * kGiB);
  // Others' limits do not.
  system.Write("/sys/fs/cgroup/system.slice/other.service/memory.max", "4096");
  EXPECT_EQ(system.Limit(), 2 * kGiB);
}

TEST(ProcessMemoryTest, LeastLimitUpThePathCounts) {
  MadeSystem system;
  system.Write("/proc/self/cgroup", "0::/a/b/c")
      .Write("/sys/fs/cgroup/a/memory.max", "1073741824")
      .Write("/sys/fs/cgroup/a/b/memory.max", "3221225472")
      .Write("/sys/fs/cgroup/a/b/c/memory.max", "2147483648");
  EXPECT_EQ(system.Limit(), kGiB);
}

TEST(ProcessMemoryTest, ContainerIsLimitedByTheGroupThatItSees) {
  MadeSystem own;
  own.Write("/proc/self/cgroup", "0::/")
      .Write("/sys/fs/cgroup/memory.max", "1073741824");
  EXPECT_EQ(own.Limit(), kGiB);
  // It is told its path on the host.
  MadeSystem hosts;
  hosts
      .Write("/proc/self/cgroup",
             "12:cpu,cpuacct:/docker/1f\n5:hugetlb,memory:/docker/1f\n0::/x")
      .Write("/sys/fs/cgroup/memory/memory.limit_in_bytes", "1073741824");
  EXPECT_EQ(hosts.Limit(), kGiB);
}

TEST(ProcessMemoryTest, GroupsOfTheFirstVersionAreKnownByTheirController) {
  MadeSystem system;
  system
      .Write("/proc/self/cgroup",
             "9:memory:/system.slice/r.service\n8:memory_like:/\n"
             "1:name=systemd:/system.slice/r.service")
      .Write("/sys/fs/cgroup/memory/memory.limit_in_bytes",
             "9223372036854771712")
      .Write(
          "/sys/fs/cgroup/memory/system.slice/r.service/"
          "memory.limit_in_bytes",
          "2147483648");
  EXPECT_EQ(system.Limit(), 2 * kGiB);
}

TEST(ProcessMemoryTest, NothingIsKnownWhereNoGroupHasALimit) {
  EXPECT_EQ(MadeSystem().Limit(), std::nullopt);
  EXPECT_EQ(MadeSystem()
                .Write("/proc/self/cgroup", "0::/a\nnonsense\n:\n0::a")
                .Write("/sys/fs/cgroup/a/memory.max", "max")
                .Limit(),
            std::nullopt);
}

}  // namespace
}  // namespace revisit::server
