// A vehicle whose checks are stored, for tests of what becomes of them.
#ifndef REVISIT_TESTS_SERVER_SESSIONS_STORED_CHECKS_TESTING_H_
#define REVISIT_TESTS_SERVER_SESSIONS_STORED_CHECKS_TESTING_H_

#include <atomic>
#include <chrono>
#include <cstdint>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "core/drive/drive.h"
#include "core/search/search.h"
#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "server/sessions/fleet.h"
#include "server/sessions/stored_checks.h"
#include "server/sessions/vehicle_session.h"
#include "tests/server/error_matchers.h"
#include "tests/server/held_storage.h"
#include "tests/server/memory_storage.h"
#include "tests/server/plain_check_codec.h"
#include "tests/server/plain_codec.h"
#include "tests/server/sessions/session_testing.h"
#include "tests/server/storage_testing.h"
#include "tests/server/waiting.h"

namespace revisit::server {

inline constexpr std::uint64_t kPoses = 400;

inline VehicleConfig StoringConfig() {
  VehicleConfig config = TestConfig();
  config.checks = ChecksKept::kStored;
  return config;
}

inline absl::Status BrokenDevice() {
  return Error(absl::StatusCode::kUnavailable, "STORE_UNAVAILABLE", "broken");
}

// A vehicle `truck` that drives around a square, over a storage that can be
// held.
class StoredChecksTest : public ::testing::Test {
 protected:
  ~StoredChecksTest() override {
    storage_.ReleaseAll();
    if (session_ != nullptr) CloseNow(*session_);
  }

  void Create(const VehicleConfig& config) {
    EXPECT_THAT(
        BlockingWrites(&memory_).Create("truck", codec_.EncodeVehicle(config)),
        IsOk());
    session_ = Load();
  }

  std::shared_ptr<VehicleSession> Load() {
    StoredChecksPolicy policy = policy_;
    policy.codec = &check_codec_;
    return VehicleSession::Load(
        "truck", &storage_, &codec_, &executor_, VehicleSession::Limits(),
        SnapshotPolicy(),
        std::make_shared<RetentionMonitor>(RetentionMonitor::Reports()),
        [this] { return now_ns_.load(); }, nullptr, policy);
  }

  // As after a restart.
  void Reload() {
    CloseNow(*session_);
    session_ = Load();
  }

  VehicleRecord Record() { return *memory_.GetVehicle("truck"); }

  // Whether all checks that are owed come to be stored.
  bool IsPaid() {
    return Eventually(
        [this] { return session_->check_debt() == 0 && !HasDebtInStore(); });
  }

  bool HasDebtInStore() {
    const Answer<std::int64_t> debt;
    session_->Read([this, debt](const absl::StatusOr<VehicleView>& view) {
      debt.Set(view.ok()
                   ? view->drive.ChecksBehind(Record().checks.checked_sequence)
                   : 0);
    });
    return debt.Get() > 0;
  }

  std::vector<EventRecord> Events() { return *memory_.ReadEvents({}, 9999); }

  std::vector<std::string> EventsOf(std::uint64_t check) {
    std::vector<std::string> texts;
    const std::string prefix = "truck " + std::to_string(check) + "/";
    for (const EventRecord& event : Events()) {
      if (event.payload.rfind(prefix, 0) != 0) continue;
      texts.push_back(event.payload.substr(0, event.payload.find(':')));
    }
    return texts;
  }

  std::vector<CheckRecord> Checks() {
    return *memory_.ListChecks(Record().key, 0, kLastSequence, false, 9999);
  }

  // What searches at the poses where checks were due find now, by pose: those
  // with a candidate that is worth keeping.
  std::map<std::uint64_t, std::string> SearchAnew() {
    const Answer<std::map<std::uint64_t, std::string>> answer;
    session_->Search("test", [=](const absl::StatusOr<VehicleView>& view) {
      std::map<std::uint64_t, std::string> found;
      std::uint64_t after = 0;
      while (const auto due = view->drive.NextCheck(after)) {
        after = due->sequence;
        const auto set =
            view->search->At(due->node, view->config.drive.search, nullptr);
        bool is_kept = false;
        for (const core::Candidate& candidate : set->candidates) {
          is_kept = is_kept || candidate.relative->probability >=
                                   view->config.keep_probability;
        }
        if (is_kept) {
          found[due->sequence] =
              check_codec_.EncodeFound(*view, *set, {}, nullptr);
        }
      }
      answer.Set(std::move(found));
      return true;
    });
    return answer.Get();
  }

  // Each check that is due is stored, and told once, with what a search finds.
  void ExpectAllStoredAndToldOnce() {
    const std::map<std::uint64_t, std::string> anew = SearchAnew();
    ASSERT_THAT(anew, ::testing::Not(::testing::IsEmpty()));
    std::map<std::uint64_t, std::string> stored;
    std::size_t candidates = 0;
    for (const CheckRecord& record : Checks()) {
      const StoredCheck check = *check_codec_.DecodeCheck(record.payload);
      stored[record.sequence] = check.found;
      candidates += check.candidates.size();
      EXPECT_EQ(record.open_count, check.candidates.size());
    }
    EXPECT_EQ(stored, anew);
    const std::vector<EventRecord> events = Events();
    EXPECT_EQ(events.size(), candidates);
    std::map<std::string, int> told;
    for (std::size_t i = 0; i < events.size(); ++i) {
      EXPECT_EQ(events[i].number, i + 1);
      ++told[events[i].payload];
    }
    EXPECT_EQ(told.size(), candidates);
  }

  // The first candidate that was found to be one place of two.
  struct Found {
    std::uint64_t check = 0;
    std::uint64_t matched = 0;
  };
  Found FirstFound() {
    const CheckRecord record = Checks().front();
    return {record.sequence, check_codec_.DecodeCheck(record.payload)
                                 ->candidates.front()
                                 .matched_sequence};
  }

  StoredChecksPolicy policy_;
  // The time of the server's clock.
  std::atomic<std::int64_t> now_ns_{77};
  MemoryStorage memory_;
  HeldStorage storage_{&memory_};
  PlainCodec codec_;
  PlainCheckCodec check_codec_;
  Executor executor_{2};
  std::shared_ptr<VehicleSession> session_;
};

}  // namespace revisit::server

#endif  // REVISIT_TESTS_SERVER_SESSIONS_STORED_CHECKS_TESTING_H_
