#include "server/fleet/stream_checks.h"

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <mutex>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "tests/server/fleet/group_of_vehicles.h"
#include "tests/server/waiting.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using ::testing::_;
using ::testing::ElementsAre;
using ::testing::IsEmpty;

// The outcomes of checks and appends, in the order in which they came.
class Events {
 public:
  void Add(std::string event) {
    const std::lock_guard<std::mutex> guard(mutex_);
    events_.push_back(std::move(event));
  }
  std::vector<std::string> all() const {
    const std::lock_guard<std::mutex> guard(mutex_);
    return events_;
  }
  std::ptrdiff_t CountOf(const std::string& kind) const {
    const std::vector<std::string> events = all();
    return std::count_if(
        events.begin(), events.end(),
        [&](const std::string& event) { return event.rfind(kind, 0) == 0; });
  }
  bool Has(const std::string& event) const {
    const std::vector<std::string> events = all();
    return std::find(events.begin(), events.end(), event) != events.end();
  }

 private:
  mutable std::mutex mutex_;
  std::vector<std::string> events_;
};

// Notes the vehicles whose histories each check has looked in, and those that
// it could not look in: "check 201 in a b, not in c".
class NotedChecks final : public StreamChecks::Observer {
 public:
  explicit NotedChecks(Events* events) : events_(events) {}

  void OnFound(const VehicleView& view, core::CandidateSet set,
               std::chrono::nanoseconds /*duration*/,
               const GroupScope& scope) override {
    const core::Node query = view.drive.graph().node(*set.query);
    std::string event = absl::StrCat(
        "check ", query.sequence + (query.fraction > 0.0 ? 1 : 0), " in");
    for (const auto& history : scope.joined->histories) {
      absl::StrAppend(&event, " ", history->vehicle_id);
    }
    if (!scope.absent.empty()) event += ", not in";
    for (const AbsentMember& member : scope.absent) {
      absl::StrAppend(&event, " ", member.vehicle_id);
    }
    events_->Add(std::move(event));
  }
  void OnIdle(const absl::Status& status) override {
    if (!status.ok()) end = status;
    ++idle;
  }

  std::atomic<int> idle{0};
  absl::Status end;

 private:
  Events* const events_;
};

// Has the checks made that a batch makes fall due.
class CheckedAppend final : public AppendObserver {
 public:
  CheckedAppend(std::shared_ptr<StreamChecks> checks, Events* events)
      : checks_(std::move(checks)), events_(events) {}

  void OnChecksDue(const std::vector<std::uint64_t>& sequences) override {
    checks_->Add(sequences);
  }
  void OnDurable(const absl::StatusOr<Acknowledgement>& result) override {
    EXPECT_THAT(result, IsOk());
    events_->Add(absl::StrCat("ack ", result->durable_sequence));
  }

 private:
  const std::shared_ptr<StreamChecks> checks_;
  Events* const events_;
};

// Vehicle "a" streams.
class StreamChecksTest : public GroupOfVehicles {
 protected:
  ~StreamChecksTest() override {
    if (checks_ == nullptr) return;
    checks_->GiveUp();
    // Checks and appends that are under way note events.
    EXPECT_TRUE(Eventually([&] {
      return checks_->idle() && events_.CountOf("ack") == appended_;
    }));
  }

  void Begin(ScopeRequest scope) {
    session_ = fleet_->Session("a");
    EXPECT_THAT(ReadNow(*session_), IsOk());
    if (!scope.may_read) {
      scope.may_read = [](const std::string&) { return true; };
    }
    const auto decode = [](const VehicleConfig& config) {
      return config.drive.search;
    };
    checks_ = std::make_shared<StreamChecks>(
        session_, searches_.get(),
        std::make_shared<const CheckOrder>(CheckOrder{"checks", decode}),
        std::move(scope), noted_);
  }

  absl::Status Open() {
    const Answer<absl::Status> answer;
    checks_->Open([answer](const absl::Status& status) { answer.Set(status); });
    return answer.Get();
  }

  static ScopeRequest Site() {
    ScopeRequest request;
    request.group = "site";
    request.asking = "a";
    return request;
  }
  // The same, whose scope does not come to be ready while this is held.
  static ScopeRequest HeldSite(const std::atomic<bool>* held) {
    ScopeRequest request = Site();
    request.may_read = [held](const std::string&) {
      while (*held) std::this_thread::yield();
      return true;
    };
    return request;
  }

  void Restart() {
    checks_.reset();
    session_.reset();
    Start();
  }

  // Five poses, the first of which has a check.
  void Append(std::uint64_t first) {
    ++appended_;
    session_->Append(PlainRequest(SquareBatch(first, 5)),
                     std::make_shared<CheckedAppend>(checks_, &events_));
  }

  testing::AssertionResult ComesToBe(const std::string& event) {
    if (Eventually([&] { return events_.Has(event); })) {
      return testing::AssertionSuccess();
    }
    return testing::AssertionFailure()
           << event << " is none of " << testing::PrintToString(events_.all());
  }

  Events events_;
  std::ptrdiff_t appended_ = 0;
  std::shared_ptr<NotedChecks> noted_ = std::make_shared<NotedChecks>(&events_);
  std::shared_ptr<VehicleSession> session_;
  std::shared_ptr<StreamChecks> checks_;
};

TEST_F(StreamChecksTest, AreMadeInTheirOrder) {
  Begin(Site());
  ASSERT_THAT(Open(), IsOk());
  for (const std::uint64_t first : {201, 206, 211, 216}) Append(first);
  ASSERT_TRUE(ComesToBe("check 216 in a b c"));
  std::vector<std::string> made;
  for (const std::string& event : events_.all()) {
    if (event.rfind("check", 0) == 0) made.push_back(event);
  }
  EXPECT_THAT(made, ElementsAre("check 201 in a b c", "check 206 in a b c",
                                "check 211 in a b c", "check 216 in a b c"));
  EXPECT_TRUE(Eventually([&] { return checks_->idle(); }));
}

TEST_F(StreamChecksTest, AcknowledgementsDoNotWaitForThem) {
  std::atomic<bool> held{false};
  Begin(HeldSite(&held));
  ASSERT_THAT(Open(), IsOk());
  held = true;
  for (const std::uint64_t first : {201, 206, 211}) Append(first);
  EXPECT_TRUE(ComesToBe("ack 215"));
  EXPECT_THAT(events_.all(), ElementsAre("ack 205", "ack 210", "ack 215"));
  EXPECT_FALSE(checks_->idle());
  held = false;
  EXPECT_TRUE(ComesToBe("check 211 in a b c"));
}

TEST_F(StreamChecksTest, OpenWaitsForHistoriesUnlessAPartIsAllowed) {
  Restart();
  memory_.HoldAllBut(KeyOf("a"));
  Begin(Site());
  EXPECT_THAT(Open(), IsError(StatusCode::kUnavailable, "GROUP_NOT_READY", _));
  memory_.Release();
  Restart();
  memory_.HoldAllBut(KeyOf("a"));
  ScopeRequest part = Site();
  part.allow_partial = true;
  Begin(part);
  EXPECT_THAT(Open(), IsOk());
  memory_.Release();
}

TEST_F(StreamChecksTest, LookInWhatIsThereWhileHistoriesAreRead) {
  ScopeRequest scope = Site();
  Begin(scope);
  ASSERT_THAT(Open(), IsOk());
  // Nobody has asked for the history of the new member.
  Create("d");
  EXPECT_THAT(BlockingWrites(&memory_).Append(KeyOf("d"),
                                              {1, 200, 2, SquareBatch(1, 200)}),
              IsOk());
  Join("d");
  std::this_thread::sleep_for(std::chrono::milliseconds(1200));
  memory_.HoldAllBut(KeyOf("a"));
  Append(201);
  EXPECT_TRUE(ComesToBe("check 201 in a b c, not in d"));
  Append(206);
  EXPECT_TRUE(ComesToBe("ack 210"));
  EXPECT_THAT(
      events_.all(),
      ElementsAre("ack 205", "check 201 in a b c, not in d", "ack 210"));
  memory_.Release();
  std::uint64_t next = 211;
  EXPECT_TRUE(Eventually([&] {
    Append(next);
    next += 5;
    return events_.all().back().find("in a b c d") != std::string::npos;
  }));
}

TEST_F(StreamChecksTest, AreNoMoreMadeOnceOneCannotBe) {
  std::atomic<bool> held{false};
  ScopeRequest scope = Site();
  scope.vehicles = {"nobody"};
  scope.may_read = [&held](const std::string&) {
    while (held) std::this_thread::yield();
    return true;
  };
  Begin(scope);
  Append(201);
  Append(206);
  ASSERT_TRUE(Eventually([&] { return noted_->idle > 0; }));
  EXPECT_THAT(noted_->end,
              IsError(StatusCode::kNotFound, "MEMBER_NOT_FOUND", _));
  EXPECT_TRUE(checks_->idle());
  EXPECT_TRUE(ComesToBe("ack 210"));
  held = true;
  checks_->Add({150});
  EXPECT_TRUE(checks_->idle());
  held = false;
  EXPECT_THAT(events_.all(), ElementsAre("ack 205", "ack 210"));
}

TEST_F(StreamChecksTest, FollowTheRightsOfTheCaller) {
  Begin(Site());
  Append(201);
  ASSERT_TRUE(ComesToBe("check 201 in a b c"));
  checks_->SetMayRead([](const std::string& id) { return id != "b"; });
  Append(206);
  EXPECT_TRUE(ComesToBe("check 206 in a c"));
}

TEST_F(StreamChecksTest, ThoseWhosePosesAreGoneAreLeftOut) {
  Begin(Site());
  checks_->Add({1000, 1005});
  EXPECT_TRUE(Eventually([&] { return noted_->idle > 0; }));
  EXPECT_THAT(noted_->end, IsOk());
  EXPECT_THAT(events_.all(), IsEmpty());
  Append(201);
  EXPECT_TRUE(ComesToBe("check 201 in a b c"));
}

TEST_F(StreamChecksTest, SeveralAtOnePoseAreOne) {
  Begin(Site());
  checks_->Add({150, 150, 160});
  EXPECT_TRUE(Eventually([&] { return noted_->idle > 0; }));
  EXPECT_THAT(events_.all(),
              ElementsAre("check 150 in a b c", "check 160 in a b c"));
}

TEST_F(StreamChecksTest, AreGivenUp) {
  std::atomic<bool> held{true};
  Begin(HeldSite(&held));
  Append(201);
  Append(206);
  ASSERT_TRUE(ComesToBe("ack 210"));
  checks_->GiveUp();
  EXPECT_FALSE(checks_->idle());
  held = false;
  EXPECT_TRUE(Eventually([&] { return noted_->idle > 0; }));
  EXPECT_TRUE(checks_->idle());
  EXPECT_THAT(noted_->end, IsOk());
  EXPECT_THAT(events_.all(), ElementsAre("ack 205", "ack 210"));
}

}  // namespace
}  // namespace revisit::server
