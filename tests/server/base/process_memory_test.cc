#include "server/base/process_memory.h"

#include <gtest/gtest.h>

namespace revisit::server {
namespace {

TEST(ProcessMemoryTest, MemoryOfThisProcessIsKnown) {
  EXPECT_GT(ResidentBytes(), 1 << 20);
  EXPECT_GT(DefaultMemoryLimit(), ResidentBytes());
}

}  // namespace
}  // namespace revisit::server
