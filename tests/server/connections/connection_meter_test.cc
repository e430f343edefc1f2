#include "server/connections/connection_meter.h"

#include <poll.h>

#include <cstdint>
#include <string>
#include <vector>

#include "gtest/gtest.h"

namespace revisit::server {
namespace {

// max_idle_bytes, max_unadmitted_bytes, credit_bytes.
constexpr MeterBounds kBounds{1'000'000, 500'000, 1'000};

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
  EXPECT_FALSE(meter->IsHalfWay());
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

TEST(ConnectionMeterTest, AsksForALookWhereUnadmittedBroughtMuchSinceTheLast) {
  ConnectionMeters meters({0, 0, 1'000});
  const MeterPointer stranger = meters.Open("h:1");
  const MeterPointer caller = meters.Open("h:2");
  caller->CountProgress();
  const auto is_asked_for = [&meters] {
    pollfd event{meters.look_event(), POLLIN, 0};
    return poll(&event, 1, 0) == 1;
  };
  ASSERT_GE(meters.look_event(), 0);
  caller->CountReceived(10 << 20);
  stranger->CountReceived((64 << 10) - 1);
  EXPECT_FALSE(is_asked_for());
  stranger->CountReceived(1);
  EXPECT_TRUE(is_asked_for());
  meters.NoteLook();
  EXPECT_FALSE(is_asked_for());
  stranger->CountReceived(64 << 10);
  EXPECT_TRUE(is_asked_for());
}

TEST(ConnectionMeterTest, BoundsMayBeOff) {
  ConnectionMeters meters({0, 0, 1'000});
  const MeterPointer meter = meters.Open("h:1");
  meter->CountReceived(std::uint64_t{1} << 50);
  EXPECT_EQ(Passed(meter), "");
  EXPECT_FALSE(meter->IsHalfWay());
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
