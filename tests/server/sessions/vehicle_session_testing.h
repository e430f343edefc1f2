// A vehicle in memory for tests of what its session does with it.
#ifndef REVISIT_TESTS_SERVER_SESSIONS_VEHICLE_SESSION_TESTING_H_
#define REVISIT_TESTS_SERVER_SESSIONS_VEHICLE_SESSION_TESTING_H_

#include <memory>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "gtest/gtest.h"
#include "server/base/status.h"
#include "server/sessions/vehicle_session.h"
#include "tests/server/error_matchers.h"
#include "tests/server/held_storage.h"
#include "tests/server/memory_storage.h"
#include "tests/server/plain_codec.h"
#include "tests/server/sessions/session_testing.h"
#include "tests/server/storage_testing.h"

namespace revisit::server {

inline constexpr PairKind kClosure = PairKind::kLoopClosure;
// The uid in TestConfig().
inline constexpr char kUid[] = "uid-of-test";

inline constexpr PairKind kRejection = PairKind::kRejectedCandidate;

inline const absl::Status& DeviceFailure() {
  static const absl::Status* const status =
      new absl::Status(Error(absl::StatusCode::kUnavailable,
                             "STORE_UNAVAILABLE", "the device is broken"));
  return *status;
}

// Shifts the poses of the stored batch that begins with 4 by 200 m.
inline absl::StatusOr<RevisionPlan> ShiftSecondBatch(const VehicleView& view) {
  EXPECT_EQ(view.durable_sequence, 9u);
  RevisionPlan plan;
  plan.batches = BatchesOf({{4, 3, 0, PlainBatch(4, {204, 205, 206})}});
  plan.revised_count = 3;
  return plan;
}

// A vehicle `truck` in a storage that can be held, over one of this test.
class VehicleSessionTest : public ::testing::Test {
 protected:
  VehicleSessionTest() { Create(TestConfig()); }
  ~VehicleSessionTest() override {
    storage_.ReleaseAll();
    if (session_ != nullptr) CloseNow(*session_);
  }

  void Create(const VehicleConfig& config) {
    if (session_ != nullptr) {
      EXPECT_THAT(DeleteNow(*session_), IsOk());
      CloseNow(*session_);
    }
    EXPECT_THAT(
        BlockingWrites(&memory_).Create("truck", codec_.EncodeVehicle(config)),
        IsOk());
    session_ = Load("truck");
  }

  std::shared_ptr<VehicleSession> Load(const std::string& id) {
    return VehicleSession::Load(id, &storage_, &codec_, &executor_, limits_);
  }

  // As after a restart.
  void Reload() {
    CloseNow(*session_);
    session_ = Load("truck");
  }

  std::vector<std::string> Stored() {
    const VehicleRecord record = *memory_.GetVehicle("truck");
    return ToTexts(*ReadAll(memory_, record.key, 1, record.durable_sequence));
  }

  MemoryStorage memory_;
  HeldStorage storage_{&memory_};
  PlainCodec codec_;
  Executor executor_{2};
  VehicleSession::Limits limits_;
  std::shared_ptr<VehicleSession> session_;
};

}  // namespace revisit::server

#endif  // REVISIT_TESTS_SERVER_SESSIONS_VEHICLE_SESSION_TESTING_H_
