// Marks that are stored, so that the first search after a load need not find
// them again.
#include <gtest/gtest.h>

#include <cstddef>
#include <memory>
#include <random>
#include <sstream>
#include <string>
#include <thread>
#include <utility>

#include "core/search/search.h"
#include "gmock/gmock.h"
#include "server/base/status.h"
#include "tests/random.h"
#include "tests/server/sessions/snapshots_testing.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using std::chrono::minutes;
using std::chrono::steady_clock;
using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::IsEmpty;

// The answer of a search at the newest node.
struct Found {
  // The answer, to the last bit.
  std::string answer;
  // Whether a mark was missing before, and how many are known since.
  bool missed;
  std::size_t marks;
};

Found SearchIn(const VehicleView& view) {
  const core::SearchOptions& options = view.config.drive.search;
  const bool missed =
      view.search->FindMissingMark(view.drive.graph().size() - 1, options)
          .has_value();
  const auto set = view.search->AtEnd(options, nullptr);
  std::ostringstream text;
  text << std::hexfloat << set->new_place_probability.value_or(-1.0);
  if (set->scale) text << " " << set->scale->scale << " " << set->scale->high;
  for (const core::Candidate& candidate : set->candidates) {
    text << "\n" << candidate.matched << " " << candidate.score;
  }
  return {text.str(), missed, view.search->mark_count()};
}

class MarksTest : public SnapshotsTest {
 protected:
  MarksTest() { Open(1000); }

  Found SearchNow() {
    const Answer<Found> answer;
    session().Search("flow", [answer](const absl::StatusOr<VehicleView>& view) {
      answer.Set(SearchIn(*view));
      return true;
    });
    const Found found = answer.Get();
    // The marks are noted right behind the search.
    ReadNow(*session_).IgnoreError();
    session_.reset();
    return found;
  }
  std::size_t KnownMarks() {
    const Answer<std::size_t> known;
    session().Read([known](const absl::StatusOr<VehicleView>& view) {
      known.Set(view->search->mark_count());
    });
    return known.Get();
  }
  // By a server that has no marks.
  std::string AnswerOfAnother() {
    const Answer<Found> answer;
    Executor executor(2);
    Fleet another(&memory_, &codec_, &executor, Fleet::Options());
    another.Session(kId)->Read(
        [answer](const absl::StatusOr<VehicleView>& view) {
          answer.Set(SearchIn(*view));
        });
    EXPECT_TRUE(answer.Get().missed);
    return answer.Get().answer;
  }
  // A vehicle some of whose marks are known.
  Found CreateAndSearch() {
    Create();
    Append(300);
    const Found found = SearchNow();
    EXPECT_TRUE(found.missed);
    EXPECT_GT(found.marks, 30u);
    return found;
  }
  void ExpectKnown(const Found& before) {
    const Found after = SearchNow();
    EXPECT_FALSE(after.missed);
    EXPECT_EQ(after.answer, before.answer);
    EXPECT_EQ(after.marks, before.marks);
  }
  std::string Marks() { return MarksOf(memory_, key_); }
};

TEST_F(MarksTest, TheFirstSearchOfTheNextServerKnowsThem) {
  const Found before = CreateAndSearch();
  EXPECT_EQ(Marks(), "none");
  Open(1000);
  EXPECT_EQ(Stored(), "none");
  ExpectKnown(before);
  EXPECT_EQ(before.answer, AnswerOfAnother());
  EXPECT_THAT(TakeWarnings(), IsEmpty());
}

TEST_F(MarksTest, UnloadingWritesThoseThatAreNew) {
  const Found before = CreateAndSearch();
  UnloadAll();
  EXPECT_NE(Marks(), "none");
  EXPECT_EQ(storage_.marks_written(), 1);
  ExpectKnown(before);
  UnloadAll();
  EXPECT_EQ(storage_.marks_written(), 1);
  Append(100);
  session_.reset();
  UnloadAll();
  EXPECT_EQ(storage_.marks_written(), 1);
  EXPECT_TRUE(SearchNow().missed);
  UnloadAll();
  EXPECT_EQ(storage_.marks_written(), 2);
}

TEST_F(MarksTest, ThoseThatAReadHasLearnedAreNotWrittenForEver) {
  CreateAndSearch();
  Append(50);
  EXPECT_TRUE(ReadNow(session()).ok());
  session_.reset();
  UnloadAll();
  EXPECT_EQ(storage_.marks_written(), 1);
}

TEST_F(MarksTest, AHandoverWritesThem) {
  const Found before = CreateAndSearch();
  session().HandOver();
  while (!session_->gone()) std::this_thread::yield();
  EXPECT_EQ(storage_.marks_written(), 1);
  ExpectKnown(before);
}

TEST_F(MarksTest, ChecksOfAStreamLearnThemToo) {
  Create();
  for (int i = 0; i < 6; ++i) {
    const auto observer =
        std::make_shared<PlainAppend>(SquareBatch(last_ + 1, 50));
    last_ += 50;
    observer->wants = true;
    observer->candidates = [](const VehicleView&,
                              const absl::StatusOr<core::CandidateSet>& set) {
      EXPECT_TRUE(set.ok());
    };
    const Answer<bool> over;
    observer->over = [over] { over.Set(true); };
    session().Append(observer->Request(), observer);
    over.Get();
  }
  session_.reset();
  Open(1000);
  EXPECT_EQ(storage_.marks_written(), 1);
  EXPECT_GT(KnownMarks(), 30u);
}

TEST_F(MarksTest, ASnapshotIsWrittenWithThem) {
  Open(100);
  const Found before = CreateAndSearch();
  while (StoredSequence() == 0 || session().is_writing_snapshot()) {
    fleet_->WriteSnapshots();
    std::this_thread::yield();
  }
  EXPECT_EQ(StoredSequence(), 300u);
  EXPECT_EQ(storage_.marks_written(), 1);
  session_.reset();
  Open(100);
  EXPECT_EQ(storage_.marks_written(), 1);
  ExpectKnown(before);
}

TEST_F(MarksTest, ThoseThatGoWithTheFirstPartAreWrittenAgain) {
  Open(20'000);
  const Found before = CreateAndSearch();
  UnloadAll();
  EXPECT_EQ(storage_.marks_written(), 1);
  for (int i = 0; i < 20; ++i) Append(1000);
  session_.reset();
  UnloadAll();
  EXPECT_EQ((*memory_.GetSnapshot(key_))->part_count, 2u);
  EXPECT_EQ(storage_.marks_written(), 2);
  EXPECT_EQ(KnownMarks(), before.marks);
}

TEST_F(MarksTest, UnloadingDoesNotWaitForThoseThatCannotBeWritten) {
  const Found before = CreateAndSearch();
  storage_.Hold();
  for (int i = 1; storage_.held() == 0; ++i) {
    fleet_->UnloadIdle(steady_clock::now() + i * minutes(11));
    std::this_thread::yield();
  }
  storage_.FailOne(Error(StatusCode::kResourceExhausted, "STORAGE_FULL", ""));
  UnloadAll();
  storage_.ReleaseAll();
  EXPECT_EQ(Marks(), "none");
  const Found after = SearchNow();
  EXPECT_TRUE(after.missed);
  EXPECT_EQ(after.answer, before.answer);
}

TEST_F(MarksTest, ThoseThatCannotBeWrittenLeaveTheSnapshot) {
  Open(5000);
  Create();
  for (int i = 0; i < 20; ++i) Append(1000);
  session_.reset();
  UnloadAll();
  ASSERT_EQ((*memory_.GetSnapshot(key_))->part_count, 2u);
  SearchNow();
  storage_.Hold();
  for (int i = 1; storage_.held() == 0; ++i) {
    fleet_->UnloadIdle(steady_clock::now() + i * minutes(11));
    std::this_thread::yield();
  }
  storage_.FailOne(Error(StatusCode::kResourceExhausted, "STORAGE_FULL", ""));
  storage_.ReleaseAll();
  for (int i = 0; i < 6; ++i) Append(1000);
  storage_.Hold();
  while (storage_.held() == 0) {
    fleet_->WriteSnapshots();
    std::this_thread::yield();
  }
  // The part that is new, not the first.
  storage_.ReleaseOne();
  EXPECT_EQ(StoredSequence(), 20'000u);
  storage_.ReleaseAll();
}

TEST_F(MarksTest, NoneAreLeftOfPosesThatWereRevised) {
  CreateAndSearch();
  UnloadAll();
  const auto shift = [](const VehicleView&) -> absl::StatusOr<RevisionPlan> {
    RevisionPlan plan;
    plan.batches = BatchesOf({{1, 300, 0, StraightBatch(1, 300)}});
    plan.revised_count = 300;
    return plan;
  };
  ASSERT_THAT(ReviseNow(session(), shift), IsOk());
  session_.reset();
  EXPECT_EQ(Marks(), "none");
  Open(1000);
  EXPECT_EQ(Marks(), "none");
  EXPECT_EQ(SearchNow().answer, AnswerOfAnother());
}

TEST_F(MarksTest, AVehicleThatIsCreatedAgainHasNoneOfTheOneBefore) {
  CreateAndSearch();
  UnloadAll();
  ASSERT_THAT(DeleteNow(session()), IsOk());
  session_.reset();
  last_ = 0;
  CreateAndSearch();
}

TEST_F(MarksTest, ThoseOfOtherSettingsAreNotUsed) {
  CreateAndSearch();
  UnloadAll();
  const auto longer = [](const VehicleView& view) {
    VehicleConfig config = view.config;
    config.drive.search.sequence_length_meters = 15.0;
    return absl::StatusOr<VehicleConfig>(config);
  };
  ASSERT_THAT(UpdateNow(session(), longer), IsOk());
  session_.reset();
  Open(1000);
  const Found found = SearchNow();
  EXPECT_TRUE(found.missed);
  EXPECT_EQ(found.answer, AnswerOfAnother());
  EXPECT_THAT(TakeWarnings(), ElementsAre(HasSubstr("without its marks: they "
                                                    "are of other settings")));
  Open(1000);
  ExpectKnown(found);
}

TEST_F(MarksTest, DamagedOrForeignBytesAreNotUsed) {
  const Found before = CreateAndSearch();
  UnloadAll();
  const std::string sound = Marks();
  BlockingWrites write(&memory_);
  std::mt19937_64 random = SeededRandom();
  for (int round = 0; round < 30; ++round) {
    SCOPED_TRACE(round);
    std::string bytes = sound;
    switch (round % 3) {
      case 0:
        bytes.resize(static_cast<std::size_t>(
            UniformInt(random, 0, static_cast<int>(bytes.size()) - 1)));
        break;
      case 1:
        // Another vehicle's.
        ++bytes[14];
        break;
      case 2:
        bytes += static_cast<char>(UniformInt(random, 0, 255));
        break;
    }
    ASSERT_THAT(write.PutMarks(key_, bytes), IsOk());
    EXPECT_EQ(KnownMarks(), 0u);
    EXPECT_THAT(TakeWarnings(), ElementsAre(HasSubstr("without its marks")));
    session_.reset();
    UnloadAll();
    // They were replaced, so that nobody is warned again.
    EXPECT_EQ(KnownMarks(), 0u);
    EXPECT_THAT(TakeWarnings(), IsEmpty());
    EXPECT_EQ(SearchNow().answer, before.answer);
    UnloadAll();
  }
}

TEST_F(MarksTest, ServersWithoutSnapshotsNeitherWriteNorUseThem) {
  Open(0);
  CreateAndSearch();
  Open(0);
  EXPECT_EQ(Marks(), "none");
  EXPECT_TRUE(SearchNow().missed);
  Open(1000);
  SearchNow();
  Open(0);
  EXPECT_NE(Marks(), "none");
  EXPECT_TRUE(SearchNow().missed);
}

}  // namespace
}  // namespace revisit::server
