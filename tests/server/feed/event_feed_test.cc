#include "server/feed/event_feed.h"

#include <atomic>
#include <chrono>
#include <cstdint>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "server/records/check_records.h"
#include "tests/server/error_matchers.h"
#include "tests/server/held_storage.h"
#include "tests/server/memory_storage.h"
#include "tests/server/storage_testing.h"
#include "tests/server/waiting.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using ::testing::_;
using ::testing::ElementsAre;
using ::testing::IsEmpty;

class EventFeedTest : public ::testing::Test {
 protected:
  EventFeedTest() : key_(*BlockingWrites(&memory_).Create("truck")) {
    options_.period = std::chrono::milliseconds(2);
  }

  // Writes an event of a candidate of the check at this pose.
  void Write(std::uint64_t check) {
    StoredEvent event;
    event.vehicle_id = "truck";
    event.vehicle_uid = "uid";
    event.candidate.emplace().number = 1;
    event.check_sequence = check;
    WritePayload(EncodeEventRecord(event));
  }

  void WritePayload(const std::string& payload) {
    ChecksWrite write;
    write.before = memory_.GetVehicle("truck")->checks;
    write.after = write.before;
    ++write.after.last_event;
    write.events.emplace_back().payload = payload;
    ASSERT_THAT(BlockingWrites(&memory_).PutChecks(key_, write), IsOk());
  }

  static std::vector<std::string> NamesOf(
      const std::vector<FeedEventPtr>& events) {
    std::vector<std::string> names;
    for (const FeedEventPtr& event : events) {
      names.push_back(event->vehicle_id + ": " +
                      event->message.candidate().check());
    }
    return names;
  }

  // Waits until the feed has so many events behind a position.
  std::vector<FeedEventPtr> Await(const EventFeed& feed,
                                  const EventPosition& after,
                                  std::size_t count) {
    std::optional<std::vector<FeedEventPtr>> newest;
    EXPECT_TRUE(Eventually([&] {
      newest = feed.Newest(after, 99);
      return newest && newest->size() >= count;
    }));
    return newest.value_or(std::vector<FeedEventPtr>());
  }

  MemoryStorage memory_;
  HeldStorage storage_{&memory_};
  EventFeed::Options options_;
  const VehicleKey key_;
};

TEST_F(EventFeedTest, ReadsNothingWhileNobodyWatches) {
  EventFeed feed(&storage_, options_);
  Write(1);
  EXPECT_EQ(feed.Newest({}, 9), std::nullopt);
  std::atomic<int> looks{0};
  const EventFeed::WatchId id = feed.Watch([&] { ++looks; });
  EXPECT_TRUE(Eventually([&] { return looks > 3; }));
  feed.Unwatch(id);
  EXPECT_TRUE(Eventually([&] { return !feed.Newest({}, 9); }));
}

TEST_F(EventFeedTest, TellsWhatComesFromTheFirstWatchOn) {
  EventFeed feed(&storage_, options_);
  Write(1);
  const EventPosition begin = *memory_.LastEvent();
  std::atomic<int> looks{0};
  const EventFeed::WatchId id = feed.Watch([&] { ++looks; });
  EXPECT_TRUE(Eventually([&] { return feed.Newest(begin, 9).has_value(); }));
  Write(2);
  Write(3);
  const std::vector<FeedEventPtr> events = Await(feed, begin, 2);
  EXPECT_THAT(NamesOf(events), ElementsAre("truck: vehicles/truck/checks/2",
                                           "truck: vehicles/truck/checks/3"));
  EXPECT_GE(events.front()->bytes, events.front()->message.SpaceUsedLong());
  EXPECT_THAT(NamesOf(*feed.Newest(begin, 1)),
              ElementsAre("truck: vehicles/truck/checks/2"));
  EXPECT_THAT(*feed.Newest(events.back()->position, 9), IsEmpty());
  // Earlier ones are for the store to say.
  EXPECT_EQ(feed.Newest({}, 9), std::nullopt);
  EXPECT_THAT(NamesOf(*feed.Read({}, 2)),
              ElementsAre("truck: vehicles/truck/checks/1",
                          "truck: vehicles/truck/checks/2"));
  feed.Unwatch(id);
}

TEST_F(EventFeedTest, KeepsTheNewestInMemoryAlone) {
  // Some of the events, and not all.
  options_.most_bytes = 4000;
  EventFeed feed(&storage_, options_);
  const EventFeed::WatchId id = feed.Watch([] {});
  EXPECT_TRUE(Eventually([&] { return feed.Newest({}, 9).has_value(); }));
  for (std::uint64_t check = 1; check <= 20; ++check) Write(check);
  const EventPosition last = *memory_.LastEvent();
  EXPECT_TRUE(Eventually([&] {
    const auto newest = feed.Newest(last, 9);
    return newest && newest->empty() && !feed.Newest({}, 9);
  }));
  // Who is behind reads the store, until memory covers what is next.
  EventPosition position;
  std::vector<std::string> told;
  while (told.size() < 20) {
    std::vector<FeedEventPtr> events;
    // The feed may not have read so far yet.
    ASSERT_TRUE(Eventually([&] {
      const auto newest = feed.Newest(position, 4);
      events = newest ? *newest : *feed.Read(position, 4);
      return !events.empty();
    }));
    position = events.back()->position;
    for (const std::string& name : NamesOf(events)) told.push_back(name);
  }
  for (std::size_t i = 0; i < told.size(); ++i) {
    EXPECT_EQ(told[i], "truck: vehicles/truck/checks/" + std::to_string(i + 1));
  }
  feed.Unwatch(id);
}

TEST_F(EventFeedTest, GoesOnAfterTheStoreWasOutOfReach) {
  EventFeed feed(&storage_, options_);
  std::atomic<int> looks{0};
  const EventFeed::WatchId id = feed.Watch([&] { ++looks; });
  EXPECT_TRUE(Eventually([&] { return feed.Newest({}, 9).has_value(); }));
  storage_.FailReads(Error(StatusCode::kUnavailable, "STORE_UNAVAILABLE", "x"));
  Write(1);
  const int before = looks;
  EXPECT_TRUE(Eventually([&] { return looks > before + 2; }));
  EXPECT_THAT(feed.Read({}, 9),
              IsError(StatusCode::kUnavailable, "STORE_UNAVAILABLE", _));
  storage_.FailReads(absl::OkStatus());
  EXPECT_THAT(NamesOf(Await(feed, {}, 1)),
              ElementsAre("truck: vehicles/truck/checks/1"));
  feed.Unwatch(id);
}

TEST_F(EventFeedTest, PassesOverWhatIsNoEvent) {
  EventFeed feed(&storage_, options_);
  const EventFeed::WatchId id = feed.Watch([] {});
  EXPECT_TRUE(Eventually([&] { return feed.Newest({}, 9).has_value(); }));
  WritePayload("\xff");
  Write(2);
  const std::vector<FeedEventPtr> events = Await(feed, {}, 2);
  EXPECT_EQ(events.front()->vehicle_id, "");
  EXPECT_EQ(events.front()->position.number, 1u);
  EXPECT_EQ(events.back()->vehicle_id, "truck");
  feed.Unwatch(id);
}

TEST_F(EventFeedTest, BeginsAnewBehindEventsThatWereDropped) {
  EventFeed feed(&storage_, options_);
  const EventFeed::WatchId id = feed.Watch([] {});
  EXPECT_TRUE(Eventually([&] { return feed.Newest({}, 9).has_value(); }));
  Write(1);
  Await(feed, {}, 1);
  feed.Unwatch(id);
  EXPECT_TRUE(Eventually([&] { return !feed.Newest({}, 9); }));
  Write(2);
  ASSERT_THAT(BlockingWrites(&memory_).DropEvents(1, 9), IsOk());
  EXPECT_THAT(feed.Read({}, 9),
              IsError(StatusCode::kOutOfRange, "CURSOR_TOO_OLD", _));
  const EventPosition last = *memory_.LastEvent();
  const EventFeed::WatchId again = feed.Watch([] {});
  EXPECT_TRUE(Eventually([&] { return feed.Newest(last, 9).has_value(); }));
  Write(3);
  EXPECT_THAT(NamesOf(Await(feed, last, 1)),
              ElementsAre("truck: vehicles/truck/checks/3"));
  feed.Unwatch(again);
}

}  // namespace
}  // namespace revisit::server
