#include "server/connection_table.h"

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
  ConnectionTable Make(int most, int most_per_address) {
    return ConnectionTable(
        {most, most_per_address, 1000, 10},
        [this](int descriptor) -> std::optional<std::uint64_t> {
          ++asked_;
          const auto found = open_.find(descriptor);
          if (found == open_.end()) return std::nullopt;
          return found->second;
        },
        [this](int descriptor) -> std::optional<std::uint64_t> {
          const auto found = received_.find(descriptor);
          if (found == received_.end()) return std::nullopt;
          return found->second;
        },
        [this](const std::string& remote) -> std::optional<std::uint64_t> {
          ++counted_;
          const auto found = held_.find(remote);
          if (found == held_.end()) return std::nullopt;
          return found->second;
        },
        &progress_);
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

  ConnectionProgress progress_;
  std::map<int, std::uint64_t> open_;
  std::map<int, std::uint64_t> received_;
  std::map<std::string, std::uint64_t> held_;
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

TEST_F(ConnectionTableTest, FindsConnectionsThatBringNothingOfUse) {
  ConnectionTable table = Make(0, 0);
  for (int i = 1; i <= 4; ++i) EXPECT_EQ(Add(&table, i, "1.2.3.4"), "");
  // Of 4, nobody knows how much has come.
  received_ = {{1, 1000}, {2, 1001}, {3, 1001}};
  CountProgress(progress_.Find("ipv4:1.2.3.4:5003"));
  EXPECT_EQ(TakeHarmful(&table), "max-idle-bytes 2 1.2.3.4;");
  EXPECT_EQ(progress_.Find("ipv4:1.2.3.4:5002"), nullptr);
  // Counted from the last progress.
  received_[3] = 2001;
  EXPECT_EQ(TakeHarmful(&table), "");
  received_[3] = 2002;
  received_[1] = 1001;
  // Closed meanwhile.
  open_.erase(1);
  EXPECT_EQ(TakeHarmful(&table), "max-idle-bytes 3 1.2.3.4;");
}

TEST_F(ConnectionTableTest, FindsConnectionsThatHoldTooManyCalls) {
  ConnectionTable table = Make(0, 0);
  for (int i = 1; i <= 3; ++i) EXPECT_EQ(Add(&table, i, "h"), "");
  // Of 3, nobody knows.
  held_ = {{"h:5001", 10}, {"h:5002", 11}};
  received_ = {{1, 500}, {2, 500}, {3, 500}};
  EXPECT_EQ(TakeHarmful(&table), "max-concurrent-streams 2 h;");
  held_["h:5001"] = 11;
  EXPECT_EQ(TakeHarmful(&table), "");
  received_[1] = 620;
  EXPECT_EQ(TakeHarmful(&table), "max-concurrent-streams 1 h;");
}

TEST_F(ConnectionTableTest, CallsAreCountedOnlyWhereEnoughHasComeForThem) {
  ConnectionTable table = Make(0, 0);
  EXPECT_EQ(Add(&table, 1, "h"), "");
  CountProgress(progress_.Find("ipv4:h:5001"));
  for (std::uint64_t bytes = 0; bytes < 12000; bytes += 12) {
    received_[1] = bytes;
    EXPECT_EQ(TakeHarmful(&table), "");
    CountProgress(progress_.Find("ipv4:h:5001"));
  }
  EXPECT_EQ(counted_, 99);
}

TEST(ConnectionProgressTest, KnowsWhomGrpcMeans) {
  EXPECT_EQ(ConnectionProgress::RemoteOf("ipv4:127.0.0.1:80"), "127.0.0.1:80");
  EXPECT_EQ(ConnectionProgress::RemoteOf("ipv6:%5B::1%5D:80"), "::1:80");
  EXPECT_EQ(ConnectionProgress::RemoteOf("ipv6:[::1]:80"), "::1:80");
  EXPECT_EQ(ConnectionProgress::RemoteOf("unix:"), "");
  EXPECT_EQ(ConnectionProgress::RemoteOf("odd"), "odd");
}

TEST(ConnectionProgressTest, NewConnectionTakesThePlaceOfTheOld) {
  ConnectionProgress progress;
  const ProgressCounter old = progress.Open("h:1");
  const ProgressCounter young = progress.Open("h:1");
  CountProgress(progress.Find("ipv4:h:1"));
  EXPECT_EQ(old->load(), 0u);
  EXPECT_EQ(young->load(), 1u);
  progress.Close("h:1", old);
  EXPECT_EQ(progress.Find("ipv4:h:1"), young);
  progress.Close("h:1", young);
  EXPECT_EQ(progress.Find("ipv4:h:1"), nullptr);
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
