#include "server/storage/revision_draft.h"

#include <sqlite3.h>

#include <cstdint>
#include <filesystem>
#include <string>
#include <utility>
#include <vector>

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "tests/server/error_matchers.h"
#include "tests/server/temporary_directory.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::Pair;

using Numbered = std::pair<std::uint64_t, std::string>;

class RevisionDraftTest : public ::testing::Test {
 protected:
  std::unique_ptr<RevisionDraft> MakeDraft() const {
    auto draft = RevisionDraft::Create(directory_.File(""), 0);
    EXPECT_TRUE(draft.ok()) << draft.status();
    return *std::move(draft);
  }

  static std::vector<Numbered> PosesOf(RevisionDraft* draft,
                                       std::uint64_t first,
                                       std::uint64_t last) {
    std::vector<Numbered> poses;
    EXPECT_THAT(
        draft->ReadPoses(first, last,
                         [&](std::uint64_t sequence, const std::string& pose) {
                           poses.emplace_back(sequence, pose);
                           return absl::OkStatus();
                         }),
        IsOk());
    return poses;
  }

  const TemporaryDirectory directory_;
};

TEST_F(RevisionDraftTest, PosesComeBackBySequenceWhateverTheirOrder) {
  const auto draft = MakeDraft();
  for (const std::uint64_t sequence : {7, 3, 9, 1}) {
    const auto added =
        draft->AddPose(sequence, "pose " + std::to_string(sequence));
    ASSERT_TRUE(added.ok() && *added);
  }
  EXPECT_EQ(draft->pose_count(), 4);
  EXPECT_EQ(draft->first_sequence(), 1u);
  EXPECT_EQ(draft->last_sequence(), 9u);
  EXPECT_THAT(PosesOf(draft.get(), 2, 8),
              ElementsAre(Pair(3, "pose 3"), Pair(7, "pose 7")));
}

TEST_F(RevisionDraftTest, SecondPoseOfASequenceIsNotTaken) {
  const auto draft = MakeDraft();
  ASSERT_TRUE(*draft->AddPose(5, "first"));
  const auto again = draft->AddPose(5, "second");
  ASSERT_TRUE(again.ok()) << again.status();
  EXPECT_FALSE(*again);
  EXPECT_EQ(draft->pose_count(), 1);
  EXPECT_THAT(PosesOf(draft.get(), 1, 9), ElementsAre(Pair(5, "first")));
}

TEST_F(RevisionDraftTest, BatchesCanBeReadAgainAfterARefusal) {
  const auto draft = MakeDraft();
  EXPECT_FALSE(draft->has_batches());
  const std::string zero("b\0b", 3);
  ASSERT_THAT(draft->AddBatch({4, 2, 0, zero}), IsOk());
  ASSERT_THAT(draft->AddBatch({1, 3, 0, "a"}), IsOk());
  EXPECT_TRUE(draft->has_batches());
  EXPECT_THAT(draft->ReadBatches(
                  [](const BatchRecord&) { return absl::AbortedError("no"); }),
              ::testing::Property(&absl::Status::code, StatusCode::kAborted));
  std::vector<BatchRecord> batches;
  ASSERT_THAT(draft->ReadBatches([&](const BatchRecord& batch) {
    batches.push_back(batch);
    return absl::OkStatus();
  }),
              IsOk());
  ASSERT_EQ(batches.size(), 2u);
  EXPECT_EQ(batches[0].first_sequence, 1u);
  EXPECT_EQ(batches[1].first_sequence, 4u);
  EXPECT_EQ(batches[1].count, 2u);
  EXPECT_EQ(batches[1].payload, zero);
}

TEST_F(RevisionDraftTest, NothingIsToBeSeenInTheDirectory) {
  const auto draft = MakeDraft();
  const std::string large(std::size_t{1} << 20, 'x');
  for (std::uint64_t sequence = 1; sequence <= 16; ++sequence) {
    ASSERT_TRUE(draft->AddPose(sequence, large).ok());
  }
  EXPECT_TRUE(std::filesystem::is_empty(directory_.File("")));
  EXPECT_EQ(PosesOf(draft.get(), 16, 16).front().second, large);
}

TEST_F(RevisionDraftTest, MostOfALargeDraftIsNotInMemory) {
  const auto draft = MakeDraft();
  sqlite3_memory_highwater(/*resetFlag=*/1);
  const std::int64_t before = sqlite3_memory_used();
  ASSERT_GT(before, 0);
  const std::string pose(200, 'p');
  constexpr std::uint64_t kPoses = 400000;
  for (std::uint64_t i = 0; i < kPoses; ++i) {
    // In an order of its own, each once.
    ASSERT_TRUE(*draft->AddPose(1 + i * 7919 % kPoses, pose));
  }
  EXPECT_EQ(draft->pose_count(), static_cast<std::int64_t>(kPoses));
  // The draft has 80 MB. Resident memory would count a sanitizer's as well.
  EXPECT_LT(sqlite3_memory_highwater(/*resetFlag=*/0) - before, 20 << 20);
}

TEST_F(RevisionDraftTest, LittleRoomIsKeptFreeForOthers) {
  const auto refused =
      RevisionDraft::Create(directory_.File(""), std::int64_t{1} << 60);
  EXPECT_THAT(refused.status(),
              IsError(StatusCode::kResourceExhausted, "STORAGE_FULL",
                      HasSubstr("bytes left")));
}

TEST_F(RevisionDraftTest, DirectoryThatIsNotThereIsTold) {
  const auto refused = RevisionDraft::Create(directory_.File("nowhere"), 0);
  EXPECT_THAT(refused.status(),
              IsError(StatusCode::kUnavailable, "STORE_UNAVAILABLE",
                      HasSubstr("nowhere")));
}

}  // namespace
}  // namespace revisit::server
