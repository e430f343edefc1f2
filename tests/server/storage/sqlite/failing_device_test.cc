#include "tests/server/storage/sqlite/failing_device.h"

#include <chrono>
#include <cstdint>
#include <filesystem>
#include <memory>
#include <numeric>
#include <optional>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "tests/random.h"
#include "tests/server/error_matchers.h"
#include "tests/server/storage/sqlite/sqlite_testing.h"
#include "tests/server/storage_testing.h"
#include "tests/server/waiting.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using ::testing::_;
using ::testing::ElementsAre;
using ::testing::HasSubstr;

class FailingDeviceTest : public SqliteStorageTest {
 protected:
  FailingDeviceTest() {
    options_.vfs = FailingDevice::vfs();
    storage_ = MustOpen(Path(), options_);
    key_ = *write().Create("truck");
    EXPECT_THAT(write().Append(key_, {1, 1, 2, "one"}), IsOk());
  }

  BlockingWrites write() { return BlockingWrites(storage_.get()); }
  // With the options as they are now. SQLite flushes the head of a new log by
  // itself: what is written here keeps that from being the flush that is held.
  void OpenAnew() {
    storage_.reset();
    storage_ = MustOpen(Path(), options_);
    EXPECT_THAT(write().Create("spare"), IsOk());
    opened_ = storage_->Counts();
  }
  // Since then.
  std::uint64_t commits() {
    return storage_->Counts().commits - opened_.commits;
  }
  std::uint64_t writes() { return storage_->Counts().writes - opened_.writes; }
  std::vector<std::string> Stored() {
    const absl::StatusOr<VehicleRecord> record = storage_->GetVehicle("truck");
    EXPECT_THAT(record, IsOk());
    std::vector<std::string> payloads;
    const absl::StatusOr<std::vector<BatchRecord>> batches =
        ReadAll(*storage_, key_, 1, record->durable_sequence);
    EXPECT_THAT(batches, IsOk());
    for (const BatchRecord& batch : *batches) {
      payloads.push_back(batch.payload);
    }
    return payloads;
  }

  FailingDevice device_;
  SqliteOptions options_;
  std::unique_ptr<Storage> storage_;
  CommitCounts opened_;
  VehicleKey key_ = 0;
};

const auto kFlushFailed = IsError(StatusCode::kUnavailable, "STORE_SYNC_FAILED",
                                  HasSubstr("takes no more writes"));
const auto kFull = IsError(StatusCode::kResourceExhausted, "STORAGE_FULL",
                           HasSubstr("nothing was written"));

TEST_F(FailingDeviceTest, AcknowledgesNothingBeforeTheFlushReturned) {
  device_.HoldLogFlush();
  const Answer<absl::Status> answer;
  AppendBatch(*storage_, key_, {2, 1, 3, "two"}, std::nullopt, answer.Setter());
  device_.AwaitHeldLogFlush();
  EXPECT_FALSE(answer.IsSet());
  EXPECT_THAT(Stored(), ElementsAre("one"));
  device_.LetLogFlushGo();
  EXPECT_THAT(answer.Get(), IsOk());
  EXPECT_THAT(Stored(), ElementsAre("one", "two"));
}

TEST_F(FailingDeviceTest, FlushesOnceForAllThatWaited) {
  device_.HoldLogFlush();
  std::vector<Answer<absl::Status>> answers(101);
  for (std::uint64_t i = 0; i < answers.size(); ++i) {
    AppendBatch(*storage_, key_, {i + 2, 1, i + 3, "x"}, std::nullopt,
                answers[i].Setter());
    if (i == 0) device_.AwaitHeldLogFlush();
  }
  const int before = device_.log_flushes();
  device_.LetLogFlushGo();
  for (const Answer<absl::Status>& answer : answers) {
    EXPECT_THAT(answer.Get(), IsOk());
  }
  // The one that was held, and one for the hundred behind it.
  EXPECT_EQ(device_.log_flushes() - before, 2);
}

TEST_F(FailingDeviceTest, BatchesThatWaitedTogetherShareARow) {
  storage_.reset();
  options_.max_joined_poses = 5;
  options_.max_joined_bytes = 100;
  storage_ = MustOpen(Path(), options_);
  const VehicleKey other = *write().Create("car");
  device_.HoldLogFlush();
  std::vector<int> order;
  std::vector<Answer<absl::Status>> answers(8);
  const auto append = [&](int number, VehicleKey key, BatchRecord batch) {
    AppendBatch(
        *storage_, key, std::move(batch), std::nullopt,
        [&order, number, answer = answers[static_cast<std::size_t>(number)]](
            absl::Status status) {
          order.push_back(number);
          answer.Set(std::move(status));
        });
  };
  append(0, key_, {2, 1, 3, "held;"});
  device_.AwaitHeldLogFlush();
  append(1, key_, {3, 2, 4, "b;"});
  append(2, other, {1, 1, 2, "car;"});
  append(3, key_, {5, 3, 5, "c;"});
  // A sixth pose has no room.
  append(4, key_, {8, 1, 6, "d;"});
  // Nor have as many bytes.
  append(5, key_, {9, 1, 7, std::string(99, 'e')});
  // One that does not follow is refused alone.
  append(6, key_, {11, 1, 8, "gap"});
  append(7, key_, {10, 1, 8, "f;"});
  device_.LetLogFlushGo();
  for (std::size_t i = 0; i < answers.size(); ++i) {
    if (i == 6) {
      EXPECT_THAT(answers[i].Get(),
                  IsError(StatusCode::kFailedPrecondition, "SEQUENCE_GAP", _));
    } else {
      EXPECT_THAT(answers[i].Get(), IsOk()) << i;
    }
  }
  // Each vehicle's answers come in order.
  order.erase(std::find(order.begin(), order.end(), 2));
  EXPECT_TRUE(std::is_sorted(order.begin(), order.end()));
  EXPECT_THAT(ToTexts(*ReadAll(*storage_, key_, 1, 10)),
              ElementsAre("1+1, revision 2, 'one'", "2+1, revision 3, 'held;'",
                          "3+5, revision 5, 'b;c;'", "8+1, revision 6, 'd;'",
                          "9+1, revision 7, '" + std::string(99, 'e') + "'",
                          "10+1, revision 8, 'f;'"));
  EXPECT_EQ(storage_->GetVehicle("truck")->revision, 8u);
}

TEST_F(FailingDeviceTest, BatchesDoNotJoinARowPastAnotherWrite) {
  storage_.reset();
  options_.max_joined_poses = 100;
  storage_ = MustOpen(Path(), options_);
  device_.HoldLogFlush();
  std::vector<Answer<absl::Status>> answers(4);
  AppendBatch(*storage_, key_, {2, 1, 3, "a"}, std::nullopt,
              answers[0].Setter());
  device_.AwaitHeldLogFlush();
  AppendBatch(*storage_, key_, {3, 1, 4, "b"}, std::nullopt,
              answers[1].Setter());
  // The pose of sequence 4 is not there yet: nothing to revise.
  storage_->ReviseBatches(key_, BatchesOf({{4, 1, 0, "C"}}), 5,
                          answers[2].Setter());
  AppendBatch(*storage_, key_, {4, 1, 6, "c"}, std::nullopt,
              answers[3].Setter());
  device_.LetLogFlushGo();
  EXPECT_THAT(answers[0].Get(), IsOk());
  EXPECT_THAT(answers[1].Get(), IsOk());
  EXPECT_EQ(answers[2].Get().code(), StatusCode::kFailedPrecondition);
  EXPECT_THAT(answers[3].Get(), IsOk());
  EXPECT_THAT(Stored(), ElementsAre("one", "a", "b", "c"));
}

TEST_F(FailingDeviceTest, GathersAsManyAsBeforeWithinTheLatencyTarget) {
  storage_.reset();
  options_.latency_target = std::chrono::hours(1);
  storage_ = MustOpen(Path(), options_);
  const auto append = [&](std::uint64_t sequence) {
    const Answer<absl::Status> answer;
    AppendBatch(*storage_, key_, {sequence, 1, sequence + 1, "x"}, std::nullopt,
                answer.Setter());
    return answer;
  };
  // An idle store waits for nothing.
  EXPECT_THAT(append(2).Get(), IsOk());
  EXPECT_THAT(append(3).Get(), IsOk());
  device_.HoldLogFlush();
  std::vector<Answer<absl::Status>> answers = {append(4)};
  device_.AwaitHeldLogFlush();
  for (std::uint64_t i = 5; i <= 7; ++i) answers.push_back(append(i));
  device_.LetLogFlushGo();
  for (const Answer<absl::Status>& answer : answers) {
    EXPECT_THAT(answer.Get(), IsOk());
  }
  // The last commit held three: so does the next.
  const int before = device_.log_flushes();
  answers = {append(8), append(9)};
  EXPECT_EQ(device_.log_flushes(), before);
  EXPECT_FALSE(answers[0].IsSet());
  answers.push_back(append(10));
  for (const Answer<absl::Status>& answer : answers) {
    EXPECT_THAT(answer.Get(), IsOk());
  }
  EXPECT_EQ(device_.log_flushes(), before + 1);
  // What waits when the store is closed is written all the same.
  const Answer<absl::Status> last = append(11);
  EXPECT_FALSE(last.IsSet());
  storage_.reset();
  EXPECT_THAT(last.Get(), IsOk());
  storage_ = MustOpen(Path(), options_);
  EXPECT_EQ(storage_->GetVehicle("truck")->durable_sequence, 11u);
}

TEST_F(FailingDeviceTest, WaitsNoLongerThanTheLatencyTarget) {
  storage_.reset();
  options_.latency_target = std::chrono::milliseconds(20);
  storage_ = MustOpen(Path(), options_);
  device_.HoldLogFlush();
  std::vector<Answer<absl::Status>> answers(4);
  for (std::uint64_t i = 0; i < answers.size(); ++i) {
    AppendBatch(*storage_, key_, {i + 2, 1, i + 3, "x"}, std::nullopt,
                answers[i].Setter());
    if (i == 0) device_.AwaitHeldLogFlush();
  }
  device_.LetLogFlushGo();
  for (const Answer<absl::Status>& answer : answers) {
    EXPECT_THAT(answer.Get(), IsOk());
  }
  // No second and third come.
  EXPECT_THAT(write().Append(key_, {6, 1, 7, "x"}), IsOk());
}

TEST_F(FailingDeviceTest, FailedFlushFailsAllThatShareARow) {
  options_.max_joined_poses = 100;
  OpenAnew();
  device_.HoldLogFlush();
  std::vector<Answer<absl::Status>> answers(10);
  for (std::uint64_t i = 0; i < answers.size(); ++i) {
    AppendBatch(*storage_, key_, {i + 2, 1, i + 3, "x"}, std::nullopt,
                answers[i].Setter());
    if (i == 0) device_.AwaitHeldLogFlush();
  }
  device_.FailFlushes(true);
  device_.LetLogFlushGo();
  for (const Answer<absl::Status>& answer : answers) {
    EXPECT_THAT(answer.Get(), kFlushFailed);
  }
  EXPECT_EQ(writes(), 0u);
  device_.FailFlushes(false);
  EXPECT_THAT(Stored(), ElementsAre("one"));
  // The one that was held got as far as the log, the row behind it did not.
  storage_.reset();
  storage_ = MustOpen(Path(), options_);
  EXPECT_THAT(Stored(), ElementsAre("one", "x"));
  EXPECT_THAT(write().Append(key_, {3, 1, 4, "two"}), IsOk());
  EXPECT_THAT(Stored(), ElementsAre("one", "x", "two"));
}

TEST_F(FailingDeviceTest, FullDiskRefusesAllThatShareARow) {
  options_.max_joined_poses = 100;
  OpenAnew();
  device_.HoldLogFlush();
  std::vector<Answer<absl::Status>> answers(5);
  for (std::uint64_t i = 0; i < answers.size(); ++i) {
    AppendBatch(*storage_, key_, {i + 2, 1, i + 3, "x"}, std::nullopt,
                answers[i].Setter());
    if (i == 0) device_.AwaitHeldLogFlush();
  }
  device_.FailWrites(true);
  device_.LetLogFlushGo();
  EXPECT_THAT(answers[0].Get(), IsOk());
  for (std::size_t i = 1; i < answers.size(); ++i) {
    EXPECT_THAT(answers[i].Get(), kFull) << i;
  }
  device_.FailWrites(false);
  EXPECT_THAT(Stored(), ElementsAre("one", "x"));
  // What was refused comes again, and nothing takes its place.
  EXPECT_THAT(write().Append(key_, {7, 1, 8, "late"}),
              IsError(StatusCode::kFailedPrecondition, "SEQUENCE_GAP", _));
  EXPECT_THAT(write().Append(key_, {3, 1, 4, "two"}), IsOk());
  EXPECT_THAT(Stored(), ElementsAre("one", "x", "two"));
  EXPECT_EQ(commits(), 2u);
  EXPECT_EQ(writes(), 2u);
}

TEST_F(FailingDeviceTest, RowThatOverflowsAFullDiskIsRefusedWhole) {
  options_.max_joined_poses = 1000;
  options_.max_joined_bytes = std::size_t{64} << 20;
  OpenAnew();
  device_.HoldLogFlush();
  std::vector<Answer<absl::Status>> answers(6);
  // More than SQLite's cache holds: the disk is found full while the row is
  // inserted, and SQLite gives up the transaction by itself.
  for (std::uint64_t i = 0; i < answers.size(); ++i) {
    AppendBatch(*storage_, key_,
                {i + 2, 1, i + 3, i == 0 ? "x" : std::string(1 << 20, 'x')},
                std::nullopt, answers[i].Setter());
    if (i == 0) device_.AwaitHeldLogFlush();
  }
  device_.FailWrites(true);
  device_.LetLogFlushGo();
  EXPECT_THAT(answers[0].Get(), IsOk());
  for (std::size_t i = 1; i < answers.size(); ++i) {
    EXPECT_THAT(answers[i].Get(), kFull) << i;
  }
  device_.FailWrites(false);
  EXPECT_THAT(write().Append(key_, {3, 1, 4, "two"}), IsOk());
  storage_.reset();
  storage_ = MustOpen(Path(), options_);
  EXPECT_THAT(Stored(), ElementsAre("one", "x", "two"));
}

TEST_F(FailingDeviceTest, WithLittleRoomRowsAreRefusedAndDeletionsGoOn) {
  const VehicleKey car = *write().Create("car");
  const VehicleKey bus = *write().Create("bus");
  const VehicleKey van = *write().Create("van");
  const SqliteOptions roomy = options_;
  storage_.reset();
  options_.max_joined_poses = 100;
  options_.min_free_bytes = std::int64_t{1} << 50;
  storage_ = MustOpen(Path(), options_);
  // The head of the log is flushed by itself, and is not what is held.
  EXPECT_THAT(write().Delete(van), IsOk());
  device_.HoldLogFlush();
  const Answer<absl::Status> held;
  storage_->DeleteVehicle(car, {}, held.Setter());
  device_.AwaitHeldLogFlush();
  // One group: a row of two, another write, a row of one.
  std::vector<Answer<absl::Status>> answers(4);
  AppendBatch(*storage_, key_, {2, 1, 3, "a"}, std::nullopt,
              answers[0].Setter());
  AppendBatch(*storage_, key_, {3, 1, 4, "b"}, std::nullopt,
              answers[1].Setter());
  AppendBatch(*storage_, key_, {4, 1, 5, "c"}, "changed", answers[2].Setter());
  const Answer<absl::Status> deleted;
  storage_->DeleteVehicle(bus, {}, deleted.Setter());
  AppendBatch(*storage_, key_, {5, 1, 6, "d"}, std::nullopt,
              answers[3].Setter());
  device_.LetLogFlushGo();
  EXPECT_THAT(held.Get(), IsOk());
  EXPECT_THAT(deleted.Get(), IsOk());
  for (const Answer<absl::Status>& answer : answers) {
    EXPECT_THAT(answer.Get(), kFull);
  }
  EXPECT_THAT(Stored(), ElementsAre("one"));
  EXPECT_EQ(storage_->Counts().commits, 3u);
  EXPECT_EQ(storage_->Counts().writes, 3u);
  storage_.reset();
  storage_ = MustOpen(Path(), roomy);
  EXPECT_THAT(storage_->GetVehicle("bus"),
              IsError(StatusCode::kNotFound, "VEHICLE_NOT_FOUND", _));
  EXPECT_EQ(storage_->GetVehicle("truck")->payload, "payload");
  EXPECT_THAT(write().Append(key_, {2, 1, 3, "two"}), IsOk());
  EXPECT_THAT(Stored(), ElementsAre("one", "two"));
}

TEST_F(FailingDeviceTest, TimesTransactionsAndTheFlushesInThem) {
  const auto sum_of = [](const HistogramCounts& counts) {
    return std::accumulate(counts.counts.begin(), counts.counts.end(),
                           std::uint64_t{0});
  };
  const CommitCounts before = storage_->Counts();
  device_.HoldLogFlush();
  Answer<absl::Status> held;
  AppendBatch(*storage_, key_, {2, 1, 3, "two"}, std::nullopt, held.Setter());
  device_.AwaitHeldLogFlush();
  std::this_thread::sleep_for(std::chrono::milliseconds(20));
  device_.LetLogFlushGo();
  EXPECT_THAT(held.Get(), IsOk());
  // A write that was refused is no transaction that was committed.
  EXPECT_THAT(write().Append(key_, {9, 1, 4, "nine"}),
              IsError(StatusCode::kFailedPrecondition, "SEQUENCE_GAP", _));
  const CommitCounts after = storage_->Counts();
  EXPECT_EQ(after.commits - before.commits, 1u);
  EXPECT_EQ(sum_of(after.flush_seconds) - sum_of(before.flush_seconds), 1u);
  EXPECT_GE(after.flush_seconds.sum - before.flush_seconds.sum, 0.02);
  EXPECT_GE(after.commit_seconds.sum - before.commit_seconds.sum,
            after.flush_seconds.sum - before.flush_seconds.sum);
}

TEST_F(FailingDeviceTest, TellsTheRoomThatItTakesAndHas) {
  const std::optional<StorageRoom> before = storage_->GetRoom();
  ASSERT_TRUE(before);
  EXPECT_GT(before->bytes, 0);
  EXPECT_GT(before->free_bytes, 0);
  EXPECT_THAT(write().Append(key_, {2, 1, 3, std::string(100'000, 'x')}),
              IsOk());
  EXPECT_GE(storage_->GetRoom()->bytes, before->bytes + 100'000);
}

TEST_F(FailingDeviceTest, FailedFlushFailsAllOfTheGroupAndKeepsNothing) {
  device_.HoldLogFlush();
  std::vector<Answer<absl::Status>> answers(4);
  AppendBatch(*storage_, key_, {2, 1, 3, "two"}, std::nullopt,
              answers[0].Setter());
  device_.AwaitHeldLogFlush();
  // These form the next group.
  const Answer<absl::StatusOr<VehicleKey>> created;
  storage_->CreateVehicle({0, "car", "", 1, 0, 0, 0}, created.Setter());
  AppendBatch(*storage_, key_, {3, 1, 4, "three"}, std::nullopt,
              answers[1].Setter());
  device_.FailFlushes(true);
  device_.LetLogFlushGo();
  EXPECT_THAT(answers[0].Get(), kFlushFailed);
  EXPECT_THAT(created.Get(), kFlushFailed);
  EXPECT_THAT(answers[1].Get(), kFlushFailed);
  EXPECT_THAT(Stored(), ElementsAre("one"));
  EXPECT_FALSE(storage_->GetVehicle("car").ok());

  // Opened anew, it goes on from some prefix that holds what was acknowledged:
  // here the first of those that were not, too, for it got as far as the log.
  device_.FailFlushes(false);
  storage_.reset();
  storage_ = MustOpen(Path(), options_);
  EXPECT_THAT(Stored(), ElementsAre("one", "two"));
  EXPECT_THAT(write().Append(key_, {4, 1, 4, "four"}),
              IsError(StatusCode::kFailedPrecondition, "SEQUENCE_GAP", _));
  EXPECT_THAT(write().Append(key_, {3, 1, 4, "three"}), IsOk());
}

TEST_F(FailingDeviceTest, TakesNothingOnAfterAFailedFlushUntilOpenedAnew) {
  int told = 0;
  options_.on_failure = [&](const absl::Status& status) {
    EXPECT_THAT(status, kFlushFailed);
    ++told;
  };
  storage_.reset();
  storage_ = MustOpen(Path(), options_);
  device_.FailFlushes(true);
  EXPECT_THAT(write().Append(key_, {2, 1, 3, "two"}), kFlushFailed);
  // Even if the device works again: what the system's memory shows of the log
  // may not be on it.
  device_.FailFlushes(false);
  for (int i = 0; i < 3; ++i) {
    EXPECT_THAT(write().Append(key_, {2, 1, 3, "two"}), kFlushFailed);
    EXPECT_THAT(Stored(), ElementsAre("one"));
  }
  storage_.reset();
  EXPECT_EQ(told, 1);
  storage_ = MustOpen(Path(), options_);
  EXPECT_THAT(Stored(), ElementsAre("one"));
  EXPECT_THAT(write().Append(key_, {2, 1, 3, "two"}), IsOk());
}

TEST_F(FailingDeviceTest, OpensNoStoreWhoseLogCannotBeFlushed) {
  // A killed server leaves a log of which nobody knows whether it was flushed.
  const std::string crashed = directory_.File("crashed.db");
  std::filesystem::copy_file(Path(), crashed);
  std::filesystem::copy_file(Path() + "-wal", crashed + "-wal");
  device_.FailFlushes(true);
  EXPECT_THAT(OpenSqliteStorage(crashed, options_),
              IsError(StatusCode::kUnavailable, "STORE_SYNC_FAILED",
                      HasSubstr("copying the log")));
  device_.FailFlushes(false);
  EXPECT_THAT((*OpenSqliteStorage(crashed, options_))
                  ->GetVehicle("truck")
                  ->durable_sequence,
              1u);
}

TEST_F(FailingDeviceTest, FullDiskFailsWritesAndNotReads) {
  device_.FailWrites(true);
  EXPECT_THAT(write().Append(key_, {2, 1, 3, std::string(50000, 'x')}), kFull);
  EXPECT_THAT(write().Update(key_, "new", 3), kFull);
  EXPECT_THAT(Stored(), ElementsAre("one"));
  device_.FailWrites(false);
  EXPECT_THAT(write().Append(key_, {2, 1, 3, "two"}), IsOk());
  EXPECT_THAT(Stored(), ElementsAre("one", "two"));
}

TEST_F(FailingDeviceTest, KeepsPrefixWhereverTheDeviceFails) {
  // Fails and works again at random moments, while appends stream in.
  std::mt19937_64 random = SeededRandom();
  std::uint64_t acknowledged = 1;
  std::uint64_t revision = 2;
  for (int round = 0; round < 60; ++round) {
    // Works, from where it was.
    ASSERT_THAT(write().Append(key_, {acknowledged + 1, 1, ++revision, "x"}),
                IsOk());
    ++acknowledged;
    const bool flushes = UniformInt(random, 0, 1) == 0;
    std::vector<Answer<absl::Status>> answers(20);
    const auto fails = static_cast<std::size_t>(UniformInt(random, 0, 19));
    for (std::size_t i = 0; i < answers.size(); ++i) {
      if (i == fails) {
        if (flushes) {
          device_.FailFlushes(true);
        } else {
          device_.FailWrites(true);
        }
      }
      AppendBatch(*storage_, key_, {acknowledged + 1 + i, 1, ++revision, "x"},
                  std::nullopt, answers[i].Setter());
    }
    bool failed = false;
    std::uint64_t landed = 0;
    for (const Answer<absl::Status>& answer : answers) {
      const absl::Status status = answer.Get();
      if (status.ok()) {
        EXPECT_FALSE(failed) << "written behind one that was not";
        ++landed;
      } else {
        failed = true;
        EXPECT_THAT(status.code(),
                    ::testing::AnyOf(StatusCode::kUnavailable,
                                     StatusCode::kResourceExhausted,
                                     StatusCode::kFailedPrecondition));
      }
    }
    device_.FailFlushes(false);
    device_.FailWrites(false);
    acknowledged += landed;
    ASSERT_EQ(storage_->GetVehicle("truck")->durable_sequence, acknowledged);
    if (!flushes) continue;
    storage_.reset();
    storage_ = MustOpen(Path(), options_);
    // The group whose flush failed may have got as far as the log.
    const std::uint64_t stored =
        storage_->GetVehicle("truck")->durable_sequence;
    ASSERT_GE(stored, acknowledged);
    ASSERT_LE(stored, acknowledged - landed + answers.size());
    acknowledged = stored;
  }
  storage_.reset();
  storage_ = MustOpen(Path(), options_);
  EXPECT_EQ(storage_->GetVehicle("truck")->durable_sequence, acknowledged);
  EXPECT_THAT(ReadAll(*storage_, key_, 1, acknowledged), IsOk());
}

}  // namespace
}  // namespace revisit::server
