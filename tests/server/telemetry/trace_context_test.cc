#include "server/telemetry/trace_context.h"

#include "gtest/gtest.h"

namespace revisit::server {
namespace {

constexpr char kTrace[] = "4bf92f3577b34da6a3ce929d0e0e4736";
constexpr char kParent[] = "00f067aa0ba902b7";

// The example of the standard.
TEST(TraceContextTest, ReadsTheIdsOfTraceAndParent) {
  const TraceContext trace = ParseTraceParent(
      "00-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01");
  EXPECT_EQ(trace.trace_id, kTrace);
  EXPECT_EQ(trace.parent_id, kParent);
}

TEST(TraceContextTest, ReadsWhatLaterVersionsHaveInCommonWithThisOne) {
  for (const char* header :
       {"cc-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01",
        "cc-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01-what-is-"
        "new"}) {
    EXPECT_EQ(ParseTraceParent(header).trace_id, kTrace) << header;
  }
}

TEST(TraceContextTest, IgnoresWhatIsMalformed) {
  for (const char* header :
       {"", "00", "00-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7",
        // Version 255, and fields that version 0 does not have.
        "ff-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01",
        "00-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01-",
        "cc-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01.x",
        // Capitals, other letters, zeros, and dashes elsewhere.
        "00-4BF92F3577B34DA6A3CE929D0E0E4736-00f067aa0ba902b7-01",
        "00-4bf92f3577b34da6a3ce929d0e0e473g-00f067aa0ba902b7-01",
        "0x-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01",
        "00-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-0g",
        "00-00000000000000000000000000000000-00f067aa0ba902b7-01",
        "00-4bf92f3577b34da6a3ce929d0e0e4736-0000000000000000-01",
        "00-4bf92f3577b34da6a3ce929d0e0e47-3600f067aa0ba902b7-01"}) {
    EXPECT_EQ(ParseTraceParent(header).trace_id, "") << header;
    EXPECT_EQ(ParseTraceParent(header).parent_id, "") << header;
  }
}

}  // namespace
}  // namespace revisit::server
