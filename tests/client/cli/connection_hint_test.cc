#include "client/cli/connection_hint.h"

#include "gmock/gmock.h"
#include "gtest/gtest.h"

namespace revisit::client {
namespace {

using ::testing::HasSubstr;

const absl::Status kRefused = absl::UnavailableError(
    "failed to connect to all addresses; last error: Connection refused");

ChosenServer OfContext() {
  ChosenServer server;
  server.options.address = "robot:50051";
  server.context = "plant";
  server.contexts_path = "/c.json";
  server.chosen_by = "REVISIT_CONTEXT";
  return server;
}

TEST(ConnectionHintTest, RefusedConnectionAsksForTheServer) {
  ChosenServer server;
  server.options.address = "robot:50051";
  server.chosen_by = "--server";
  EXPECT_EQ(ConnectionHint(kRefused, server),
            "(is revisitd running at robot:50051? --server and REVISIT_SERVER "
            "name another address)");
  EXPECT_EQ(ConnectionHint(absl::UnavailableError("STORE_UNAVAILABLE"), server),
            "");
}

TEST(ConnectionHintTest, ContextIsNamedWhereTheConnectionIsAtFault) {
  const std::string context =
      "(the context plant in /c.json, chosen by REVISIT_CONTEXT, names the "
      "server robot:50051)";
  EXPECT_THAT(ConnectionHint(kRefused, OfContext()),
              HasSubstr("another address)\n" + context));
  EXPECT_EQ(ConnectionHint(
                absl::UnavailableError("DNS resolution failed for robot:50051"),
                OfContext()),
            context);
  EXPECT_EQ(ConnectionHint(absl::UnauthenticatedError("no token"), OfContext()),
            context);
  EXPECT_EQ(ConnectionHint(absl::NotFoundError("no vehicle"), OfContext()), "");
  EXPECT_EQ(
      ConnectionHint(absl::UnavailableError("STORE_UNAVAILABLE"), OfContext()),
      "");
}

}  // namespace
}  // namespace revisit::client
