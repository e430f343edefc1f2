#include "server/feed/event_feed.h"

#include <atomic>
#include <chrono>
#include <cstdint>
#include <memory>
#include <optional>
#include <random>
#include <set>
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
  void Write(std::uint64_t check, const std::string& vehicle = "truck") {
    StoredEvent event;
    event.vehicle_id = vehicle;
    event.vehicle_uid = "uid";
    event.candidate.emplace().number = 1;
    event.check_sequence = check;
    WritePayload(EncodeEventRecord(event), vehicle);
  }

  void WritePayload(const std::string& payload,
                    const std::string& vehicle = "truck") {
    const VehicleRecord record = *memory_.GetVehicle(vehicle);
    ChecksWrite write;
    write.before = record.checks;
    write.after = write.before;
    ++write.after.last_event;
    write.events.emplace_back().payload = payload;
    ASSERT_THAT(BlockingWrites(&memory_).PutChecks(record.key, write), IsOk());
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

  // The events of all vehicles.
  static std::optional<std::vector<FeedEventPtr>> Newest(
      const EventFeed& feed, const EventPosition& after, int most) {
    const auto newest = feed.Newest(
        after, {}, [](const FeedEvent&) { return true; }, most);
    if (!newest) return std::nullopt;
    return newest->events;
  }

  // Waits until the feed has so many events behind a position.
  std::vector<FeedEventPtr> Await(const EventFeed& feed,
                                  const EventPosition& after,
                                  std::size_t count) {
    std::optional<std::vector<FeedEventPtr>> newest;
    EXPECT_TRUE(Eventually([&] {
      newest = Newest(feed, after, 99);
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
  EXPECT_EQ(Newest(feed, {}, 9), std::nullopt);
  std::atomic<int> looks{0};
  const EventFeed::WatchId id = feed.Watch([&] { ++looks; });
  EXPECT_TRUE(Eventually([&] { return looks > 3; }));
  feed.Unwatch(id);
  EXPECT_TRUE(Eventually([&] { return !Newest(feed, {}, 9); }));
}

TEST_F(EventFeedTest, TellsWhatComesFromTheFirstWatchOn) {
  EventFeed feed(&storage_, options_);
  Write(1);
  const EventPosition begin = *memory_.LastEvent();
  std::atomic<int> looks{0};
  const EventFeed::WatchId id = feed.Watch([&] { ++looks; });
  EXPECT_TRUE(Eventually([&] { return Newest(feed, begin, 9).has_value(); }));
  Write(2);
  Write(3);
  const std::vector<FeedEventPtr> events = Await(feed, begin, 2);
  EXPECT_THAT(NamesOf(events), ElementsAre("truck: vehicles/truck/checks/2",
                                           "truck: vehicles/truck/checks/3"));
  EXPECT_GE(events.front()->bytes, events.front()->message.SpaceUsedLong());
  EXPECT_THAT(NamesOf(*Newest(feed, begin, 1)),
              ElementsAre("truck: vehicles/truck/checks/2"));
  EXPECT_THAT(*Newest(feed, events.back()->position, 9), IsEmpty());
  // Earlier ones are for the store to say.
  EXPECT_EQ(Newest(feed, {}, 9), std::nullopt);
  EXPECT_THAT(NamesOf(*feed.Read({}, 2)),
              ElementsAre("truck: vehicles/truck/checks/1",
                          "truck: vehicles/truck/checks/2"));
  feed.Unwatch(id);
}

TEST_F(EventFeedTest, OnlyEventsOfTheVehiclesThatAreAskedForAreLookedAt) {
  ASSERT_TRUE(BlockingWrites(&memory_).Create("van").ok());
  EventFeed feed(&storage_, options_);
  const EventPosition begin = *memory_.LastEvent();
  const EventFeed::WatchId id = feed.Watch([] {});
  EXPECT_TRUE(Eventually([&] { return Newest(feed, begin, 9).has_value(); }));
  for (const std::uint64_t check : {1, 2, 3}) Write(check);
  Write(4, "van");
  Write(5);
  Write(6, "van");
  Write(7);
  const EventPosition end = Await(feed, begin, 7).back()->position;
  int looks = 0;
  const auto all = [&](const FeedEvent&) {
    ++looks;
    return true;
  };
  auto newest = *feed.Newest(begin, {"van", "bus"}, all, 9);
  EXPECT_EQ(looks, 2);
  EXPECT_THAT(
      NamesOf(newest.events),
      ElementsAre("van: vehicles/van/checks/4", "van: vehicles/van/checks/6"));
  EXPECT_EQ(newest.passed, 5);
  EXPECT_EQ(newest.up_to, end);
  // Where not all are taken, those behind the last one are still to come.
  newest = *feed.Newest(begin, {"van"}, all, 1);
  EXPECT_THAT(NamesOf(newest.events),
              ElementsAre("van: vehicles/van/checks/4"));
  EXPECT_EQ(newest.passed, 3);
  EXPECT_EQ(newest.up_to, newest.events.front()->position);
  newest = *feed.Newest(newest.up_to, {"van"}, all, 1);
  EXPECT_THAT(NamesOf(newest.events),
              ElementsAre("van: vehicles/van/checks/6"));
  EXPECT_EQ(newest.passed, 2);
  EXPECT_EQ(newest.up_to, end);
  EXPECT_EQ(feed.Newest(end, {"van"}, all, 1)->passed, 0);
  feed.Unwatch(id);
}

TEST_F(EventFeedTest, WhoWantsNoneOfManyEventsComesBehindAThousandAtATime) {
  EventFeed feed(&storage_, options_);
  const EventPosition begin = *memory_.LastEvent();
  const EventFeed::WatchId id = feed.Watch([] {});
  EXPECT_TRUE(Eventually([&] { return Newest(feed, begin, 9).has_value(); }));
  for (std::uint64_t check = 1; check <= 1100; ++check) Write(check);
  const EventPosition end = *memory_.LastEvent();
  EXPECT_TRUE(Eventually([&] {
    const auto all = [](const FeedEvent&) { return true; };
    return feed.Newest(begin, {"truck"}, all, 9999)->events.size() == 1100;
  }));
  const auto last = [&](const FeedEvent& event) {
    return event.position == end;
  };
  auto newest = *feed.Newest(begin, {}, last, 9);
  EXPECT_THAT(newest.events, IsEmpty());
  EXPECT_EQ(newest.passed, 1000);
  newest = *feed.Newest(newest.up_to, {}, last, 9);
  EXPECT_EQ(newest.events.size(), 1u);
  EXPECT_EQ(newest.passed, 99);
  EXPECT_EQ(newest.up_to, end);
  feed.Unwatch(id);
}

TEST_F(EventFeedTest, AFewVehiclesHaveTheEventsThatAreTheirsAmongAll) {
  const std::vector<std::string> vehicles = {"truck", "bus", "car", "van"};
  for (const std::string& vehicle : vehicles) {
    if (vehicle == "truck") continue;
    ASSERT_TRUE(BlockingWrites(&memory_).Create(vehicle).ok());
  }
  const unsigned seed = std::random_device()();
  SCOPED_TRACE(seed);
  std::mt19937 random(seed);
  // Some of the events have to go.
  options_.most_bytes = 20000;
  EventFeed feed(&storage_, options_);
  const EventFeed::WatchId id = feed.Watch([] {});
  EXPECT_TRUE(Eventually([&] { return Newest(feed, {}, 9).has_value(); }));
  for (std::uint64_t check = 1; check <= 200; ++check) {
    Write(check, vehicles[random() % vehicles.size()]);
  }
  const std::vector<FeedEventPtr> read = *feed.Read({}, 999);
  ASSERT_EQ(read.size(), 200u);
  EXPECT_TRUE(Eventually([&] {
    const auto last = Newest(feed, read[198]->position, 9);
    return last.has_value() && last->size() == 1;
  }));
  // The feed has dropped the events before these.
  std::vector<FeedEventPtr> kept;
  for (const FeedEventPtr& event : read) {
    if (Newest(feed, event->position, 9)) kept.push_back(event);
  }
  EXPECT_LT(kept.size(), 150u);
  ASSERT_GT(kept.size(), 5u);
  for (int round = 0; round < 200; ++round) {
    std::set<std::string> asked;
    while (asked.empty()) {
      for (const std::string& vehicle : vehicles) {
        if (random() % 3 == 0) asked.insert(vehicle);
      }
    }
    const std::size_t first = random() % kept.size();
    const auto most = static_cast<std::size_t>(1 + random() % 20);
    const bool odd_only = random() % 2 == 0;
    const auto wanted = [&](const FeedEvent& event) {
      return !odd_only || event.position.number % 2 == 1;
    };
    std::vector<std::string> expected;
    std::int64_t passed = 0;
    EventPosition up_to = kept[first]->position;
    for (std::size_t i = first + 1; i < kept.size() && expected.size() < most;
         ++i) {
      up_to = kept[i]->position;
      if (asked.count(kept[i]->vehicle_id) > 0 && wanted(*kept[i])) {
        expected.push_back(NamesOf({kept[i]}).front());
      } else {
        ++passed;
      }
    }
    const auto newest = feed.Newest(kept[first]->position, asked, wanted,
                                    static_cast<int>(most));
    ASSERT_TRUE(newest.has_value());
    EXPECT_EQ(NamesOf(newest->events), expected);
    if (expected.size() < most) {
      EXPECT_EQ(newest->up_to, up_to);
      EXPECT_EQ(newest->passed, passed);
    } else {
      EXPECT_LE(newest->events.back()->position.order, newest->up_to.order);
      EXPECT_GE(newest->passed, passed);
    }
  }
  feed.Unwatch(id);
}

TEST_F(EventFeedTest, KeepsTheNewestInMemoryAlone) {
  // Some of the events, and not all.
  options_.most_bytes = 4000;
  EventFeed feed(&storage_, options_);
  const EventFeed::WatchId id = feed.Watch([] {});
  EXPECT_TRUE(Eventually([&] { return Newest(feed, {}, 9).has_value(); }));
  for (std::uint64_t check = 1; check <= 20; ++check) Write(check);
  const EventPosition last = *memory_.LastEvent();
  EXPECT_TRUE(Eventually([&] {
    const auto newest = Newest(feed, last, 9);
    return newest && newest->empty() && !Newest(feed, {}, 9);
  }));
  // Who is behind reads the store, until memory covers what is next.
  EventPosition position;
  std::vector<std::string> told;
  while (told.size() < 20) {
    std::vector<FeedEventPtr> events;
    // The feed may not have read so far yet.
    ASSERT_TRUE(Eventually([&] {
      const auto newest = Newest(feed, position, 4);
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
  EXPECT_TRUE(Eventually([&] { return Newest(feed, {}, 9).has_value(); }));
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
  EXPECT_TRUE(Eventually([&] { return Newest(feed, {}, 9).has_value(); }));
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
  EXPECT_TRUE(Eventually([&] { return Newest(feed, {}, 9).has_value(); }));
  Write(1);
  Await(feed, {}, 1);
  feed.Unwatch(id);
  EXPECT_TRUE(Eventually([&] { return !Newest(feed, {}, 9); }));
  Write(2);
  ASSERT_THAT(BlockingWrites(&memory_).DropEvents(1, 9), IsOk());
  EXPECT_THAT(feed.Read({}, 9),
              IsError(StatusCode::kOutOfRange, "CURSOR_TOO_OLD", _));
  const EventPosition last = *memory_.LastEvent();
  const EventFeed::WatchId again = feed.Watch([] {});
  EXPECT_TRUE(Eventually([&] { return Newest(feed, last, 9).has_value(); }));
  Write(3);
  EXPECT_THAT(NamesOf(Await(feed, last, 1)),
              ElementsAre("truck: vehicles/truck/checks/3"));
  feed.Unwatch(again);
}

}  // namespace
}  // namespace revisit::server
