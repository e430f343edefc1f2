#include "server/storage/free_space.h"

#include <cstdint>

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "tests/server/error_matchers.h"
#include "tests/server/temporary_directory.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using ::testing::AllOf;
using ::testing::HasSubstr;

TEST(FreeSpaceTest, WritesWaitBelowTheMarkUntilAQuarterMoreIsFree) {
  std::int64_t free = 100;
  FreeSpaceGuard guard(
      100, [&] { return free; }, [] { return 0; });
  const auto full = IsError(StatusCode::kResourceExhausted, "STORAGE_FULL",
                            HasSubstr("taken again from 125 on"));
  EXPECT_THAT(guard.Check(), IsOk());
  free = 99;
  EXPECT_THAT(guard.Check(), full);
  free = 124;
  EXPECT_THAT(guard.Check(), full);
  free = 125;
  EXPECT_THAT(guard.Check(), IsOk());
  free = 100;
  EXPECT_THAT(guard.Check(), IsOk());
}

TEST(FreeSpaceTest, RoomInTheFileCountsWhereTheLogHasSomeToo) {
  // Deleting made room in the file alone, and nothing could be written.
  std::int64_t free = 99;
  std::int64_t inside = 0;
  FreeSpaceGuard guard(
      100, [&] { return free; }, [&] { return inside; });
  const auto full = IsError(StatusCode::kResourceExhausted, "STORAGE_FULL",
                            HasSubstr("bytes left and its file"));
  EXPECT_THAT(guard.Check(), full);
  inside = 25;
  EXPECT_THAT(guard.Check(), full);
  inside = 26;
  EXPECT_THAT(guard.Check(), IsOk());
  free = 25;
  inside = 75;
  EXPECT_THAT(guard.Check(), IsOk());
  free = 24;
  inside = 1000;
  EXPECT_THAT(guard.Check(), full);
}

TEST(FreeSpaceTest, MarkOfZeroAsksNobody) {
  FreeSpaceGuard guard(
      0,
      []() -> absl::StatusOr<std::int64_t> {
        ADD_FAILURE();
        return 0;
      },
      nullptr);
  EXPECT_THAT(guard.Check(), IsOk());
}

TEST(FreeSpaceTest, FileSystemThatDoesNotTellStopsNothing) {
  FreeSpaceGuard guard(
      100,
      []() -> absl::StatusOr<std::int64_t> {
        return absl::UnavailableError("who knows");
      },
      nullptr);
  EXPECT_THAT(guard.Check(), IsOk());
}

TEST(FreeSpaceTest, HasNoRoomWhereWritesWait) {
  std::int64_t free = 100;
  FreeSpaceGuard guard(
      100, [&] { return free; }, [] { return std::int64_t{0}; });
  EXPECT_TRUE(guard.HasRoom());
  free = 99;
  EXPECT_FALSE(guard.HasRoom());
  free = 124;
  EXPECT_FALSE(guard.HasRoom());
  free = 125;
  EXPECT_TRUE(guard.HasRoom());
}

TEST(FreeSpaceTest,
     HasNoRoomAfterAWriteFoundNoneUntilSomeComesOrAWriteSucceeds) {
  std::int64_t free = 5000;
  FreeSpaceGuard guard(
      0, [&] { return free; }, [] { return std::int64_t{0}; });
  guard.NoteWrite(/*found_full=*/true);
  EXPECT_THAT(guard.Check(), IsOk());
  EXPECT_FALSE(guard.HasRoom());
  free += 4096;
  EXPECT_FALSE(guard.HasRoom());
  free += 1 << 20;
  EXPECT_TRUE(guard.HasRoom());
  guard.NoteWrite(/*found_full=*/true);
  EXPECT_FALSE(guard.HasRoom());
  guard.NoteWrite(/*found_full=*/false);
  EXPECT_TRUE(guard.HasRoom());
}

TEST(FreeSpaceTest, SaysWhoseQuotaItIsAndWhenToTryAgain) {
  const absl::Status status = StorageFull("no room");
  google::rpc::QuotaFailure quota;
  google::rpc::RetryInfo retry;
  ASSERT_TRUE(
      quota.ParseFromString(std::string(*status.GetPayload(kQuotaFailureUrl))));
  ASSERT_TRUE(
      retry.ParseFromString(std::string(*status.GetPayload(kRetryInfoUrl))));
  ASSERT_EQ(quota.violations_size(), 1);
  EXPECT_EQ(quota.violations(0).subject(), "storage");
  EXPECT_EQ(quota.violations(0).description(), "no room");
  EXPECT_EQ(retry.retry_delay().seconds(), 30);
}

TEST(FreeSpaceTest, FileSystemOfADirectoryHasRoom) {
  const TemporaryDirectory directory;
  EXPECT_GT(*FreeBytes(directory.File("")), 0);
  EXPECT_EQ(FreeBytes(directory.File("none")).status().code(),
            StatusCode::kNotFound);
}

}  // namespace
}  // namespace revisit::server
