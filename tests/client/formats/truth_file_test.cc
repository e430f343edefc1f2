#include "client/formats/truth_file.h"

#include <cmath>
#include <fstream>
#include <string>

#include "client/formats/angles.h"
#include "gmock/gmock.h"
#include "gtest/gtest.h"

namespace revisit::client {
namespace {

using ::testing::HasSubstr;

constexpr char kReferenceHeader[] =
    "GPS TOW (s),GPS Week,Latitude (deg),Longitude (deg),Ellipsoid Height (m),"
    "Roll (deg),Heading (deg)\n";

absl::StatusOr<std::vector<TruthPose>> Reference(const std::string& text) {
  return ReadReference(BytesOf(text), "ref.csv", std::nullopt);
}

std::string Words(const absl::Status& status) {
  EXPECT_EQ(status.code(), absl::StatusCode::kInvalidArgument);
  return std::string(status.message());
}

std::string Words(const absl::StatusOr<WithoutTruth>& added) {
  return Words(added.status());
}

TEST(GeodeticTest, SeesADegreeOfLatitudeAndLongitudeFromTheEquator) {
  const GeodeticPosition origin = {0.0, 30.0, 0.0};
  // The equator is a circle of the semi-major axis; along the meridian the
  // radius of curvature is a (1 - e^2).
  const double degree = kPi / 180.0;
  auto enu = EastNorthUp(origin, {0.0, 30.001, 0.0});
  EXPECT_NEAR(enu[0], 6378137.0 * std::sin(0.001 * degree), 1e-6);
  EXPECT_NEAR(enu[1], 0.0, 1e-6);
  EXPECT_NEAR(enu[2], -6378137.0 * (1.0 - std::cos(0.001 * degree)), 1e-6);
  enu = EastNorthUp(origin, {0.001, 30.0, 0.0});
  EXPECT_NEAR(enu[0], 0.0, 1e-6);
  EXPECT_NEAR(enu[1], 6335439.327 * 0.001 * degree, 1e-5);
  enu = EastNorthUp(origin, {0.0, 30.0, 12.5});
  EXPECT_NEAR(enu[2], 12.5, 1e-6);
}

TEST(GeodeticTest, AxesTurnWithTheOrigin) {
  // At 60 degrees north a degree of longitude is about half as long.
  const auto enu = EastNorthUp({60.0, -120.0, 50.0}, {60.0, -119.999, 50.0});
  EXPECT_NEAR(enu[0], 55.8, 0.1);
  EXPECT_NEAR(enu[1], 0.0, 1e-2);
}

TEST(TruthFileTest, ReadsAReferenceWithHeadingFromNorthClockwise) {
  const auto truth = Reference(std::string(kReferenceHeader) +
                               "194670.2, 2270, 35.1, 136.9, 41.4, 0.3, 270\n");
  ASSERT_TRUE(truth.ok()) << truth.status();
  ASSERT_EQ(truth->size(), 1u);
  // 11 July 2023 was a Tuesday.
  EXPECT_EQ((*truth)[0].time_nanoseconds, 1'689'055'470'200'000'000);
  // West.
  EXPECT_NEAR((*truth)[0].pose.heading, -kPi, 1e-12);
}

TEST(TruthFileTest, SaysWhereAReferenceIsWrong) {
  EXPECT_EQ(Words(Reference("").status()), "ref.csv:0: expected a header line");
  EXPECT_EQ(Words(Reference("GPS TOW (s),GPS Week\n").status()),
            "ref.csv:1: expected a column \"Latitude (deg)\"");
  EXPECT_EQ(Words(Reference(std::string(kReferenceHeader) + "1,2\n").status()),
            "ref.csv:2: expected 7 fields as in the header, got 2");
  EXPECT_EQ(
      Words(Reference(std::string(kReferenceHeader) + "1,2270,35,136,41,0,0\n"
                                                      "1,2270,35,136,41,0,0\n")
                .status()),
      "ref.csv:3: expected times that grow");
}

Drive TenSeconds() {
  Drive drive;
  drive.name = "made";
  for (int i = 0; i < 10; ++i) {
    Sample sample;
    sample.time_nanoseconds = i * kNanosecondsPerSecond;
    drive.samples.push_back(sample);
  }
  return drive;
}

TEST(TruthFileTest, InterpolatesTheTruthTheShortWayRound) {
  Drive drive = TenSeconds();
  ASSERT_TRUE(AddTruth({{-500'000'000, {0.0, 0.0, 3.1}},
                        {9'500'000'000, {10.0, 5.0, -3.1}}},
                       &drive)
                  .ok());
  ASSERT_EQ(drive.truth.size(), 10u);
  EXPECT_NEAR(drive.truth[6].x, 6.5, 1e-12);
  EXPECT_NEAR(drive.truth[6].y, 3.25, 1e-12);
  EXPECT_NEAR(drive.truth[2].heading, 3.1 + 0.25 * (2 * kPi - 6.2), 1e-12);
}

TEST(TruthFileTest, PosesOutsideTheTruthAreLeftOutAndCounted) {
  Drive drive = TenSeconds();
  const auto without = AddTruth(
      {{500'000'000, {0.5, 0.0, 0.0}}, {7'500'000'000, {7.5, 0.0, 0.0}}},
      &drive);
  ASSERT_TRUE(without.ok()) << without.status();
  EXPECT_EQ(without->poses_before, 1u);
  EXPECT_EQ(without->poses_after, 2u);
  EXPECT_NEAR(without->seconds_before, 0.5, 1e-9);
  EXPECT_NEAR(without->seconds_after, 1.5, 1e-9);
  ASSERT_EQ(drive.samples.size(), 7u);
  ASSERT_EQ(drive.truth.size(), 7u);
  EXPECT_EQ(drive.samples[0].time_nanoseconds, kNanosecondsPerSecond);
  EXPECT_NEAR(drive.truth[0].x, 1.0, 1e-12);
  EXPECT_NEAR(drive.truth[6].x, 7.0, 1e-12);
}

TEST(TruthFileTest, TruthIsReadByOptionsOfItsOwn) {
  const std::string path = ::testing::TempDir() + "/truth.txt";
  std::ofstream(path) << "1 0 0 5 0 1 0 0 0 0 1 7\n1 0 0 5 0 1 0 0 0 0 1 9\n";
  ReaderOptions options;
  options.rate_hz = 10.0;
  options.conventions.axes = Axes::kCamera;
  const auto truth = ReadTruth(path, options, std::nullopt);
  ASSERT_TRUE(truth.ok()) << truth.status();
  ASSERT_EQ(truth->size(), 2u);
  EXPECT_EQ((*truth)[1].time_nanoseconds, 100'000'000);
  EXPECT_EQ((*truth)[1].pose.x, 9.0);
  EXPECT_EQ((*truth)[1].pose.y, -5.0);
  options.columns = "x=1,y=2";
  options.format = Format::kKitti;
  EXPECT_EQ(Words(ReadTruth(path, options, std::nullopt).status()),
            "--truth-columns goes with --truth-format drive only");
}

TEST(TruthFileTest, RefusesTimesThatDoNotFit) {
  const std::vector<TruthPose> truth = {{-500'000'000, {}},
                                        {3'500'000'000, {}}};
  Drive drive = TenSeconds();
  EXPECT_EQ(Words(AddTruth(truth, &drive)),
            "made: 6 of 10 poses, whose times are 0.000000 to 9.000000 s, lie "
            "outside the truth's times, -0.500000 to 3.500000 s");
  drive.samples[4].time_nanoseconds = 3 * kNanosecondsPerSecond;
  EXPECT_EQ(Words(AddTruth(truth, &drive)), "made: expected times that grow");
  drive = TenSeconds();
  EXPECT_THAT(Words(AddTruth({{std::nullopt, {}}}, &drive)),
              HasSubstr("expected times in both"));
  for (Sample& sample : drive.samples) sample.time_nanoseconds.reset();
  EXPECT_THAT(Words(AddTruth({{std::nullopt, {}}}, &drive)),
              HasSubstr("expected a true pose for each of the 10"));
}

}  // namespace
}  // namespace revisit::client
