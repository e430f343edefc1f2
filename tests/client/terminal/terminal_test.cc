#include "client/terminal/terminal.h"

#include <chrono>
#include <cstdint>
#include <sstream>
#include <string>
#include <thread>

#include "gmock/gmock.h"
#include "gtest/gtest.h"

namespace revisit::client {
namespace {

using ::testing::ContainsRegex;
using ::testing::HasSubstr;
using ::testing::Not;

TEST(TerminalTest, SecondHintStandsBelowTheFirst) {
  const absl::Status status =
      WithHint(WithHint(absl::UnavailableError("gone"), "wait"), "look");
  EXPECT_THAT(ErrorText(status), HasSubstr("gone\nwait\nlook"));
  EXPECT_THAT(ErrorToJson(status), HasSubstr("\"hint\":\"wait\\nlook\""));
}

// What a bar shows last after so much was done, long enough after it began for
// it to be drawn.
std::string LastOf(std::uint64_t done, std::uint64_t total) {
  std::ostringstream out;
  const Terminal terminal = {out, out, /*progress_is_terminal=*/true};
  {
    Progress progress(terminal, "map", total, "searches");
    std::this_thread::sleep_for(std::chrono::milliseconds(120));
    progress.Update(done);
  }
  return out.str();
}

TEST(ProgressTest, SaysHowLongTheRestTakesUntilAllIsDone) {
  // More than 2,777 hours.
  EXPECT_THAT(LastOf(1, 1'000'000'000), HasSubstr("2777:46:40 left"));
  EXPECT_THAT(LastOf(1, 3), ContainsRegex("1/3 searches  [0-9]+/s  0:00 left"));
  EXPECT_THAT(LastOf(2, 2), HasSubstr("2/2 searches"));
  EXPECT_THAT(LastOf(2, 2), Not(HasSubstr("left")));
}

}  // namespace
}  // namespace revisit::client
