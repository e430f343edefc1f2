// A fleet with one vehicle, whose snapshots and marks are looked at.
#ifndef REVISIT_TESTS_SERVER_SESSIONS_SNAPSHOTS_TESTING_H_
#define REVISIT_TESTS_SERVER_SESSIONS_SNAPSHOTS_TESTING_H_

#include <gtest/gtest.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstdint>
#include <functional>
#include <limits>
#include <memory>
#include <mutex>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "server/sessions/fleet.h"
#include "tests/server/error_matchers.h"
#include "tests/server/held_storage.h"
#include "tests/server/memory_storage.h"
#include "tests/server/plain_codec.h"
#include "tests/server/sessions/session_testing.h"
#include "tests/server/storage_testing.h"

namespace revisit::server {

// Notes where the replays of batches begin, and how often marks are written.
class WatchedStorage final : public HeldStorage {
 public:
  using HeldStorage::HeldStorage;

  absl::Status ReadBatches(
      VehicleKey key, std::uint64_t first_sequence, std::uint64_t last_sequence,
      BatchVersion version,
      const std::function<bool(BatchRecord)>& visit) override {
    {
      const std::lock_guard<std::mutex> guard(mutex_);
      least_read_ = std::min(least_read_, first_sequence);
    }
    return HeldStorage::ReadBatches(key, first_sequence, last_sequence, version,
                                    visit);
  }
  // The least sequence from which batches were read since the last call.
  std::uint64_t TakeLeastRead() {
    const std::lock_guard<std::mutex> guard(mutex_);
    return std::exchange(least_read_, kNone);
  }
  static constexpr std::uint64_t kNone = ~std::uint64_t{0};

  void PutMarks(VehicleKey key, std::string marks, Done done) override {
    ++marks_written_;
    HeldStorage::PutMarks(key, std::move(marks), std::move(done));
  }
  int marks_written() const { return marks_written_; }

 private:
  std::mutex mutex_;
  std::uint64_t least_read_ = kNone;
  std::atomic<int> marks_written_{0};
};

// A fleet with one vehicle.
class SnapshotsTest : public ::testing::Test {
 protected:
  static constexpr char kId[] = "truck";

  SnapshotsTest() : storage_(&memory_) { Open(); }
  ~SnapshotsTest() override { storage_.ReleaseAll(); }

  // Ends the fleet, and begins another.
  void Open(std::uint64_t poses = 50) {
    fleet_.reset();
    Fleet::Options options;
    options.snapshots.poses = poses;
    options.snapshots.most_nodes_per_pose = most_nodes_per_pose_;
    options.snapshots.warn = [this](const std::string& message) {
      const std::lock_guard<std::mutex> guard(mutex_);
      warnings_.push_back(message);
    };
    options.last_snapshots = last_snapshots_;
    fleet_ = std::make_unique<Fleet>(&storage_, &codec_, &executor_, options);
  }
  // Opens the fleet anew as after a crash, by which all is lost that the store
  // does not have.
  void Crash() {
    last_snapshots_ = std::chrono::milliseconds(0);
    Open();
    last_snapshots_ = std::chrono::minutes(1);
    Open();
  }

  void Create() {
    const Answer<absl::StatusOr<Snapshot>> answer;
    fleet_->Create(kId, TestConfig(), TakingCreated(answer));
    ASSERT_THAT(answer.Get(), IsOk());
    key_ = memory_.GetVehicle(kId)->key;
  }
  void Append(std::uint64_t count) {
    ASSERT_THAT(AppendNow(session(), SquareBatch(last_ + 1, count)), IsOk());
    last_ += count;
  }
  // Unloads what nobody uses, as time does.
  void UnloadAll() {
    const auto deadline =
        std::chrono::steady_clock::now() + std::chrono::seconds(60);
    auto now = std::chrono::steady_clock::now();
    while (fleet_->loaded() > 0) {
      ASSERT_LT(std::chrono::steady_clock::now(), deadline);
      now += std::chrono::minutes(11);
      fleet_->UnloadIdle(now);
      std::this_thread::yield();
    }
  }
  VehicleSession& session() { return *(session_ = fleet_->Session(kId)); }
  Snapshot Read() { return *ReadNow(session()); }
  std::string Stored() { return SnapshotOf(memory_, key_); }
  std::uint64_t StoredSequence() {
    const auto snapshot = memory_.GetSnapshot(key_);
    return snapshot.ok() && *snapshot ? (*snapshot)->last_sequence : 0;
  }
  std::vector<std::string> TakeWarnings() {
    const std::lock_guard<std::mutex> guard(mutex_);
    return std::exchange(warnings_, {});
  }
  // The vehicle as it is, and as it is where no snapshot is used.
  void ExpectAsReplayedWhole() {
    const Snapshot loaded = Read();
    Executor executor(2);
    Fleet whole(&memory_, &codec_, &executor, Fleet::Options());
    // Without a policy, loading would remove the snapshot.
    const auto snapshot = *memory_.GetSnapshot(key_);
    std::vector<std::string> parts;
    if (snapshot) {
      ASSERT_THAT(memory_.ReadSnapshotParts(key_, 0, snapshot->part_count,
                                            [&](absl::string_view part) {
                                              parts.emplace_back(part);
                                              return true;
                                            }),
                  IsOk());
    }
    const Snapshot replayed = *ReadNow(*whole.Session(kId));
    EXPECT_EQ(loaded.graph, replayed.graph);
    EXPECT_EQ(loaded.durable_sequence, replayed.durable_sequence);
    EXPECT_EQ(loaded.revision, replayed.revision);
    EXPECT_EQ(loaded.loop_closure_count, replayed.loop_closure_count);
    EXPECT_EQ(loaded.consistency.inflation, replayed.consistency.inflation);
    EXPECT_EQ(loaded.consistency.confirmed, replayed.consistency.confirmed);
    if (!snapshot) return;
    BlockingWrites write(&memory_);
    for (std::uint32_t i = 0; i < parts.size(); ++i) {
      ASSERT_THAT(write.PutSnapshotPart(key_, i, parts[i]), IsOk());
    }
    ASSERT_THAT(write.PutSnapshot(key_, *snapshot), IsOk());
  }

  MemoryStorage memory_;
  WatchedStorage storage_;
  const PlainCodec codec_;
  Executor executor_{2};
  std::mutex mutex_;
  std::vector<std::string> warnings_;
  std::chrono::milliseconds last_snapshots_{std::chrono::minutes(1)};
  double most_nodes_per_pose_ = std::numeric_limits<double>::infinity();
  std::unique_ptr<Fleet> fleet_;
  std::shared_ptr<VehicleSession> session_;
  VehicleKey key_ = 0;
  std::uint64_t last_ = 0;
};

}  // namespace revisit::server

#endif  // REVISIT_TESTS_SERVER_SESSIONS_SNAPSHOTS_TESTING_H_
