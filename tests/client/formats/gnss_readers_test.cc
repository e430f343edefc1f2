#include "client/formats/gnss_readers.h"

#include <algorithm>
#include <cmath>
#include <string>
#include <vector>

#include "client/formats/angles.h"
#include "client/formats/course.h"
#include "client/formats/drive_file.h"
#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "tests/client/formats/reading.h"

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
// date -u -d "2023-07-11 06:04:30.2" +%s%N
constexpr std::int64_t kPosTime = 1'689'055'470'200'000'000;

ReaderOptions Raw() {
  ReaderOptions options;
  options.keep_without_heading = true;
  return options;
}

TEST(RtklibReaderTest, ReadsSignedSquareRoots) {
  const auto fixes = ReadText(std::string(kPosHeader) + kPosLine, Raw());
  ASSERT_TRUE(fixes.ok()) << fixes.status();
  ASSERT_EQ(fixes->size(), 1u);
  const Sample& fix = (*fixes)[0];
  EXPECT_EQ(fix.time_nanoseconds, kPosTime);
  EXPECT_EQ(fix.geodetic->latitude_degrees, 35.165393934);
  EXPECT_EQ(fix.geodetic->longitude_degrees, 136.881442407);
  EXPECT_EQ(fix.geodetic->height_meters, 39.6452);
  EXPECT_THAT(*fix.position_covariance,
              ::testing::ElementsAre(16.0, -2.25, 9.0));
  ASSERT_TRUE(fix.height_covariance.has_value());
  EXPECT_THAT(
      *fix.height_covariance,
      ::testing::Pointwise(::testing::DoubleEq(), {2.56, -1.44, 68.89}));
  EXPECT_EQ(fix.velocity->east, 4.0);
  EXPECT_EQ(fix.velocity->north, 3.0);
  EXPECT_NEAR((*fix.velocity->covariance)[0], 0.04, 1e-15);
  EXPECT_NEAR((*fix.velocity->covariance)[2], 0.01, 1e-15);
  EXPECT_FALSE(fix.has_heading);
}

TEST(RtklibReaderTest, ReadsWeeksAndFilesWithoutVelocities) {
  const auto fixes = ReadText(
      "%  UTC latitude(deg) longitude(deg) height(m) Q sdn(m) sde(m) sdne(m)\n"
      "2270 194670.200 35.1 136.9 39.6 5 0 0 0\n",
      Raw());
  ASSERT_TRUE(fixes.ok()) << fixes.status();
  EXPECT_EQ((*fixes)[0].time_nanoseconds, kPosTime);
  EXPECT_FALSE((*fixes)[0].velocity.has_value());
  EXPECT_FALSE((*fixes)[0].position_covariance.has_value());
}

TEST(RtklibReaderTest, ReadsWhatRtklibHasWritten) {
  const auto drive =
      ReadDriveFile("tests/data/formats/nagoya_spp.pos", ReaderOptions());
  ASSERT_TRUE(drive.ok()) << drive.status();
  // The vehicle stands at first: 88 epochs are in the file.
  EXPECT_GT(drive->samples.size(), 10u);
  EXPECT_LT(drive->samples.size(), 60u);
  for (const Sample& sample : drive->samples) {
    EXPECT_GE(std::hypot(sample.velocity->east, sample.velocity->north), 0.5);
    ASSERT_TRUE(sample.covariance.has_value());
  }
}

TEST(RtklibReaderTest, SaysWhereAFileIsWrong) {
  const auto message = [](const std::string& text) {
    ReaderOptions options = Raw();
    options.format = Format::kRtklib;
    return MessageOf(ReadText(text, options));
  };
  EXPECT_THAT(message(kPosLine), HasSubstr("a.txt:1: expected a line"));
  EXPECT_THAT(message("%  GPST latitude(deg)\n"),
              HasSubstr("a.txt:1: expected a column \"longitude(deg)\""));
  EXPECT_THAT(message("%  GPST x-ecef(m) y-ecef(m)\n"),
              HasSubstr("out-solformat=llh"));
  EXPECT_EQ(message(std::string(kPosHeader) + "2023/07/11 06:04:30 1\n"),
            "a.txt:4: expected 24 fields, got 3");
  std::string bad = kPosLine;
  bad.replace(bad.find("39.6452"), 7, "39,6452");
  EXPECT_EQ(message(kPosHeader + bad),
            "a.txt:4: expected a finite number for height(m), got \"39,6452\"");
  bad = kPosLine;
  bad.replace(0, 10, "2023-07-11");
  EXPECT_THAT(message(kPosHeader + bad),
              HasSubstr("a.txt:4: expected a time such as"));
  bad = kPosLine;
  bad.replace(0, 4, "1e99");
  EXPECT_THAT(message(kPosHeader + bad), HasSubstr("a.txt:4: expected a "));
  bad = kPosLine;
  bad.replace(bad.find("35.16"), 5, "95.16");
  EXPECT_THAT(message(kPosHeader + bad),
              HasSubstr("a.txt:4: expected a latitude within 90"));
  std::string twice = kPosHeader;
  twice.insert(twice.rfind("sdvn"), "sdn(m) ");
  EXPECT_THAT(message(twice + kPosLine),
              HasSubstr("a.txt:3: column \"sdn(m)\" stands twice"));
}

std::string Sentence(const std::string& body) {
  unsigned sum = 0;
  for (const char c : body) sum ^= static_cast<unsigned char>(c);
  char checksum[8];
  std::snprintf(checksum, sizeof(checksum), "*%02X\r\n", sum);
  return "$" + body + checksum;
}

TEST(NmeaReaderTest, JoinsTheSentencesOfAnEpoch) {
  const auto fixes = ReadText(
      "garbled\r\n" +
          Sentence("GPGGA,235959.50,4807.038,N,01131.000,E,1,08,0.9,545.4,M,"
                   "46.9,M,,") +
          Sentence("GPGSV,1,1,00") +
          Sentence("GPRMC,235959.50,A,4807.038,N,01131.000,E,010.0,090.0,230394"
                   ",003.1,W") +
          Sentence("GPGGA,000000.50,4807.038,S,01131.010,W,1,08,0.9,,M,,M,,"),
      [] {
        ReaderOptions options = Raw();
        options.format = Format::kNmea;
        options.accept_suspicious = true;
        return options;
      }());
  ASSERT_TRUE(fixes.ok()) << fixes.status();
  ASSERT_EQ(fixes->size(), 2u);
  // date -u -d "1994-03-23 23:59:59.5" +%s
  EXPECT_EQ((*fixes)[0].time_nanoseconds, 764'467'199'500'000'000);
  EXPECT_EQ((*fixes)[1].time_nanoseconds, 764'467'200'500'000'000);
  EXPECT_NEAR((*fixes)[0].geodetic->latitude_degrees, 48.0 + 7.038 / 60, 1e-12);
  EXPECT_NEAR((*fixes)[0].geodetic->longitude_degrees, 11.0 + 31.0 / 60, 1e-12);
  EXPECT_NEAR((*fixes)[0].geodetic->height_meters, 592.3, 1e-9);
  EXPECT_NEAR((*fixes)[0].velocity->east, 5.14444, 1e-5);
  EXPECT_NEAR((*fixes)[0].velocity->north, 0.0, 1e-12);
  EXPECT_LT((*fixes)[1].geodetic->latitude_degrees, 0.0);
  EXPECT_LT((*fixes)[1].geodetic->longitude_degrees, 0.0);
}

constexpr char kFix[] =
    "GNGGA,12000$,4807.038,N,01131.00$,E,1,08,0.9,545.4,M,46.9,M,,";

// The fix of a second, a little farther east each time.
std::string FixAt(char second) {
  std::string body = kFix;
  std::replace(body.begin(), body.end(), '$', second);
  return Sentence(body);
}

TEST(NmeaReaderTest, PassesOverSentencesWithoutAFix) {
  const auto fixes =
      ReadText(Sentence("GNGGA,115959,,,,,0,00,,,M,,M,,") +
                   Sentence("GNRMC,115959,V,,,,,,,230394,,,N") + FixAt('0'),
               Raw());
  ASSERT_TRUE(fixes.ok()) << fixes.status();
  EXPECT_EQ(fixes->size(), 1u);
}

TEST(NmeaReaderTest, SentencesWithAWrongChecksumAreCountedAndPassedOver) {
  std::string bad = FixAt('1');
  bad[12] = '9';
  auto reader =
      ReadSamples(BytesOf(FixAt('0') + bad + FixAt('2')), "a.txt", Raw());
  ASSERT_TRUE(reader.ok()) << reader.status();
  const auto samples = ReadDrive(reader->get(), "a.txt");
  ASSERT_TRUE(samples.ok()) << samples.status();
  EXPECT_EQ(samples->samples.size(), 2u);
  EXPECT_EQ(samples->left_out.wrong_checksums, 1);
}

TEST(NmeaReaderTest, MostlyWrongChecksumsAreAnError) {
  std::string bad = FixAt('1');
  bad[12] = '9';
  EXPECT_EQ(MessageOf(ReadText(FixAt('0') + bad + bad, Raw())),
            "a.txt:3: 2 of 3 sentences have a wrong checksum");
  EXPECT_THAT(MessageOf(ReadText(bad, Raw())),
              HasSubstr("got none and 1 sentences with a wrong checksum"));
}

TEST(GpxReaderTest, ReadsTrackPointsWhateverSurroundsThem) {
  const auto fixes = ReadText(
      "<?xml version=\"1.0\"?>\n"
      "<gpx version=\"1.1\" xmlns=\"http://www.topografix.com/GPX/1/1\">\n"
      "<wpt lat=\"1\" lon=\"2\"><ele>9</ele></wpt>\n"
      "<trk><name>a &amp; b</name><trkseg>\n"
      "<trkpt lat=\"48.1\" lon=\"11.5\"><ele> 545.4 </ele>\n"
      "<time>2021-08-05T13:34:46Z</time><extensions><x:ele xmlns:x=\"x\">7"
      "</x:ele></extensions></trkpt></trkseg><trkseg>\n"
      "<trkpt lon=\"11.6\" lat=\"48.2\"/></trkseg></trk></gpx>\n",
      Raw());
  ASSERT_TRUE(fixes.ok()) << fixes.status();
  ASSERT_EQ(fixes->size(), 2u);
  EXPECT_EQ((*fixes)[0].geodetic->height_meters, 545.4);
  EXPECT_EQ((*fixes)[0].time_nanoseconds, 1'628'170'486'000'000'000);
  EXPECT_EQ((*fixes)[1].geodetic->longitude_degrees, 11.6);
  EXPECT_FALSE((*fixes)[1].time_nanoseconds.has_value());
}

TEST(GpxReaderTest, SaysWhereAFileIsWrong) {
  const auto message = [](const std::string& text) {
    return MessageOf(ReadText(text, Raw()));
  };
  EXPECT_THAT(message("<kml></kml>"),
              HasSubstr("a.txt:1: expected the element gpx, got \"kml\""));
  EXPECT_THAT(message("<gpx>\n<trkpt lat=\"1\"/></gpx>"),
              HasSubstr("a.txt:2: expected lat and lon of a trkpt"));
  EXPECT_THAT(message("<gpx>\n\n<trkpt lat=\"x\" lon=\"1\"/></gpx>"),
              HasSubstr("a.txt:3: expected a finite number for lat"));
  EXPECT_THAT(message("<gpx><trkpt lat=\"91\" lon=\"1\"/></gpx>"),
              HasSubstr("a.txt:1: expected a latitude within 90"));
  EXPECT_THAT(message("<gpx>\n<trk>"), HasSubstr("a.txt:2: "));
  EXPECT_THAT(message("<!DOCTYPE gpx [<!ENTITY a \"b\">]>\n<gpx>&a;</gpx>"),
              HasSubstr("entities are not allowed"));
}

// One epoch a second, to the east at 5 m/s but at rest from 3 s to 5 s.
std::string Eastwards(bool velocity) {
  std::string text =
      "lat,lon,time" + std::string(velocity ? ",ve,vn" : "") + "\n";
  double longitude = 0.0;
  for (int i = 0; i < 10; ++i) {
    const bool rest = i >= 3 && i <= 5;
    // 5 m at the equator.
    longitude += rest ? 2e-7 : 5.0 / 111319.49;
    text += "0," + std::to_string(longitude * 1e6) + "e-6," + std::to_string(i);
    if (velocity) text += rest ? ",0.3,0" : ",5,0";
    text += "\n";
  }
  return text;
}

TEST(CourseTest, StandstillIsLeftOutWithAndWithoutVelocities) {
  ReaderOptions options;
  options.columns = "t=time";
  for (const bool velocity : {true, false}) {
    auto reader = ReadSamples(BytesOf(Eastwards(velocity)), "a.txt", options);
    ASSERT_TRUE(reader.ok()) << reader.status();
    const auto drive = ReadDrive(reader->get(), "a.txt");
    ASSERT_TRUE(drive.ok()) << drive.status();
    const std::vector<Sample>* const samples = &drive->samples;
    ASSERT_EQ(samples->size(), 7u);
    EXPECT_EQ(drive->left_out.standing, 3);
    for (const Sample& sample : *samples) {
      EXPECT_TRUE(sample.has_heading);
      EXPECT_NEAR(sample.estimate.heading, 0.0, 1e-9);
      EXPECT_GT(*sample.heading_variance, 0.0);
    }
    EXPECT_EQ((*samples)[2].time_nanoseconds, 2'000'000'000);
    EXPECT_EQ((*samples)[3].time_nanoseconds, 6'000'000'000);
  }
}

TEST(CourseTest, HeadingVarianceIsThatOfTheVelocityAcross) {
  std::string line = kPosLine;
  // North-west, with 0.5 m/s of noise along and 0.2 across.
  const std::string from = "3.0    4.0    0.02    0.1  0.2  0.25  0.05";
  ASSERT_NE(line.find(from), line.npos);
  line.replace(line.find(from), from.size(),
               "3.0 -3.0 0.02 0.380788655293195 0.380788655293195 0.25 "
               "-0.324037034920393");
  const auto samples =
      ReadText(std::string(kPosHeader) + line, ReaderOptions());
  ASSERT_TRUE(samples.ok()) << samples.status();
  EXPECT_NEAR((*samples)[0].estimate.heading, 0.75 * kPi, 1e-12);
  EXPECT_THAT(*(*samples)[0].covariance,
              ::testing::Pointwise(::testing::DoubleNear(1e-12),
                                   {16.0, -2.25, 0.0, 9.0, 0.0, 0.04 / 18.0}));
}

}  // namespace
}  // namespace revisit::client
