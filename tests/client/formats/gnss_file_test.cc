#include "client/formats/gnss_file.h"

#include <cmath>
#include <sstream>
#include <string>

#include "client/formats/angles.h"
#include "gmock/gmock.h"
#include "gtest/gtest.h"

namespace revisit::client {
namespace {

using ::testing::HasSubstr;

constexpr char kPosHeader[] =
    "% program   : made up\n"
    "%\n"
    "%  GPST                  latitude(deg) longitude(deg)  height(m)   Q  ns  "
    " "
    "sdn(m)   sde(m)   sdu(m)  sdne(m)  sdeu(m)  sdun(m) age(s)  ratio    "
    "vn(m/s)    ve(m/s)    vu(m/s)      sdvn     sdve     sdvu    sdvne    "
    "sdveu    sdvun\n";
constexpr char kPosLine[] =
    "2023/07/11 06:04:30.200   35.165393934  136.881442407    39.6452   5  20  "
    " "
    "3.0   4.0   8.3   -1.5   1.6  -1.2   0.00    0.0    3.0    4.0    0.02    "
    "0.1  0.2  0.25  0.05  0.05  0.05\n";
constexpr char kReferenceHeader[] =
    "GPS TOW (s),GPS Week,Latitude (deg),Longitude (deg),Ellipsoid Height (m),"
    "Roll (deg),Heading (deg)\n";

absl::StatusOr<std::vector<GnssFix>> Pos(const std::string& text) {
  std::istringstream input(text);
  return ReadRtklib(input, "a.pos");
}

absl::StatusOr<std::vector<ReferencePose>> Reference(const std::string& text) {
  std::istringstream input(text);
  return ReadReference(input, "ref.csv");
}

template <typename T>
std::string MessageOf(const absl::StatusOr<T>& value) {
  EXPECT_EQ(value.status().code(), absl::StatusCode::kInvalidArgument);
  return std::string(value.status().message());
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

TEST(GnssFileTest, ReadsRtklibWithSignedSquareRoots) {
  const auto fixes = Pos(std::string(kPosHeader) + kPosLine);
  ASSERT_TRUE(fixes.ok()) << fixes.status();
  ASSERT_EQ(fixes->size(), 1u);
  const GnssFix& fix = (*fixes)[0];
  // date -u -d "2023-07-11 06:04:30.2" +%s
  EXPECT_NEAR(fix.time_seconds, 1689055470.2, 1e-6);
  EXPECT_EQ(fix.position.latitude_degrees, 35.165393934);
  EXPECT_EQ(fix.position.longitude_degrees, 136.881442407);
  EXPECT_EQ(fix.position.height_meters, 39.6452);
  EXPECT_THAT(fix.position_covariance,
              ::testing::ElementsAre(16.0, -2.25, 9.0));
  EXPECT_EQ(fix.east_velocity, 4.0);
  EXPECT_EQ(fix.north_velocity, 3.0);
  EXPECT_NEAR(fix.velocity_covariance[0], 0.04, 1e-15);
  EXPECT_NEAR(fix.velocity_covariance[2], 0.01, 1e-15);
}

TEST(GnssFileTest, SaysWhereARtklibFileIsWrong) {
  EXPECT_EQ(MessageOf(Pos("")),
            "a.pos:0: expected at least one epoch after this line");
  EXPECT_THAT(MessageOf(Pos(kPosLine)), HasSubstr("a.pos:1: expected a line"));
  EXPECT_THAT(MessageOf(Pos("%  GPST latitude(deg)\n")),
              HasSubstr("a.pos:1: expected a column \"longitude(deg)\""));
  EXPECT_EQ(MessageOf(Pos(std::string(kPosHeader) + "2023/07/11 06:04:30 1\n")),
            "a.pos:4: expected 24 fields, got 3");
  std::string bad = kPosLine;
  bad.replace(bad.find("39.6452"), 7, "39,6452");
  EXPECT_EQ(MessageOf(Pos(kPosHeader + bad)),
            "a.pos:4: expected a finite number for height(m), got \"39,6452\"");
  bad = kPosLine;
  bad.replace(0, 10, "2023-07-11");
  EXPECT_THAT(MessageOf(Pos(kPosHeader + bad)),
              HasSubstr("a.pos:4: expected a time such as"));
  bad = kPosLine;
  bad.replace(bad.find("35.16"), 5, "95.16");
  EXPECT_THAT(MessageOf(Pos(kPosHeader + bad)),
              HasSubstr("a.pos:4: expected a latitude within 90"));
  EXPECT_THAT(MessageOf(Pos("\x1f\x8b\x08")),
              HasSubstr("the file is compressed"));
}

TEST(GnssFileTest, RefusesRtklibColumnsThatStandTwice) {
  // The columns behind the second were read from beyond the end of a line.
  std::string twice = kPosHeader;
  twice.insert(twice.rfind("sdvn"), "sdn(m) ");
  EXPECT_THAT(MessageOf(Pos(twice + kPosLine)),
              HasSubstr("a.pos:3: column \"sdn(m)\" stands twice"));
}

TEST(GnssFileTest, RefusesDatesWithYearsOutOfRange) {
  std::string bad = kPosLine;
  bad.replace(0, 4, "1e99");
  EXPECT_THAT(MessageOf(Pos(kPosHeader + bad)),
              HasSubstr("a.pos:4: expected a date"));
}

TEST(GnssFileTest, ReadsAReferenceWithHeadingFromNorthClockwise) {
  const auto reference = Reference(std::string(kReferenceHeader) +
                                   "194670.2, 2270, 35.1, 136.9, 41.4, 0.3, "
                                   "270.0\n");
  ASSERT_TRUE(reference.ok()) << reference.status();
  ASSERT_EQ(reference->size(), 1u);
  // The same moment as above: 11 July 2023 was a Tuesday.
  EXPECT_NEAR((*reference)[0].time_seconds, 1689055470.2, 1e-6);
  // West.
  EXPECT_NEAR((*reference)[0].heading, -kPi, 1e-12);
}

TEST(GnssFileTest, SaysWhereAReferenceIsWrong) {
  EXPECT_EQ(MessageOf(Reference("")), "ref.csv:0: expected a header line");
  EXPECT_EQ(MessageOf(Reference("GPS TOW (s),GPS Week\n")),
            "ref.csv:1: expected a column \"Latitude (deg)\"");
  EXPECT_EQ(MessageOf(Reference(std::string(kReferenceHeader) + "1,2\n")),
            "ref.csv:2: expected 7 fields as in the header, got 2");
  EXPECT_EQ(MessageOf(Reference(std::string(kReferenceHeader) +
                                "1,2270,35,136,41,0,0\n"
                                "1,2270,35,136,41,0,0\n")),
            "ref.csv:3: expected times that grow");
}

struct Recording {
  std::vector<GnssFix> fixes;
  std::vector<ReferencePose> reference;
};

// One epoch a second, to the east at 5 m/s but at rest from 3 s to 5 s.
Recording Eastwards() {
  Recording recording;
  for (int i = 0; i < 10; ++i) {
    GnssFix fix;
    fix.time_seconds = i;
    fix.position = {0.0, 1e-5 * i, 0.0};
    fix.position_covariance = {4.0, -1.0, 9.0};
    fix.east_velocity = i < 3 || i > 5 ? 5.0 : 0.3;
    fix.velocity_covariance = {0.01, 0.0, 0.04};
    recording.fixes.push_back(fix);
  }
  recording.reference = {{-0.5, {0.0, 0.0, 0.0}, -0.1},
                         {9.5, {0.0, 1e-4, 0.0}, 0.1}};
  return recording;
}

TEST(GnssFileTest, TakesHeadingAndItsVarianceFromTheVelocity) {
  Recording recording = Eastwards();
  // North-west, with 0.5 m/s of noise along and 0.2 across.
  GnssFix& fix = recording.fixes[1];
  fix.east_velocity = -3.0;
  fix.north_velocity = 3.0;
  fix.velocity_covariance = {0.145, -0.105, 0.145};
  const auto drive = MakeGnssDrive("made", recording.fixes, recording.reference,
                                   {0.0, 0.0, 0.0});
  ASSERT_TRUE(drive.ok()) << drive.status();
  const auto& east = *drive->samples[0].covariance;
  EXPECT_THAT(east,
              ::testing::Pointwise(::testing::DoubleNear(1e-15),
                                   {4.0, -1.0, 0.0, 9.0, 0.0, 0.04 / 25.0}));
  EXPECT_NEAR(drive->samples[1].estimate.heading, 0.75 * kPi, 1e-12);
  EXPECT_NEAR((*drive->samples[1].covariance)[5], 0.04 / 18.0, 1e-12);
}

TEST(GnssFileTest, LeavesOutStandstillAndInterpolatesTheTruth) {
  const Recording recording = Eastwards();
  const auto drive = MakeGnssDrive("made", recording.fixes, recording.reference,
                                   recording.fixes[0].position);
  ASSERT_TRUE(drive.ok()) << drive.status();
  EXPECT_EQ(drive->name, "made");
  ASSERT_EQ(drive->samples.size(), 7u);
  ASSERT_EQ(drive->truth.size(), 7u);
  EXPECT_EQ(drive->samples[2].time_seconds, 2.0);
  EXPECT_EQ(drive->samples[3].time_seconds, 6.0);
  // 1e-5 degrees of longitude at the equator are 1.1132 m.
  EXPECT_NEAR(drive->samples[3].estimate.x, 6.0 * 1.11319, 1e-4);
  EXPECT_NEAR(drive->samples[3].geodetic->longitude_degrees, 6e-5, 1e-15);
  EXPECT_NEAR(drive->truth[3].x, 6.5 * 1.11319, 1e-4);
  EXPECT_NEAR(drive->truth[3].heading, 0.03, 1e-12);
}

TEST(GnssFileTest, RefusesEpochsWithoutTruth) {
  Recording recording = Eastwards();
  recording.reference.back().time_seconds = 8.5;
  EXPECT_THAT(MessageOf(MakeGnssDrive("made", recording.fixes,
                                      recording.reference, {})),
              HasSubstr("made: an epoch at 9.000000 s lies outside the "
                        "reference's times, -0.500000 to 8.500000 s"));
  recording = Eastwards();
  recording.fixes[4].time_seconds = 3.0;
  EXPECT_EQ(MessageOf(MakeGnssDrive("made", recording.fixes,
                                    recording.reference, {})),
            "made: expected times that grow");
  recording = Eastwards();
  for (GnssFix& fix : recording.fixes) fix.east_velocity = 0.1;
  EXPECT_EQ(MessageOf(MakeGnssDrive("made", recording.fixes,
                                    recording.reference, {})),
            "made: the vehicle never moves");
}

}  // namespace
}  // namespace revisit::client
