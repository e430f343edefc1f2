#include "server/connections/connection_table.h"

#include <algorithm>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <map>
#include <optional>
#include <set>
#include <string>
#include <vector>

#include "gtest/gtest.h"
#include "tests/server/connections/frames.h"

namespace revisit::server {
namespace {

using std::chrono::milliseconds;

class ConnectionTableTest : public ::testing::Test {
 protected:
  ConnectionTable Make(int most, int most_per_address,
                       int most_unadmitted = 0) {
    return ConnectionTable(
        {most, most_per_address, most_unadmitted, work_},
        {[this](int descriptor) -> std::optional<std::uint64_t> {
           ++asked_;
           const auto found = open_.find(descriptor);
           if (found == open_.end()) return std::nullopt;
           return found->second;
         },
         [this](int descriptor) { return left_.count(descriptor) > 0; }},
        [this](int descriptor, const MeterPointer& meter) {
          attached_[descriptor] = meter;
        },
        [this](const std::string& remote) -> std::optional<CallCounts> {
          ++counted_;
          const auto found = calls_.find(remote);
          if (found == calls_.end()) return std::nullopt;
          return found->second;
        },
        &meters_);
  }

  // A new socket with this descriptor; what was refused is closed.
  std::string Add(ConnectionTable* table, int descriptor,
                  const std::string& peer) {
    open_[descriptor] = ++last_cookie_;
    now_ += milliseconds(1);
    const char* why = table->Add(descriptor, peer, 5000 + descriptor, now_);
    if (why == nullptr) return "";
    open_.erase(descriptor);
    return why;
  }

  // A look at all connections, some time later; "BOUND DESCRIPTOR HOST;" of
  // each that is harmful.
  std::string TakeHarmful(ConnectionTable* table,
                          milliseconds later = milliseconds(200)) {
    now_ += later;
    found_ = table->Look(now_);
    std::string text;
    for (const ConnectionTable::Harmful& one : found_.harmful) {
      text += std::string(one.bound) + " " + std::to_string(one.descriptor) +
              " " + one.host + ";";
    }
    return text;
  }

  // max_idle_bytes, max_unadmitted_bytes, credit_bytes, max_held_calls; 160
  // calls of strangers may be held, 10 of one.
  ConnectionMeters meters_{{1000, 500, 100, 10, 1000, 160 * (24 << 10)}};
  std::chrono::nanoseconds work_{0};
  std::map<int, std::uint64_t> open_;
  std::set<int> left_;
  std::map<int, MeterPointer> attached_;
  std::map<std::string, CallCounts> calls_;
  ConnectionTable::Findings found_;
  int counted_ = 0;
  std::uint64_t last_cookie_ = 0;
  int asked_ = 0;
  std::chrono::steady_clock::time_point now_{std::chrono::hours(1)};
};

TEST_F(ConnectionTableTest, WithoutLimitsTakesAll) {
  ConnectionTable table = Make(0, 0);
  for (int i = 0; i < 100; ++i) EXPECT_EQ(Add(&table, i, "a"), "");
  EXPECT_EQ(table.size(), 100u);
}

TEST_F(ConnectionTableTest, TellsOnceOfThoseThatPassedABoundOfTheirMeter) {
  ConnectionTable table = Make(0, 0);
  for (int i = 1; i <= 4; ++i) EXPECT_EQ(Add(&table, i, "h"), "");
  EXPECT_EQ(meters_.Find("ipv4:h:5001"), attached_[1]);
  attached_[1]->CountReceived(500);
  attached_[2]->CountReceived(501);
  attached_[3]->CountProgress();
  attached_[3]->CountReceived(1001);
  // This one is closed before anybody looks.
  attached_[4]->CountReceived(501);
  open_.erase(4);
  const std::string told = TakeHarmful(&table);
  EXPECT_NE(told.find("max-unadmitted-bytes 2 h;"), std::string::npos) << told;
  EXPECT_NE(told.find("max-idle-bytes 3 h;"), std::string::npos) << told;
  EXPECT_NE(told.find("max-unadmitted-bytes -1 h;"), std::string::npos) << told;
  EXPECT_EQ(told.find(" 1 "), std::string::npos) << told;
  EXPECT_EQ(TakeHarmful(&table), "");
  EXPECT_EQ(attached_[4], nullptr);
  EXPECT_EQ(table.size(), 3u);
}

TEST_F(ConnectionTableTest,
       TellsOfAConnectionWhoseDescriptorIsAnothersAlready) {
  ConnectionTable table = Make(0, 0);
  EXPECT_EQ(Add(&table, 1, "harmful"), "");
  attached_[1]->CountReceived(501);
  EXPECT_EQ(Add(&table, 1, "next"), "");
  EXPECT_EQ(TakeHarmful(&table), "max-unadmitted-bytes -1 harmful;");
  EXPECT_EQ(TakeHarmful(&table), "");
}

TEST_F(ConnectionTableTest, FindsConnectionsThatHoldTooManyCalls) {
  ConnectionTable table = Make(0, 0);
  for (int i = 1; i <= 3; ++i) {
    EXPECT_EQ(Add(&table, i, "h"), "");
    attached_[i]->CountProgress();
    BeginCalls(10, 0, attached_[i].get());
  }
  // gRPC does not know of 3.
  calls_ = {{"h:5001", {10, 0}}, {"h:5002", {11, 0}}};
  EXPECT_EQ(TakeHarmful(&table), "max-concurrent-streams 2 h;");
  calls_["h:5001"] = {11, 0};
  EXPECT_EQ(TakeHarmful(&table), "max-concurrent-streams 1 h;");
  EXPECT_EQ(attached_[1]->MayRead(), std::nullopt);
}

TEST_F(ConnectionTableTest, CallsOfAnAdmittedConnectionAreCountedRarely) {
  ConnectionTable table = Make(0, 0);
  EXPECT_EQ(Add(&table, 1, "h"), "");
  attached_[1]->CountProgress();
  CountFrames(kPreface, attached_[1].get());
  for (std::uint64_t i = 0; i < 100; ++i) {
    calls_["h:5001"] = {0, i};
    EXPECT_EQ(TakeHarmful(&table), "");
    CountFrames(Frame(FrameType::kHeaders, 0, kEndHeaders), attached_[1].get());
    attached_[1]->CountProgress();
  }
  // Each time that three quarters of the calls that it may hold have begun.
  EXPECT_EQ(counted_, 14);
}

TEST_F(ConnectionTableTest, StrangerGoesOnOnceItsCallsAreOver) {
  ConnectionTable table = Make(0, 0);
  EXPECT_EQ(Add(&table, 1, "h"), "");
  attached_[1]->Grant(std::chrono::seconds(1));
  BeginCalls(11, 0, attached_[1].get());
  EXPECT_EQ(attached_[1]->MayRead(), 0u);
  calls_["h:5001"] = {10, 0};
  EXPECT_EQ(TakeHarmful(&table, milliseconds(1)), "");
  EXPECT_TRUE(found_.resumed.empty());
  EXPECT_TRUE(found_.is_urgent);
  calls_["h:5001"] = {9, 2};
  EXPECT_EQ(TakeHarmful(&table, milliseconds(1)), "");
  EXPECT_EQ(found_.resumed, std::vector<int>{1});
  EXPECT_FALSE(found_.is_urgent);
}

TEST_F(ConnectionTableTest, StrangerWhoseCallsGoOnHoldingAllTheyMayGoes) {
  ConnectionTable table = Make(0, 0);
  EXPECT_EQ(Add(&table, 1, "h"), "");
  attached_[1]->Grant(std::chrono::seconds(1));
  BeginCalls(11, 0, attached_[1].get());
  calls_["h:5001"] = {10, 0};
  for (int i = 0; i < 6; ++i) {
    // Something comes, so that nothing is settled.
    attached_[1]->CountReceived(1);
    EXPECT_EQ(TakeHarmful(&table, milliseconds(999)), "");
  }
  attached_[1]->CountReceived(1);
  EXPECT_EQ(TakeHarmful(&table, milliseconds(999)),
            "max-unadmitted-calls 1 h;");
}

TEST_F(ConnectionTableTest, StrangerWhoLeavesWhileItWaitsIsLetGo) {
  ConnectionTable table = Make(0, 0);
  for (int i = 1; i <= 2; ++i) {
    EXPECT_EQ(Add(&table, i, "h"), "");
    attached_[i]->Grant(std::chrono::seconds(1));
    BeginCalls(11, 0, attached_[i].get());
    EXPECT_EQ(attached_[i]->MayRead(), 0u);
    calls_["h:" + std::to_string(5000 + i)] = {11, 0};
  }
  calls_ = {{"h:5001", {10, 0}}, {"h:5002", {10, 0}}};
  left_ = {2};
  EXPECT_EQ(TakeHarmful(&table, milliseconds(1)), "");
  EXPECT_EQ(found_.left, std::vector<int>{2});
  EXPECT_EQ(attached_[2]->MayRead(), std::nullopt);
  EXPECT_EQ(TakeHarmful(&table, milliseconds(1)), "");
  EXPECT_TRUE(found_.left.empty());
}

TEST_F(ConnectionTableTest, CallsThatAConnectionLeavesBehindCountUntilTheyGo) {
  ConnectionTable table = Make(0, 0);
  EXPECT_EQ(Add(&table, 1, "h"), "");
  BeginCalls(8, 0, attached_[1].get());
  calls_["h:5001"] = {8, 0};
  open_.erase(1);
  EXPECT_EQ(TakeHarmful(&table), "");
  EXPECT_EQ(table.size(), 0u);
  attached_.clear();
  EXPECT_EQ(meters_.unadmitted().memory, 8u * (24 << 10));
  calls_["h:5001"] = {3, 5};
  EXPECT_EQ(TakeHarmful(&table), "");
  EXPECT_EQ(meters_.unadmitted().memory, 3u * (24 << 10));
  calls_.clear();
  EXPECT_EQ(TakeHarmful(&table), "");
  EXPECT_EQ(meters_.unadmitted().memory, 0u);
}

TEST_F(ConnectionTableTest, WhoHasHadTheLeastProcessorTimeGoesOnFirst) {
  // Five calls a second.
  work_ = std::chrono::microseconds(500);
  ConnectionTable table = Make(0, 0);
  for (int i = 1; i <= 3; ++i) {
    EXPECT_EQ(Add(&table, i, "h"), "");
    attached_[i]->Grant(std::chrono::microseconds(100 * (3 - i)));
    BeginCalls(11 + 3 - static_cast<std::size_t>(i), 0, attached_[i].get());
    EXPECT_EQ(attached_[i]->MayRead(), 0u);
    calls_["h:" + std::to_string(5000 + i)] = {0, 14};
  }
  std::vector<int> order;
  for (int i = 0; i < 40 && order.size() < 3; ++i) {
    EXPECT_EQ(TakeHarmful(&table, milliseconds(100)), "");
    order.insert(order.end(), found_.resumed.begin(), found_.resumed.end());
  }
  EXPECT_EQ(order, (std::vector<int>{3, 2, 1}));
}

TEST_F(ConnectionTableTest, WithoutACallThatIsHeldWhatCameIsForgiven) {
  ConnectionTable table = Make(0, 0);
  EXPECT_EQ(Add(&table, 1, "h"), "");
  for (std::uint64_t i = 1; i <= 10; ++i) {
    attached_[1]->CountReceived(300);
    calls_["h:5001"] = {0, i};
    EXPECT_EQ(TakeHarmful(&table), "");
  }
  calls_["h:5001"] = {1, 10};
  attached_[1]->CountReceived(300);
  EXPECT_EQ(TakeHarmful(&table), "");
  attached_[1]->CountReceived(300);
  EXPECT_EQ(TakeHarmful(&table), "max-unadmitted-bytes 1 h;");
}

TEST_F(ConnectionTableTest, WithoutACallThatEndedNothingIsForgiven) {
  ConnectionTable table = Make(0, 0);
  EXPECT_EQ(Add(&table, 1, "h"), "");
  calls_["h:5001"] = {0, 0};
  attached_[1]->CountReceived(300);
  EXPECT_EQ(TakeHarmful(&table), "");
  attached_[1]->CountReceived(300);
  EXPECT_EQ(TakeHarmful(&table), "max-unadmitted-bytes 1 h;");
}

TEST_F(ConnectionTableTest, OfThoseNotAdmittedTheOldestGo) {
  ConnectionTable table = Make(0, 0, 2);
  for (int i = 1; i <= 4; ++i) EXPECT_EQ(Add(&table, i, "h"), "");
  // No more than twice as many are there at any time.
  EXPECT_EQ(Add(&table, 5, "h"), "max-unadmitted-connections");
  attached_[1]->CountProgress();
  EXPECT_EQ(TakeHarmful(&table), "max-unadmitted-connections 2 h;");
  EXPECT_EQ(TakeHarmful(&table), "");
}

TEST_F(ConnectionTableTest, OfThoseNotAdmittedWhoseCallsHoldTheMostGo) {
  ConnectionTable table = Make(0, 0);
  for (int i = 1; i <= 20; ++i) {
    EXPECT_EQ(Add(&table, i, "h"), "");
    const std::uint64_t calls = i <= 3 ? 9 : 8;
    BeginCalls(calls, 0, attached_[i].get());
    calls_["h:" + std::to_string(5000 + i)] = {calls, 0};
  }
  // Calls of this one are not among them.
  attached_[1]->CountProgress();
  // They are young, and hold little each.
  EXPECT_EQ(TakeHarmful(&table), "");
  EXPECT_EQ(Add(&table, 21, "h"), "");
  BeginCalls(9, 0, attached_[21].get());
  now_ += milliseconds(2000);
  const std::string told = TakeHarmful(&table);
  for (const char* const one : {" 2 h;", " 3 h;", " 21 h;"}) {
    EXPECT_NE(told.find(std::string("max-unadmitted-calls") + one),
              std::string::npos)
        << told;
  }
  EXPECT_EQ(told.find(" 1 h;"), std::string::npos) << told;
  // Half of what they may hold is left.
  EXPECT_EQ(std::count(told.begin(), told.end(), ';'), 10);
}

TEST_F(ConnectionTableTest, RefusesWhatIsTooMuchUntilOneIsClosed) {
  ConnectionTable table = Make(3, 0);
  for (int i = 0; i < 3; ++i) EXPECT_EQ(Add(&table, i, "a"), "");
  EXPECT_EQ(Add(&table, 3, "b"), "max-connections");
  open_.erase(1);
  now_ += milliseconds(60);
  EXPECT_EQ(Add(&table, 3, "b"), "");
  EXPECT_EQ(Add(&table, 4, "b"), "max-connections");
}

TEST_F(ConnectionTableTest, CountsAnAddressByItself) {
  ConnectionTable table = Make(0, 2);
  EXPECT_EQ(Add(&table, 1, "a"), "");
  EXPECT_EQ(Add(&table, 2, "a"), "");
  EXPECT_EQ(Add(&table, 3, "a"), "max-connections-per-address");
  EXPECT_EQ(Add(&table, 3, "b"), "");
  open_.erase(2);
  EXPECT_EQ(Add(&table, 2, "a"), "");
  EXPECT_EQ(Add(&table, 4, "a"), "max-connections-per-address");
}

TEST_F(ConnectionTableTest, DescriptorGivenAnewIsAnotherConnection) {
  ConnectionTable table = Make(0, 2);
  EXPECT_EQ(Add(&table, 1, "a"), "");
  EXPECT_EQ(Add(&table, 2, "a"), "");
  // Both closed without a word; one descriptor comes back for somebody else.
  open_.clear();
  EXPECT_EQ(Add(&table, 1, "b"), "");
  EXPECT_EQ(table.size(), 2u);
  // The other is now something that is no connection of this table.
  open_[2] = ++last_cookie_;
  EXPECT_EQ(Add(&table, 3, "a"), "");
  EXPECT_EQ(Add(&table, 4, "a"), "");
  EXPECT_EQ(Add(&table, 5, "a"), "max-connections-per-address");
}

TEST_F(ConnectionTableTest, FloodDoesNotAskAboutAllConnectionsEachTime) {
  ConnectionTable table = Make(100, 0);
  for (int i = 0; i < 100; ++i) EXPECT_EQ(Add(&table, i, "a"), "");
  asked_ = 0;
  // A millisecond apart, as Add() here counts: 1 s.
  for (int i = 0; i < 1000; ++i)
    EXPECT_EQ(Add(&table, 100, "b"), "max-connections");
  EXPECT_LE(asked_, 100 * 21);
}

}  // namespace
}  // namespace revisit::server
