// Vehicles of a group, over a store whose histories take as long to read as a
// test says.
#ifndef REVISIT_TESTS_SERVER_FLEET_GROUP_OF_VEHICLES_H_
#define REVISIT_TESTS_SERVER_FLEET_GROUP_OF_VEHICLES_H_

#include <atomic>
#include <cstdint>
#include <functional>
#include <memory>
#include <mutex>
#include <set>
#include <string>
#include <thread>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "gtest/gtest.h"
#include "server/fleet/group_searches.h"
#include "server/records/group_content.h"
#include "server/sessions/executor.h"
#include "server/sessions/fleet.h"
#include "tests/server/error_matchers.h"
#include "tests/server/memory_storage.h"
#include "tests/server/plain_codec.h"
#include "tests/server/sessions/session_testing.h"
#include "tests/server/storage_testing.h"

namespace revisit::server {

// Counts the reads of rows, and lets them fail; lets batches of all vehicles
// but one be read only while it is not held.
class HeldReads : public MemoryStorage {
 public:
  void HoldAllBut(VehicleKey key) { free_ = key; }
  void Release() { free_ = 0; }
  int held() const { return held_; }

  void FailRows(bool fails) { fails_ = fails; }
  // This one is not found among several.
  void LoseRowOf(const std::string& id) {
    const std::lock_guard<std::mutex> guard(mutex_);
    lost_ = id;
  }
  int reads_of_one_row() const { return reads_of_one_row_; }
  int reads_of_rows() const { return reads_of_rows_; }
  // By these.
  int rows_read() const { return rows_read_; }
  std::set<std::string> last_rows() const {
    const std::lock_guard<std::mutex> guard(mutex_);
    return last_rows_;
  }

  absl::StatusOr<VehicleRecord> GetVehicle(const std::string& id) override {
    ++reads_of_one_row_;
    return MemoryStorage::GetVehicle(id);
  }
  absl::StatusOr<std::vector<VehicleRecord>> GetVehicles(
      const std::set<std::string>& ids) override {
    ++reads_of_rows_;
    rows_read_ += static_cast<int>(ids.size());
    if (fails_) return absl::UnavailableError("the store cannot be reached");
    const std::lock_guard<std::mutex> guard(mutex_);
    last_rows_ = ids;
    std::set<std::string> found = ids;
    found.erase(lost_);
    return MemoryStorage::GetVehicles(found);
  }
  absl::Status ReadBatches(
      VehicleKey key, std::uint64_t first_sequence, std::uint64_t last_sequence,
      BatchVersion version,
      const std::function<bool(BatchRecord)>& visit) override {
    ++held_;
    while (free_ != 0 && free_ != key) std::this_thread::yield();
    --held_;
    return MemoryStorage::ReadBatches(key, first_sequence, last_sequence,
                                      version, visit);
  }

 private:
  // 0: none is held.
  std::atomic<VehicleKey> free_{0};
  std::atomic<int> held_{0};
  std::atomic<bool> fails_{false};
  std::atomic<int> reads_of_one_row_{0};
  std::atomic<int> reads_of_rows_{0};
  std::atomic<int> rows_read_{0};
  mutable std::mutex mutex_;
  std::set<std::string> last_rows_;
  std::string lost_;
};

// Vehicles "a", "b" and "c", members of the group "site", on the same square.
class GroupOfVehicles : public ::testing::Test {
 protected:
  GroupOfVehicles() {
    EXPECT_THAT(groups_.Create("site", EncodeGroupContent({})), IsOk());
    Start();
    for (const char* id : {"a", "b", "c"}) Make(id);
  }

  void Make(const std::string& id) {
    Create(id);
    Append(id, 1, 200);
    Join(id);
  }

  void Create(const std::string& id) {
    VehicleConfig config = TestConfig();
    config.uid = "uid-of-" + id;
    EXPECT_THAT(
        BlockingWrites(&memory_).Create(id, codec_.EncodeVehicle(config)),
        IsOk());
  }

  void Join(const std::string& id) {
    EXPECT_THAT(groups_.Change("site", {AddGroupMember{{KeyOf(id), ""}}}),
                IsOk());
  }

  VehicleKey KeyOf(const std::string& id) {
    return memory_.GetVehicle(id)->key;
  }

  void Append(const std::string& id, std::uint64_t first, std::uint64_t count) {
    EXPECT_THAT(AppendNow(*fleet_->Session(id), SquareBatch(first, count)),
                IsOk());
  }

  // Begins with no vehicle in memory, as a server does.
  void Start() {
    searches_.reset();
    fleet_.reset();
    fleet_ = std::make_unique<Fleet>(&memory_, &codec_, &executor_,
                                     Fleet::Options());
    searches_ = std::make_unique<GroupSearches>(fleet_.get(), &memory_, &codec_,
                                                &executor_, options_);
  }

  GroupSearches::Options options_;
  HeldReads memory_;
  BlockingGroupWrites groups_{&memory_};
  PlainCodec codec_;
  // One for each vehicle that is held, and one more.
  Executor executor_{3};
  std::unique_ptr<Fleet> fleet_;
  std::unique_ptr<GroupSearches> searches_;
};

}  // namespace revisit::server

#endif  // REVISIT_TESTS_SERVER_FLEET_GROUP_OF_VEHICLES_H_
