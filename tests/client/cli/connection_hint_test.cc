#include "client/cli/connection_hint.h"

#include "gmock/gmock.h"
#include "gtest/gtest.h"

namespace revisit::client {
namespace {

using ::testing::HasSubstr;

TEST(ConnectionHintTest, RefusedConnectionAsksForTheServer) {
  ChannelOptions options;
  options.address = "robot:50051";
  EXPECT_THAT(ConnectionHint(absl::UnavailableError(
                                 "failed to connect to all addresses; last "
                                 "error: Connection refused"),
                             options),
              HasSubstr("is revisitd running at robot:50051?"));
  EXPECT_EQ(
      ConnectionHint(absl::UnavailableError("STORE_UNAVAILABLE"), options), "");
}

}  // namespace
}  // namespace revisit::client
