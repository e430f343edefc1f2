#include "server/connections/connection_table.h"

#include <chrono>
#include <map>
#include <optional>
#include <string>

#include "gtest/gtest.h"

namespace revisit::server {
namespace {

using std::chrono::milliseconds;

class ConnectionTableTest : public ::testing::Test {
 protected:
  ConnectionTable Make(int most, int most_per_address,
                       int most_unadmitted = 0) {
    return ConnectionTable(
        {most, most_per_address, most_unadmitted, 10, 30},
        [this](int descriptor) -> std::optional<std::uint64_t> {
          ++asked_;
          const auto found = open_.find(descriptor);
          if (found == open_.end()) return std::nullopt;
          return found->second;
        },
        [this](int descriptor, const MeterPointer& meter) {
          attached_[descriptor] = meter;
        },
        [this](const std::string& remote) -> std::optional<CallCounts> {
          ++counted_;
          const auto found = held_.find(remote);
          if (found == held_.end()) return std::nullopt;
          return CallCounts{found->second, over_};
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

  // "BOUND DESCRIPTOR HOST;" each.
  static std::string TakeHarmful(ConnectionTable* table) {
    std::string text;
    for (const ConnectionTable::Harmful& one : table->TakeHarmful()) {
      text += std::string(one.bound) + " " + std::to_string(one.descriptor) +
              " " + one.host + ";";
    }
    return text;
  }

  ConnectionMeters meters_{{1000, 500, 100}};
  std::map<int, std::uint64_t> open_;
  std::map<int, MeterPointer> attached_;
  std::map<std::string, std::uint64_t> held_;
  std::uint64_t over_ = 0;
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
  for (int i = 1; i <= 3; ++i) EXPECT_EQ(Add(&table, i, "h"), "");
  // Nobody knows of 3.
  held_ = {{"h:5001", 10}, {"h:5002", 11}};
  for (int i = 1; i <= 3; ++i) attached_[i]->CountReceived(400);
  EXPECT_EQ(TakeHarmful(&table), "max-concurrent-streams 2 h;");
  held_["h:5001"] = 11;
  EXPECT_EQ(TakeHarmful(&table), "max-concurrent-streams 1 h;");
}

TEST_F(ConnectionTableTest, CallsOfAnAdmittedConnectionAreCountedRarely) {
  ConnectionTable table = Make(0, 0);
  EXPECT_EQ(Add(&table, 1, "h"), "");
  attached_[1]->CountProgress();
  for (std::uint64_t bytes = 0; bytes < 12000; bytes += 12) {
    EXPECT_EQ(TakeHarmful(&table), "");
    attached_[1]->CountReceived(12);
    attached_[1]->CountProgress();
  }
  EXPECT_EQ(counted_, 99);
}

TEST_F(ConnectionTableTest, WithoutACallThatIsHeldWhatCameIsForgiven) {
  ConnectionTable table = Make(0, 0);
  EXPECT_EQ(Add(&table, 1, "h"), "");
  for (int i = 0; i < 10; ++i) {
    attached_[1]->CountReceived(300);
    held_["h:5001"] = 0;
    ++over_;
    EXPECT_EQ(TakeHarmful(&table), "");
  }
  held_["h:5001"] = 1;
  attached_[1]->CountReceived(300);
  EXPECT_EQ(TakeHarmful(&table), "");
  attached_[1]->CountReceived(300);
  EXPECT_EQ(TakeHarmful(&table), "max-unadmitted-bytes 1 h;");
}

TEST_F(ConnectionTableTest, WithoutACallThatEndedNothingIsForgiven) {
  ConnectionTable table = Make(0, 0);
  EXPECT_EQ(Add(&table, 1, "h"), "");
  held_["h:5001"] = 0;
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

TEST_F(ConnectionTableTest, OfThoseNotAdmittedWhoHoldsTheMostCallsGoes) {
  ConnectionTable table = Make(0, 0);
  for (int i = 1; i <= 5; ++i) {
    EXPECT_EQ(Add(&table, i, "h"), "");
    attached_[i]->CountReceived(300);
    held_["h:" + std::to_string(5000 + i)] = i == 4 ? 9 : 8;
  }
  // Calls of this one are not among them.
  attached_[1]->CountProgress();
  EXPECT_EQ(TakeHarmful(&table), "max-unadmitted-calls 4 h;");
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
