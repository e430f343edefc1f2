#include "server/storage/sqlite/write_ahead_log.h"

#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <fstream>
#include <memory>
#include <optional>
#include <set>
#include <sstream>
#include <string>
#include <vector>

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "server/storage/sqlite/durable_mark.h"
#include "server/storage/sqlite/sqlite_storage.h"
#include "tests/random.h"
#include "tests/server/error_matchers.h"
#include "tests/server/storage_testing.h"
#include "tests/server/temporary_directory.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using ::testing::AllOf;
using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::IsEmpty;

constexpr int kCommits = 10;
constexpr std::size_t kHeader = 32;
constexpr std::size_t kFrame = 24 + 8192;

std::string ReadFile(const std::string& path) {
  std::ifstream in(path, std::ios::binary);
  std::stringstream all;
  all << in.rdbuf();
  return all.str();
}

void WriteFile(const std::string& path, const std::string& bytes) {
  std::ofstream(path, std::ios::binary) << bytes;
}

// What a killed server leaves: a vehicle `truck` with `kCommits` poses, each
// one commit, and `car` with one, all in the log.
class WriteAheadLogTest : public ::testing::Test {
 protected:
  WriteAheadLogTest() {
    const std::string live = directory_.File("live.db");
    absl::StatusOr<std::unique_ptr<Storage>> storage = OpenSqliteStorage(live);
    EXPECT_THAT(storage, IsOk());
    BlockingWrites write(storage->get());
    const VehicleKey car = *write.Create("car");
    EXPECT_THAT(write.Append(car, {1, 1, 2, "a car"}), IsOk());
    const VehicleKey truck = *write.Create("truck");
    for (std::uint64_t i = 1; i <= kCommits; ++i) {
      EXPECT_THAT(write.Append(truck, {i, 1, i + 1, std::string(3000, 'x')}),
                  IsOk());
    }
    database_ = ReadFile(live);
    log_ = ReadFile(live + "-wal");
    mark_ = ReadFile(live + ".mark");
  }

  // A crashed store with this log.
  std::string Crashed(const std::string& log, bool with_mark) const {
    const std::string path = directory_.File("crashed.db");
    for (const char* suffix : {"", "-wal", "-shm", ".mark", ".lock"}) {
      std::filesystem::remove(path + suffix);
    }
    WriteFile(path, database_);
    WriteFile(path + "-wal", log);
    if (with_mark) WriteFile(path + ".mark", mark_);
    return path;
  }

  LogReport Read(const std::string& log) const {
    const std::string path = directory_.File("log");
    WriteFile(path, log);
    return *ReadLog(path);
  }

  // The commit that was flushed last.
  StoreState Flushed() const {
    WriteFile(directory_.File("m.mark"), mark_);
    return *DurableMark::Read(directory_.File("m"));
  }

  // Whether a log ends before that.
  bool IsShort(const LogReport& log) const {
    return log.states.empty() || log.states.back().commit < Flushed().commit;
  }

  std::uint32_t Frames() const {
    return static_cast<std::uint32_t>((log_.size() - kHeader) / kFrame);
  }

  // Says of each frame whether it ends a commit.
  std::vector<bool> Commits() const {
    std::vector<bool> commits;
    for (std::size_t at = kHeader; at < log_.size(); at += kFrame) {
      commits.push_back(log_.substr(at + 4, 4) != std::string(4, '\0'));
    }
    return commits;
  }

  // First frame, from 0, of the commit that is so many from the end.
  std::size_t FirstFrameOfCommitFromEnd(int from_end) const {
    const std::vector<bool> commits = Commits();
    std::size_t frame = commits.size();
    int passed = -1;
    while (frame > 0) {
      if (commits[frame - 1] && ++passed > from_end) break;
      --frame;
    }
    return frame;
  }

  const TemporaryDirectory directory_;
  std::string database_;
  std::string log_;
  std::string mark_;
};

TEST_F(WriteAheadLogTest, EndsWhereTheLastCommitDid) {
  const LogReport report = Read(log_);
  EXPECT_TRUE(report.has_header);
  EXPECT_EQ(report.page_bytes, 8192u);
  EXPECT_EQ(report.end.frames, Frames());
  EXPECT_FALSE(report.has_unfinished_tail);
  EXPECT_EQ(report.damage, "");
  // Each commit says its number.
  ASSERT_EQ(report.states.size(), std::size_t{kCommits + 3});
  EXPECT_TRUE(IsSameCommit(report.states.back(), Flushed()));
  for (std::size_t i = 1; i < report.states.size(); ++i) {
    EXPECT_EQ(report.states[i].commit, report.states[i - 1].commit + 1);
    EXPECT_EQ(report.states[i].previous_run, report.states[i - 1].run);
  }
}

TEST_F(WriteAheadLogTest, NoFileAndNoBytesAreAnEmptyLog) {
  const LogReport none = *ReadLog(directory_.File("none"));
  EXPECT_FALSE(none.has_header);
  EXPECT_EQ(none.damage, "");
  for (const std::size_t bytes : {0, 5, 31}) {
    EXPECT_EQ(Read(log_.substr(0, bytes)).damage, "") << bytes;
  }
  EXPECT_EQ(Read(std::string(100, '\0')).damage, "");
}

TEST_F(WriteAheadLogTest, TakesAsMuchOfACutLogAsThereAreWholeCommits) {
  const std::vector<bool> commits = Commits();
  for (std::size_t size = kHeader; size <= log_.size(); size += 1777) {
    std::uint32_t whole = 0;
    for (std::size_t i = 0; i < (size - kHeader) / kFrame; ++i) {
      if (commits[i]) whole = static_cast<std::uint32_t>(i + 1);
    }
    const LogReport cut = Read(log_.substr(0, size));
    EXPECT_EQ(cut.end.frames, whole) << size;
    EXPECT_EQ(cut.damage, "") << size;
    // A power failure may leave zeros where nothing was written yet.
    const LogReport zeros =
        Read(log_.substr(0, size) + std::string(log_.size() - size, '\0'));
    EXPECT_EQ(zeros.end.frames, whole) << size;
    EXPECT_EQ(zeros.damage, "") << size;
    // It cannot be told from a log that ends there, but for the mark.
    EXPECT_EQ(IsShort(cut), whole < Frames()) << size;
  }
}

TEST_F(WriteAheadLogTest, TellsEveryFlippedBit) {
  std::mt19937_64 random = SeededRandom();
  const auto last_commit =
      static_cast<std::uint32_t>(FirstFrameOfCommitFromEnd(0));
  for (std::size_t at = 0; at < log_.size();
       at += static_cast<std::size_t>(UniformInt(random, 1, 700))) {
    std::string flipped = log_;
    flipped[at] =
        static_cast<char>(flipped[at] ^ (1 << UniformInt(random, 0, 7)));
    const LogReport report = Read(flipped);
    // The mark tells of every one.
    EXPECT_TRUE(!report.damage.empty() || IsShort(report)) << "byte " << at;
    // Without it, one in the last commit looks as if it were still being
    // written; nothing else does.
    if (report.damage.empty()) {
      EXPECT_GE(report.end.frames, last_commit) << "byte " << at;
      EXPECT_TRUE(report.has_unfinished_tail) << "byte " << at;
    }
  }
}

// A power failure tore an unfinished write between two sectors, just where the
// older use of the log below had ended a commit: a frame seemed to end one, and
// the next to begin another, so that the server refused to start.
TEST_F(WriteAheadLogTest, TakesATornFrameForNoCommit) {
  const std::string path = directory_.File("large.db");
  absl::StatusOr<std::unique_ptr<Storage>> storage = OpenSqliteStorage(path);
  ASSERT_THAT(storage, IsOk());
  BlockingWrites write(storage->get());
  const VehicleKey truck = *write.Create("truck");
  const std::uint32_t before = Read(ReadFile(path + "-wal")).end.frames;
  ASSERT_THAT(write.Append(truck, {1, 1, 2, std::string(500'000, 'x')}),
              IsOk());
  const std::string log = ReadFile(path + "-wal");
  // The first 8 bytes of this frame's header end a sector.
  constexpr std::size_t kTorn = kHeader + 41 * kFrame;
  static_assert(kTorn % 512 == 504);
  ASSERT_GT(log.size(), kTorn + 5 * kFrame);
  std::string torn = log;
  torn.replace(kTorn, 8, std::string("\0\0\0\7\0\0\0\11", 8));
  // Alone, and behind another that is not there.
  for (const std::size_t other : {kTorn + 8, kTorn - 2 * kFrame}) {
    torn.replace(other + 1000, 512, std::string(512, '\0'));
    const LogReport report = Read(torn);
    EXPECT_EQ(report.damage, "");
    EXPECT_TRUE(report.has_unfinished_tail);
    EXPECT_EQ(report.end.frames, before);
  }
}

TEST_F(WriteAheadLogTest, TakesTheRestOfAnOlderUseForWhatItIs) {
  // The log starts over at its beginning: the frames behind have other salts.
  std::string older = log_.substr(kHeader);
  for (std::size_t at = 0; at < older.size(); at += kFrame) {
    older[at + 8] = static_cast<char>(older[at + 8] ^ 1);
  }
  const std::size_t kept = kHeader + FirstFrameOfCommitFromEnd(4) * kFrame;
  const LogReport report =
      Read(log_.substr(0, kept) + older.substr(kept - kHeader));
  EXPECT_EQ(report.damage, "");
  EXPECT_FALSE(report.has_unfinished_tail);
  EXPECT_EQ(report.end.frames, (kept - kHeader) / kFrame);
}

TEST_F(WriteAheadLogTest, MarkThatIsNotWholeSaysNothing) {
  const std::string path = directory_.File("half");
  for (std::size_t size = 0; size < mark_.size(); ++size) {
    WriteFile(path + ".mark", mark_.substr(0, size));
    EXPECT_FALSE(DurableMark::Read(path).has_value());
    std::string flipped = mark_;
    flipped[size] = static_cast<char>(flipped[size] ^ 1);
    WriteFile(path + ".mark", flipped);
    EXPECT_FALSE(DurableMark::Read(path).has_value());
  }
}

TEST_F(WriteAheadLogTest, MarkKeepsWhatWasWrittenLastUntilCleared) {
  const std::string path = directory_.File("store");
  const StoreState first = FirstState(7);
  const StoreState second = NextState(first, 8, /*is_closed=*/false);
  {
    const std::unique_ptr<DurableMark> mark = *DurableMark::Open(path);
    EXPECT_FALSE(DurableMark::Read(path).has_value());
    mark->Write(first);
    mark->Write(second);
  }
  const std::unique_ptr<DurableMark> mark = *DurableMark::Open(path);
  EXPECT_TRUE(IsSameCommit(*DurableMark::Read(path), second));
  EXPECT_THAT(mark->Flush(first), IsOk());
  EXPECT_TRUE(IsSameCommit(*DurableMark::Read(path), first));
  EXPECT_THAT(mark->Clear(), IsOk());
  EXPECT_FALSE(DurableMark::Read(path).has_value());
}

TEST_F(WriteAheadLogTest, RefusesALogThatLostAcknowledgedCommits) {
  const std::size_t cut = kHeader + FirstFrameOfCommitFromEnd(2) * kFrame;
  for (const std::string& log :
       {std::string(), log_.substr(0, cut), log_.substr(0, cut + 100)}) {
    EXPECT_THAT(OpenSqliteStorage(Crashed(log, /*with_mark=*/true)),
                IsError(StatusCode::kDataLoss, "STORE_CORRUPT",
                        AllOf(HasSubstr("crashed.db-wal is"),
                              HasSubstr("commit 14 was flushed"))));
  }
  // Refused, it stays as it was.
  EXPECT_EQ(ReadFile(directory_.File("crashed.db-wal")),
            log_.substr(0, cut + 100));
}

TEST_F(WriteAheadLogTest, NamesTheVehiclesBehindTheDamage) {
  std::string flipped = log_;
  const std::size_t at = kHeader + FirstFrameOfCommitFromEnd(3) * kFrame + 5000;
  flipped[at] = static_cast<char>(flipped[at] ^ 4);
  for (const bool with_mark : {true, false}) {
    const absl::Status refused =
        OpenSqliteStorage(Crashed(flipped, with_mark)).status();
    EXPECT_THAT(refused, IsError(StatusCode::kDataLoss, "STORE_CORRUPT",
                                 HasSubstr("lost changes: truck")));
    EXPECT_EQ(MetadataOf(refused, "vehicles"), "truck");
  }
}

TEST_F(WriteAheadLogTest, GoesOnWithoutWhatIsDamagedWhereTold) {
  std::string flipped = log_;
  const std::size_t at = kHeader + FirstFrameOfCommitFromEnd(3) * kFrame + 5000;
  flipped[at] = static_cast<char>(flipped[at] ^ 4);
  const std::string path = Crashed(flipped, /*with_mark=*/true);
  std::vector<std::string> warnings;
  SqliteOptions options;
  options.drop_damaged_log = true;
  options.warn = [&](const std::string& text) { warnings.push_back(text); };
  {
    const auto storage = OpenSqliteStorage(path, options);
    ASSERT_THAT(storage, IsOk());
    EXPECT_EQ((*storage)->GetVehicle("truck")->durable_sequence,
              static_cast<std::uint64_t>(kCommits - 4));
    EXPECT_EQ((*storage)->GetVehicle("car")->durable_sequence, 1u);
  }
  EXPECT_THAT(warnings, ElementsAre(AllOf(HasSubstr("truck"),
                                          HasSubstr("dropped as told"))));
  // From then on it is a store like any other.
  EXPECT_THAT(OpenSqliteStorage(path), IsOk());
}

TEST_F(WriteAheadLogTest, OpensOnAnUnfinishedTailAndSaysSo) {
  const std::string path =
      Crashed(log_ + log_.substr(kHeader, 3000), /*with_mark=*/true);
  std::vector<std::string> warnings;
  SqliteOptions options;
  options.warn = [&](const std::string& text) { warnings.push_back(text); };
  {
    const auto storage = OpenSqliteStorage(path, options);
    ASSERT_THAT(storage, IsOk());
    EXPECT_EQ((*storage)->GetVehicle("truck")->durable_sequence,
              static_cast<std::uint64_t>(kCommits));
  }
  EXPECT_THAT(warnings, IsEmpty());  // Less than a frame: as if never begun.
  // A frame of a commit that did not get to its end.
  const std::size_t last = FirstFrameOfCommitFromEnd(0);
  ASSERT_LT(last + 1, Frames()) << "the last commit has but one frame";
  const std::string unfinished = log_.substr(0, kHeader + (last + 1) * kFrame);
  EXPECT_THAT(OpenSqliteStorage(Crashed(unfinished, false), options), IsOk());
  EXPECT_THAT(warnings, ElementsAre(HasSubstr("unfinished write")));
}

TEST_F(WriteAheadLogTest, FindsRowsWhereverTheyLie) {
  // All of them: as if nothing in the log could be read.
  LogReport report = Read(log_);
  report.end.frames = 0;
  std::set<std::int64_t> sequences;
  std::set<std::string> ids;
  ASSERT_THAT(VisitRowsBehind(directory_.File("log"), report,
                              [&](const LoggedRow& row) {
                                if (row.table == LoggedRow::Table::kBatches &&
                                    row.vehicle_key == 2) {
                                  sequences.insert(row.first_sequence);
                                }
                                ids.insert(row.id);
                              }),
              IsOk());
  EXPECT_EQ(sequences.size(), static_cast<std::size_t>(kCommits));
  EXPECT_THAT(ids, ElementsAre("", "car", "truck"));
}

TEST_F(WriteAheadLogTest, ReadsGarbageWithoutHarm) {
  std::mt19937_64 random = SeededRandom();
  for (int round = 0; round < 200; ++round) {
    std::string garbage = log_.substr(0, kHeader + 3 * kFrame);
    const int flips = UniformInt(random, 1, 400);
    for (int i = 0; i < flips; ++i) {
      garbage[static_cast<std::size_t>(
          UniformInt(random, 0, static_cast<int>(garbage.size()) - 1))] =
          static_cast<char>(UniformInt(random, 0, 255));
    }
    LogReport report = Read(garbage);
    report.has_header = true;
    report.page_bytes = 8192;
    report.end = Read(log_).end;
    report.end.frames = 0;
    WriteFile(directory_.File("log"), garbage);
    EXPECT_THAT(VisitRowsBehind(directory_.File("log"), report,
                                [](const LoggedRow&) {}),
                IsOk());
  }
}

}  // namespace
}  // namespace revisit::server
