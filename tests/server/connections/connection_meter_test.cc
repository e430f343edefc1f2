#include "server/connections/connection_meter.h"

#include <poll.h>

#include <chrono>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "gtest/gtest.h"
#include "tests/server/connections/frames.h"

namespace revisit::server {
namespace {

// max_idle_bytes, max_unadmitted_bytes, credit_bytes, max_held_calls,
// max_unadmitted_calls, max_unadmitted_memory: 1,600 calls without headers, 100
// of one.
constexpr MeterBounds kBounds{1'000'000, 500'000, 1'000,
                              2'000,     1'000,   1600 * (24 << 10)};

// Grants that never run out.
constexpr ConnectionMeter::Work kPlenty = std::chrono::hours(1);

bool IsAskedForALook(ConnectionMeters* meters) {
  pollfd event{meters->look_event(), POLLIN, 0};
  return poll(&event, 1, 0) == 1;
}

std::string Passed(const MeterPointer& meter) {
  const char* const bound = meter->BoundPassed();
  return bound == nullptr ? "" : bound;
}

TEST(ConnectionMeterTest, UnadmittedMayBringLess) {
  ConnectionMeters meters(kBounds);
  const MeterPointer stranger = meters.Open("h:1");
  const MeterPointer caller = meters.Open("h:2");
  caller->CountProgress();
  for (const MeterPointer& meter : {stranger, caller}) {
    meter->CountReceived(500'000);
  }
  EXPECT_EQ(Passed(stranger), "");
  for (const MeterPointer& meter : {stranger, caller}) meter->CountReceived(1);
  EXPECT_EQ(Passed(stranger), "max-unadmitted-bytes");
  EXPECT_EQ(Passed(caller), "");
  caller->CountReceived(500'000);
  EXPECT_EQ(Passed(caller), "max-idle-bytes");
}

TEST(ConnectionMeterTest, ProgressIsCreditedWithNoMoreThanACallMayBring) {
  ConnectionMeters meters(kBounds);
  const MeterPointer meter = meters.Open("h:1");
  meter->CountProgress();
  for (int i = 0; i < 1000; ++i) {
    meter->CountReceived(1'000);
    meter->CountProgress();
  }
  // Nor is anything saved up.
  EXPECT_FALSE(meter->standing().is_half_way);
  for (int i = 0; i < 999; ++i) {
    meter->CountReceived(2'000);
    meter->CountProgress();
  }
  EXPECT_EQ(Passed(meter), "");
  meter->CountReceived(2'000);
  EXPECT_EQ(Passed(meter), "max-idle-bytes");
  // For good.
  meter->Forgive();
  EXPECT_EQ(Passed(meter), "max-idle-bytes");
}

TEST(ConnectionMeterTest, AllUnadmittedShareABound) {
  ConnectionMeters meters(kBounds);
  std::vector<MeterPointer> strangers;
  for (int i = 0; i < 5; ++i) {
    strangers.push_back(meters.Open("h:" + std::to_string(i)));
    strangers.back()->CountReceived(400'000);
    EXPECT_EQ(Passed(strangers.back()), "");
  }
  EXPECT_EQ(meters.unadmitted().bytes, 2'000'000u);
  strangers[2]->CountReceived(1);
  EXPECT_EQ(Passed(strangers[2]), "max-unadmitted-bytes");
  // Whoever has only begun is not to blame.
  const MeterPointer another = meters.Open("h:9");
  another->CountReceived(1'000);
  EXPECT_EQ(Passed(another), "");
  // Nor are those that were let in, whatever they bring, part of it.
  strangers[0]->CountProgress();
  strangers[0]->CountReceived(100'000);
  EXPECT_EQ(Passed(strangers[0]), "");
  EXPECT_EQ(meters.unadmitted().connections, 5u);
  EXPECT_EQ(meters.unadmitted().bytes, 1'601'001u);
}

TEST(ConnectionMeterTest, WhoIsGoneTakesNothing) {
  ConnectionMeters meters(kBounds);
  MeterPointer meter = meters.Open("h:1");
  meter->CountReceived(10);
  meters.Close("h:1", meter);
  EXPECT_EQ(meters.unadmitted().bytes, 10u);
  meter.reset();
  EXPECT_EQ(meters.unadmitted().bytes, 0u);
  EXPECT_EQ(meters.unadmitted().connections, 0u);
}

TEST(ConnectionMeterTest, StrangerWhoseCallsHoldAllTheyMayWaits) {
  ConnectionMeters meters(kBounds);
  const MeterPointer stranger = meters.Open("h:1");
  stranger->Grant(kPlenty);
  BeginCalls(100, 0, stranger.get());
  EXPECT_GT(stranger->MayRead(), 0u);
  EXPECT_FALSE(IsAskedForALook(&meters));
  CountFrames(Frame(FrameType::kHeaders, 0, kEndHeaders), stranger.get());
  EXPECT_EQ(stranger->MayRead(), 0u);
  EXPECT_TRUE(IsAskedForALook(&meters));
  EXPECT_TRUE(stranger->standing().is_full);
  meters.NoteLook();
  EXPECT_FALSE(stranger->Resume());
  // It does not ask again for what is known.
  EXPECT_EQ(stranger->MayRead(), 0u);
  EXPECT_FALSE(IsAskedForALook(&meters));
  stranger->LearnCalls({100, 1}, /*is_settled=*/false);
  EXPECT_TRUE(stranger->Resume());
  EXPECT_FALSE(stranger->Resume());
  EXPECT_GT(stranger->MayRead(), 0u);
}

TEST(ConnectionMeterTest, HeadersCountManyTimesTheirBytes) {
  ConnectionMeters meters(kBounds);
  const MeterPointer stranger = meters.Open("h:1");
  stranger->Grant(kPlenty);
  // 16 KB of them may take 2.6 MB.
  BeginCalls(1, 16384, stranger.get());
  EXPECT_EQ(stranger->MayRead(), 0u);
  EXPECT_EQ(meters.unadmitted().memory, (24u << 10) + 16384 * 160);
}

TEST(ConnectionMeterTest, StrangersWaitWhileAllTogetherHoldTooMuch) {
  ConnectionMeters meters(kBounds);
  std::vector<MeterPointer> strangers;
  for (int i = 0; i < 17; ++i) {
    strangers.push_back(meters.Open("h:" + std::to_string(i)));
    strangers.back()->Grant(kPlenty);
    BeginCalls(95, 0, strangers.back().get());
  }
  EXPECT_EQ(strangers[0]->MayRead(), 0u);
  // Who holds little may go on.
  const MeterPointer another = meters.Open("h:99");
  EXPECT_GT(another->MayRead(), 0u);
  // What one who is gone held is not held any more.
  strangers.pop_back();
  meters.Close("h:16", meters.Find("ipv4:h:16"));
  EXPECT_TRUE(strangers[0]->Resume());
  EXPECT_GT(strangers[0]->MayRead(), 0u);
}

TEST(ConnectionMeterTest, CallerWhoIsLetInHoldsUpNoStranger) {
  ConnectionMeters meters(kBounds);
  const MeterPointer caller = meters.Open("h:1");
  BeginCalls(1000, 0, caller.get());
  EXPECT_EQ(caller->MayRead(), 0u);
  meters.NoteLook();
  caller->CountProgress();
  // Somebody has to have it read again.
  EXPECT_TRUE(IsAskedForALook(&meters));
  EXPECT_TRUE(caller->Resume());
  EXPECT_EQ(caller->MayRead(), ConnectionMeter::kAnyNumber);
  EXPECT_EQ(meters.unadmitted().memory, 0u);
}

TEST(ConnectionMeterTest, CallerWhoBeginsTooManyCallsWaitsUntilTheyAreCounted) {
  ConnectionMeters meters(kBounds);
  const MeterPointer caller = meters.Open("h:1");
  caller->CountProgress();
  BeginCalls(1400, 0, caller.get());
  EXPECT_FALSE(caller->standing().wants_counts);
  CountFrames(Frame(FrameType::kHeaders, 0, kEndHeaders), caller.get());
  for (int i = 0; i < 600; ++i) {
    EXPECT_EQ(caller->MayRead(), ConnectionMeter::kAnyNumber);
    CountFrames(Frame(FrameType::kHeaders, 0, kEndHeaders), caller.get());
  }
  EXPECT_EQ(caller->MayRead(), 0u);
  EXPECT_TRUE(caller->standing().wants_counts);
  caller->LearnCalls({1, 2000}, /*is_settled=*/false);
  EXPECT_TRUE(caller->Resume());
  EXPECT_EQ(Passed(caller), "");
  caller->LearnCalls({2001, 2000}, /*is_settled=*/false);
  EXPECT_EQ(Passed(caller), "max-concurrent-streams");
  EXPECT_EQ(caller->MayRead(), std::nullopt);
}

TEST(ConnectionMeterTest, CallsThatGrpcDoesNotKnowAreNoneOnceItHasActed) {
  ConnectionMeters meters(kBounds);
  const MeterPointer stranger = meters.Open("h:1");
  BeginCalls(100, 0, stranger.get());
  stranger->LearnCalls({10, 0}, /*is_settled=*/false);
  EXPECT_EQ(stranger->standing().memory, 100u * (24 << 10));
  stranger->LearnCalls({10, 0}, /*is_settled=*/true);
  EXPECT_EQ(stranger->standing().memory, 10u * (24 << 10));
}

TEST(ConnectionMeterTest, StrangerPaysWithProcessorTimeThatIsGranted) {
  ConnectionMeters meters(kBounds);
  const MeterPointer stranger = meters.Open("h:1");
  // The first calls are free.
  BeginCalls(9, 0, stranger.get());
  EXPECT_GT(stranger->MayRead(), 0u);
  for (int i = 0; i < 9; ++i) {
    CountFrames(Frame(FrameType::kHeaders, 0, kEndHeaders), stranger.get());
  }
  EXPECT_EQ(stranger->MayRead(), 0u);
  EXPECT_TRUE(stranger->standing().wants_work);
  // A grant does not cancel a debt.
  stranger->Grant(std::chrono::microseconds(100));
  EXPECT_FALSE(stranger->Resume());
  stranger->Grant(std::chrono::milliseconds(1));
  EXPECT_TRUE(stranger->Resume());
}

TEST(ConnectionMeterTest, PingsOfAStrangerEndItsConnection) {
  ConnectionMeters meters(kBounds);
  const MeterPointer stranger = meters.Open("h:1");
  const MeterPointer caller = meters.Open("h:2");
  caller->CountProgress();
  const std::string ping = Frame(FrameType::kPing, 8);
  for (const MeterPointer& meter : {stranger, caller}) {
    CountFrames(kPreface, meter.get());
    for (int i = 0; i < 32; ++i) CountFrames(ping, meter.get());
  }
  // Answers are none.
  for (int i = 0; i < 100; ++i) {
    CountFrames(Frame(FrameType::kPing, 8, kAnswer), stranger.get());
  }
  EXPECT_EQ(Passed(stranger), "");
  for (const MeterPointer& meter : {stranger, caller}) {
    CountFrames(ping, meter.get());
  }
  EXPECT_EQ(Passed(stranger), "max-unadmitted-pings");
  EXPECT_EQ(Passed(caller), "");
}

TEST(ConnectionMeterTest, StrangerWhoBeginsMoreCallsThanItMayHasGoneTooFar) {
  ConnectionMeters meters(kBounds);
  const MeterPointer stranger = meters.Open("h:1");
  BeginCalls(1000, 0, stranger.get());
  EXPECT_EQ(Passed(stranger), "");
  CountFrames(Frame(FrameType::kHeaders, 0, kEndHeaders), stranger.get());
  EXPECT_EQ(Passed(stranger), "max-unadmitted-calls");
}

TEST(ConnectionMeterTest, RestOfAFrameIsReadInOneGo) {
  ConnectionMeters meters(kBounds);
  const MeterPointer stranger = meters.Open("h:1");
  CountFrames(kPreface, stranger.get());
  const std::size_t few = stranger->MayRead().value_or(0);
  const std::string data = Frame(FrameType::kData, 16384);
  CountFrames(data.substr(0, 109), stranger.get());
  EXPECT_EQ(stranger->MayRead(), few + 16284);
}

TEST(ConnectionMeterTest, BoundsMayBeOff) {
  ConnectionMeters meters({0, 0, 1'000, 0, 0, 0});
  const MeterPointer meter = meters.Open("h:1");
  meter->Grant(kPlenty);
  meter->CountReceived(std::uint64_t{1} << 40);
  BeginCalls(100'000, 10, meter.get());
  meter->Grant(kPlenty);
  EXPECT_EQ(Passed(meter), "");
  EXPECT_FALSE(meter->standing().is_half_way);
  EXPECT_GT(meter->MayRead(), 0u);
}

TEST(ConnectionMetersTest, KnowWhomGrpcMeans) {
  EXPECT_EQ(ConnectionMeters::RemoteOf("ipv4:127.0.0.1:80"), "127.0.0.1:80");
  EXPECT_EQ(ConnectionMeters::RemoteOf("ipv6:%5B::1%5D:80"), "::1:80");
  EXPECT_EQ(ConnectionMeters::RemoteOf("ipv6:[::1]:80"), "::1:80");
  EXPECT_EQ(ConnectionMeters::RemoteOf("unix:"), "");
  EXPECT_EQ(ConnectionMeters::RemoteOf("odd"), "odd");
}

TEST(ConnectionMetersTest, NewConnectionTakesThePlaceOfTheOld) {
  ConnectionMeters meters(kBounds);
  const MeterPointer old = meters.Open("h:1");
  const MeterPointer young = meters.Open("h:1");
  EXPECT_EQ(meters.Find("ipv4:h:1"), young);
  meters.Close("h:1", old);
  EXPECT_EQ(meters.Find("ipv4:h:1"), young);
  meters.Close("h:1", young);
  EXPECT_EQ(meters.Find("ipv4:h:1"), nullptr);
}

}  // namespace
}  // namespace revisit::server
