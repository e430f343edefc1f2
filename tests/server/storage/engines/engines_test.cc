#include <string>

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "server/storage/engines/engine.h"
#include "server/storage/engines/postgres_engine.h"
#include "server/storage/engines/sqlite_engine.h"

namespace revisit::server {
namespace {

using ::testing::HasSubstr;

constexpr char kDatabase[] = "postgresql://db.example/revisit";

absl::Status Check(const ServerSettings& settings) {
  return EngineOf(settings.store).CheckSettings(settings);
}

std::string Refusal(const absl::Status& status) {
  EXPECT_EQ(status.code(), absl::StatusCode::kInvalidArgument);
  return std::string(status.message());
}

TEST(EnginesTest, UrlOfPostgresIsADatabaseAndAllElseAFile) {
  // Without the slashes it is a URL that was mistyped.
  for (const char* url : {kDatabase, "postgres://db/revisit",
                          "postgresql:/db/revisit", "postgres:"}) {
    EXPECT_EQ(&EngineOf(url), &PostgresEngine()) << url;
  }
  for (const char* path : {"./postgresql", "revisit-store", "/a/b.sqlite", "",
                           "mysql://db/revisit"}) {
    EXPECT_EQ(&EngineOf(path), &SqliteEngine()) << path;
  }
}

TEST(EnginesTest, WhatOnlyASharedStoreCanKeepIsRefusedForAFile) {
  ServerSettings settings;
  EXPECT_TRUE(Check(settings).ok());
  settings.require_replicated = true;
  EXPECT_THAT(Refusal(Check(settings)),
              HasSubstr("require-replicated needs a store that servers share"));
  settings = ServerSettings();
  settings.advertise_address = "a:1";
  EXPECT_THAT(Refusal(Check(settings)),
              HasSubstr("advertise-address needs a store that servers share"));
  settings.require_replicated = true;
  settings.store = kDatabase;
  EXPECT_TRUE(Check(settings).ok());
}

TEST(EnginesTest, ServerOfASharedStoreHasANameByWhichOthersReachIt) {
  ServerSettings settings;
  settings.store = kDatabase;
  for (const char* listen : {"127.0.0.1:0", "0.0.0.0:50051", "[::]:50051"}) {
    settings.listen = listen;
    EXPECT_THAT(Refusal(Check(settings)),
                HasSubstr("no other server can name this one"))
        << listen;
  }
  settings.listen = "10.0.0.1:50051";
  EXPECT_TRUE(Check(settings).ok());
}

TEST(EnginesTest, TaskThatAnEngineHasNoUseForSaysWhatToDoInstead) {
  const StoreAccess database = {kDatabase, std::chrono::milliseconds(0), 0, {}};
  EXPECT_THAT(Refusal(PostgresEngine().BackUp(database, "copy").status()),
              HasSubstr("pg_basebackup"));
  EXPECT_THAT(Refusal(PostgresEngine().Compact(database).status()),
              HasSubstr("VACUUM FULL"));
  const StoreAccess file = {"store", std::chrono::milliseconds(0), 0, {}};
  EXPECT_THAT(Refusal(SqliteEngine().Migrate(file).status()),
              HasSubstr("brought up to date when it is opened"));
}

}  // namespace
}  // namespace revisit::server
