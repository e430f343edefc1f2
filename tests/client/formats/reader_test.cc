#include "client/formats/reader.h"

#include <clocale>
#include <cmath>
#include <ostream>
#include <sstream>
#include <string>

#include "client/formats/angles.h"
#include "client/formats/drive_file.h"
#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "tests/client/formats/reading.h"

namespace revisit::client {
namespace {

using ::testing::HasSubstr;

constexpr char kHeader[] = "frame,t_s,gt_x,gt_y,gt_yaw,est_x,est_y,est_yaw\n";

TEST(CsvReaderTest, ReadsEstimateAndTruth) {
  const auto samples = ReadText(std::string(kHeader) +
                                "0,10.5,1,2,-0.25,3,4,0.5\n"
                                "1,10.6,1e1,-2.5e-1,0,3.25,4,0.75\n");
  ASSERT_TRUE(samples.ok()) << samples.status();
  ASSERT_EQ(samples->size(), 2u);
  EXPECT_EQ((*samples)[0].time_nanoseconds, 10'500'000'000);
  EXPECT_EQ((*samples)[1].estimate.x, 3.25);
  EXPECT_EQ((*samples)[1].estimate.y, 4.0);
  EXPECT_EQ((*samples)[1].estimate.heading, 0.75);
  EXPECT_FALSE((*samples)[0].covariance.has_value());
  EXPECT_EQ((*samples)[0].truth->heading, -0.25);
  EXPECT_EQ((*samples)[1].truth->x, 10.0);
  EXPECT_EQ((*samples)[1].line, 3);
}

TEST(CsvReaderTest, FindsColumnsByNameInAnyOrderAndPassesOverOthers) {
  const auto samples = ReadText(
      "\xef\xbb\xbfptt;est_yaw;pxx;note;t_s;pxy;est_x;pxt;est_y;pyy;pyt;note"
      "\r\n6;0.1;1;\"hello\";5;2;\"7\";3;8;4;5;x\r\n\r\n");
  ASSERT_TRUE(samples.ok()) << samples.status();
  ASSERT_EQ(samples->size(), 1u);
  const Sample& sample = (*samples)[0];
  EXPECT_FALSE(sample.truth.has_value());
  EXPECT_EQ(sample.estimate.x, 7.0);
  EXPECT_EQ(sample.estimate.y, 8.0);
  EXPECT_EQ(sample.estimate.heading, 0.1);
  const std::array<double, 6> expected = {1, 2, 3, 4, 5, 6};
  EXPECT_EQ(sample.covariance, expected);
}

TEST(CsvReaderTest, ReadsAnyonesHeaderByTheNamesThatAreGiven) {
  ReaderOptions options;
  options.columns = "t=Time (UTC), x=East, y=North, z=Up, qx=a,qy=b,qz=c,qw=d";
  const auto samples = ReadText(
      "Time (UTC)\tEast\tNorth\tUp\ta\tb\tc\td\tspeed\n"
      "2021-08-05T13:34:46.518266+02:00\t1\t2\t3\t0\t0\t0\t1\tfast\n"
      "2021-08-05 11:34:46.6Z\t1.1\t2\t3\t0\t0\t0.6\t0.8\tfast\n",
      options);
  ASSERT_TRUE(samples.ok()) << samples.status();
  // date -u -d 2021-08-05T11:34:46 +%s
  EXPECT_EQ((*samples)[0].time_nanoseconds, 1'628'163'286'518'266'000);
  EXPECT_EQ((*samples)[1].time_nanoseconds, 1'628'163'286'600'000'000);
  EXPECT_EQ((*samples)[0].z, 3.0);
  EXPECT_NEAR((*samples)[1].estimate.heading, std::atan2(0.96, 0.28), 1e-12);
}

ReaderOptions Columns(const std::string& columns) {
  ReaderOptions options;
  options.columns = columns;
  options.accept_suspicious = true;
  return options;
}

TEST(CsvReaderTest, ColumnsAreCountedInFilesWithoutNames) {
  for (const char* text :
       {"5 7 8 0.1 x\n6 9 8 0.1 x\n", "5,7,8,0.1,x\r\n6,9,8,0.1,x\r\n",
        "5\t 7\t8 0.1 x\n6 \t9 8\t0.1\tx\n", "5; 7; 8; 0.1; x\n6;9;8;0.1;x",
        "# t x y yaw\n5 7 8 0.1 x\n% more\n\n6 9 8 0.1 x\n",
        "time east north psi note\n5 7 8 0.1 x\n6 9 8 0.1 x\n"}) {
    const auto samples = ReadText(text, Columns("t=1,x=2,y=3,yaw=4"));
    ASSERT_TRUE(samples.ok()) << text << samples.status();
    ASSERT_EQ(samples->size(), 2u) << text;
    EXPECT_EQ((*samples)[1].time_nanoseconds, 6'000'000'000);
    EXPECT_EQ((*samples)[1].estimate.x, 9.0);
    EXPECT_EQ((*samples)[1].estimate.y, 8.0);
    EXPECT_EQ((*samples)[1].estimate.heading, 0.1);
  }
}

TEST(CsvReaderTest, SaysWhichCountedColumnIsMissing) {
  EXPECT_EQ(MessageOf(ReadText("5 7 8\n", Columns("t=1,x=2,y=3,yaw=4"))),
            "a.txt:1: expected a column 4 as --columns says, got 3 in "
            "\"5 7 8\"");
  EXPECT_EQ(MessageOf(ReadText("5 7 8\n5 z 8\n", Columns("t=1,x=2,y=3"))),
            "a.txt:2: expected a finite number for value 2 of the line, got "
            "\"z\"");
  EXPECT_EQ(MessageOf(ReadText("5 7 8\n5 8\n", Columns("t=1,x=2,y=3"))),
            "a.txt:2: expected 3 fields as before, got 2");
}

// As KF-GINS writes it, and NovAtel's INSPVA behind its header.
TEST(CsvReaderTest, ReadsWeeksAndTheirSeconds) {
  ReaderOptions options =
      Columns("week=1,tow=2,lat=3,lon=4,height=5,vn=6,ve=7,yaw=11");
  options.conventions.angles = Angles::kCompassDegrees;
  const auto samples = ReadText(
      "2270 194670.2 30.4447873 114.4718632 20.9 0.0 1.0 0 0.8 -2.0 185.7\n",
      options);
  ASSERT_TRUE(samples.ok()) << samples.status();
  EXPECT_EQ((*samples)[0].time_nanoseconds, 1'689'055'470'200'000'000);
  EXPECT_EQ((*samples)[0].geodetic->latitude_degrees, 30.4447873);
  EXPECT_NEAR(std::remainder((*samples)[0].estimate.heading, 2 * kPi),
              (90.0 - 185.7) * kRadiansPerDegree, 1e-12);
  EXPECT_THAT(MessageOf(ReadText("x 5 7 8\n1 y 7 8\n",
                                 Columns("week=1,tow=2,x=3,y=4"))),
              HasSubstr("a.txt:1: expected a finite number"));
  EXPECT_THAT(
      MessageOf(ReadText("1 6e8 7 8\n", Columns("week=1,tow=2,x=3,y=4"))),
      HasSubstr("a.txt:1: expected a GPS week and seconds of it"));
  EXPECT_THAT(MessageOf(ReadText("1 7 8\n", Columns("tow=1,x=2,y=3"))),
              HasSubstr("expected a column week"));
}

TEST(CsvReaderTest, ReadsDiagonalCovariancesAndDeviations) {
  const std::array<double, 6> diagonal = {4, 0, 0, 9, 0, 0.25};
  for (const char* text : {"t,x,y,yaw,pxx,pyy,ptt\n0,1,2,0,4,9,0.25\n",
                           "t,x,y,yaw,sdx,sdy,sdyaw\n0,1,2,0,2,-3,0.5\n"}) {
    const auto samples = ReadText(text);
    ASSERT_TRUE(samples.ok()) << samples.status();
    EXPECT_EQ((*samples)[0].covariance, diagonal);
  }
  ReaderOptions options = Columns("lat=1,lon=2,sdx=3,sdy=4,sdz=5");
  options.keep_without_heading = true;
  const auto fix = ReadText("30 114 2 3 5\n", options);
  ASSERT_TRUE(fix.ok()) << fix.status();
  const std::array<double, 3> position = {4, 0, 9};
  const std::array<double, 3> height = {0, 0, 25};
  EXPECT_EQ((*fix)[0].position_covariance, position);
  EXPECT_EQ((*fix)[0].height_covariance, height);
  EXPECT_FALSE((*fix)[0].covariance.has_value());
  EXPECT_THAT(MessageOf(ReadText("t,x,y,yaw,pxx,pyy\n0,1,2,0,4,9\n")),
              HasSubstr("expected a column ptt"));
  EXPECT_THAT(MessageOf(ReadText("t,x,y,yaw,pxx,pxy,pyy,ptt\n"
                                 "0,1,2,0,4,0,9,1\n")),
              HasSubstr("expected a column p"));
}

TEST(CsvReaderTest, HeadersOfTheShortNamesNeedNoFlags) {
  for (const char* text :
       {"t,x,y,yaw\r\n5,7,8,0.1\r\n", "t x y yaw\n5 7 8 0.1\n",
        "yaw;y;x;t\n0.1;8;7;5\n"}) {
    const auto samples = ReadText(text);
    ASSERT_TRUE(samples.ok()) << samples.status();
    EXPECT_EQ((*samples)[0].time_nanoseconds, 5'000'000'000);
    EXPECT_EQ((*samples)[0].estimate.x, 7.0);
    EXPECT_EQ((*samples)[0].estimate.heading, 0.1);
  }
  EXPECT_THAT(MessageOf(ReadText("t,x,y\n5,7,8\n")),
              HasSubstr("a.txt:1: expected a column yaw, got \"t\""));
  EXPECT_THAT(MessageOf(ReadText("t,x,y,qx,qy,qz\n5,7,8,0,0,0\n")),
              HasSubstr("a.txt:1: expected a column qw, since others"));
  // Short names beside those of a drive mean something else.
  const auto drive = ReadText("t_s,est_x,est_y,est_yaw,x,y\n5,7,8,0.1,1,2\n");
  ASSERT_TRUE(drive.ok()) << drive.status();
  EXPECT_EQ((*drive)[0].estimate.x, 7.0);
}

TEST(ReaderTest, LinesThatEndInCarriageReturnsAreFoundOut) {
  const auto samples = ReadText("\r\n5 1 2 3 0 0 0 1\r\n6 1 2 3 0 0 0 1\r\n");
  ASSERT_TRUE(samples.ok()) << samples.status();
  EXPECT_EQ(samples->size(), 2u);
}

TEST(ReaderTest, TextThatEndsInTheMiddleOfANumberIsRefused) {
  std::string text = "t,x,y,yaw\n";
  for (int i = 0; i < 20; ++i) {
    text += std::to_string(i) + ".0,1.0,2.0,0.123456\n";
  }
  const std::string whole = text + "20.0,1.0,2.0,0.123456";
  EXPECT_TRUE(ReadText(whole).ok());
  EXPECT_TRUE(ReadText(whole + "\n").ok());
  for (const std::size_t cut : {1, 4, 6, 7}) {
    const std::string is_cut = whole.substr(0, whole.size() - cut);
    EXPECT_THAT(MessageOf(ReadText(is_cut)),
                HasSubstr("a.txt:22: the text ends in the middle of a number"));
    EXPECT_TRUE(ReadText(is_cut + "\n").ok() || cut == 7);
  }
  // Where numbers are as long as they need to be, a short one says nothing.
  text += "20.0,1.0,2.0,0.5\n";
  EXPECT_TRUE(ReadText(text + "21.0,1.0,2.0,0.5").ok());
}

TEST(CsvReaderTest, ReadsTransitionsAndCovariancesOfThirtySixNumbers) {
  std::string header =
      "t_s,est_x,est_y,est_yaw,fxx,fxy,fxt,fyx,fyy,fyt,ftx,fty,ftt";
  std::string row = "1,2,3,0.5,1,2,3,4,5,6,7,8,9";
  for (int i = 0; i < 36; ++i) {
    header += ",P" + std::to_string(i);
    row += "," + std::to_string(i);
  }
  ReaderOptions options;
  options.columns = "cov=P";
  const auto samples = ReadText(header + "\n" + row + "\n", options);
  ASSERT_TRUE(samples.ok()) << samples.status();
  EXPECT_EQ((*(*samples)[0].error_transition)[5], 6.0);
  const std::array<double, 6> planar = {0, 1, 5, 7, 11, 35};
  EXPECT_EQ((*samples)[0].covariance, planar);
}

TEST(CsvReaderTest, ReadsTheHeightOfTheTruthWhereThereIsOne) {
  const std::string header = "t_s,est_x,est_y,est_z,est_yaw,gt_x,gt_y,gt_yaw";
  const auto samples =
      ReadText(header + ",gt_z\n1,2,3,4,0.5,5,6,0.7,8\n", ReaderOptions());
  ASSERT_TRUE(samples.ok()) << samples.status();
  EXPECT_EQ((*samples)[0].z, 4.0);
  EXPECT_EQ((*samples)[0].truth->heading, 0.7);
  EXPECT_EQ((*samples)[0].truth_z, 8.0);
  const auto planar = ReadText(header + "\n1,2,3,4,0.5,5,6,0.7\n");
  ASSERT_TRUE(planar.ok()) << planar.status();
  EXPECT_FALSE((*planar)[0].truth_z.has_value());
}

TEST(CsvReaderTest, ReadsTimesToTheNanosecondInEveryUnit) {
  const auto time = [](const std::string& text) {
    ReaderOptions options;
    options.accept_suspicious = true;
    const auto samples =
        ReadText("t_s,est_x,est_y,est_yaw\n" + text + ",0,0,0\n", options);
    EXPECT_TRUE(samples.ok()) << samples.status();
    return samples.ok() ? *(*samples)[0].time_nanoseconds : -1;
  };
  EXPECT_EQ(time("1305031102.175304689"), 1'305'031'102'175'304'689);
  EXPECT_EQ(time("1.305031102175304e+09"), 1'305'031'102'175'304'000);
  EXPECT_EQ(time("1628184886518"), 1'628'184'886'518'000'000);
  EXPECT_EQ(time("1628184886518266"), 1'628'184'886'518'266'000);
  EXPECT_EQ(time("1628184886518266789"), 1'628'184'886'518'266'789);
  EXPECT_EQ(time("-0.25"), -250'000'000);
}

TEST(CsvReaderTest, ReadsNumbersInTheCLocaleWhateverIsSet) {
  // Not every machine has it; then the test says nothing, but passes rightly.
  std::setlocale(LC_ALL, "de_DE.UTF-8");
  const auto samples = ReadText("t_s,est_x,est_y,est_yaw\n1.5,2.5,3.5,0.5\n");
  std::setlocale(LC_ALL, "C");
  ASSERT_TRUE(samples.ok()) << samples.status();
  EXPECT_EQ((*samples)[0].estimate.x, 2.5);
  EXPECT_EQ((*samples)[0].time_nanoseconds, 1'500'000'000);
}

TEST(TumReaderTest, TakesTheHeadingOfTheQuaternion) {
  // A quarter turn about z, then a third of one about a slanted axis.
  const auto samples = ReadText(
      "# time x y z qx qy qz qw\n"
      "1305031102.1758 1 2 3 0 0 0.70710678118654752 0.70710678118654752\n"
      "  1305031102.2758\t4 5 6 0.5 0.5 0.5 0.5\n");
  ASSERT_TRUE(samples.ok()) << samples.status();
  ASSERT_EQ(samples->size(), 2u);
  EXPECT_EQ((*samples)[0].time_nanoseconds, 1'305'031'102'175'800'000);
  EXPECT_EQ((*samples)[0].z, 3.0);
  EXPECT_NEAR((*samples)[0].estimate.heading, kPi / 2.0, 1e-15);
  // x goes to y.
  EXPECT_NEAR((*samples)[1].estimate.heading, kPi / 2.0, 1e-15);
  EXPECT_EQ((*(*samples)[1].quaternion)[3], 0.5);
}

TEST(KittiReaderTest, ReadsRotationsAndTimesFromARate) {
  ReaderOptions options;
  options.rate_hz = 10.0;
  const auto samples = ReadText(
      "1 0 0 0 0 1 0 0 0 0 1 0\n"
      "0 -1 0 1.5e+00 1 0 0 2.5e+00 0 0 1 0.5\n",
      options);
  ASSERT_TRUE(samples.ok()) << samples.status();
  EXPECT_EQ((*samples)[1].time_nanoseconds, 100'000'000);
  EXPECT_EQ((*samples)[1].estimate.x, 1.5);
  EXPECT_EQ((*samples)[1].estimate.y, 2.5);
  EXPECT_EQ((*samples)[1].z, 0.5);
  EXPECT_NEAR((*samples)[1].estimate.heading, kPi / 2.0, 1e-12);
}

TEST(KittiReaderTest, ReadsWhatLidarOdometryHasWritten) {
  ReaderOptions options;
  const auto drive = ReadDriveFile("tests/data/formats/uq_kitti.txt", options);
  ASSERT_TRUE(drive.ok()) << drive.status();
  EXPECT_EQ(drive->name, "uq_kitti");
  ASSERT_EQ(drive->samples.size(), 60u);
  EXPECT_FALSE(drive->samples[0].time_nanoseconds.has_value());
  EXPECT_EQ(drive->samples[1].estimate.x, 0.531445);
  EXPECT_NEAR(drive->samples[1].estimate.heading, 0.0105658, 1e-6);
}

TEST(RosReaderTest, ReadsOdometryOfBothRosesAlike) {
  std::string covariance;
  for (int i = 0; i < 36; ++i) covariance += "," + std::to_string(0.5 * i);
  std::string twist;
  for (int i = 0; i < 42; ++i) twist += ",0.0";
  const auto second = ReadText(
      "1628184886,518266789,odom,base_link,1.0,2.0,3.0,0.0,0.0,0.6,0.8" +
      covariance + twist + "\n");
  ASSERT_TRUE(second.ok()) << second.status();
  std::string header = "%time,field.header.seq,field.header.stamp,";
  header +=
      "field.header.frame_id,field.child_frame_id,field.pose.pose.position.x,"
      "field.pose.pose.position.y,field.pose.pose.position.z,"
      "field.pose.pose.orientation.x,field.pose.pose.orientation.y,"
      "field.pose.pose.orientation.z,field.pose.pose.orientation.w";
  for (int i = 0; i < 36; ++i) {
    header += ",field.pose.covariance" + std::to_string(i);
  }
  const auto first = ReadText(
      header +
      "\n1628184887000000000,7,1628184886518266789,odom,base_link,1.0,2.0,3.0,"
      "0.0,0.0,0.6,0.8" +
      covariance + "\n");
  ASSERT_TRUE(first.ok()) << first.status();
  for (const auto& samples : {*second, *first}) {
    EXPECT_EQ(samples[0].time_nanoseconds, 1'628'184'886'518'266'789);
    EXPECT_EQ(samples[0].estimate.y, 2.0);
    EXPECT_EQ(samples[0].z, 3.0);
    EXPECT_NEAR(samples[0].estimate.heading, std::atan2(0.96, 0.28), 1e-12);
    const std::array<double, 6> planar = {0, 0.5, 2.5, 3.5, 5.5, 17.5};
    EXPECT_EQ(samples[0].covariance, planar);
  }
}

struct Malformed {
  const char* name;
  std::string text;
  std::string message;
};

void PrintTo(const Malformed& malformed, std::ostream* stream) {
  *stream << malformed.name;
}

class MalformedFileTest : public ::testing::TestWithParam<Malformed> {};

TEST_P(MalformedFileTest, IsRefusedWithLineAndExpectation) {
  const auto samples = ReadText(GetParam().text);
  EXPECT_EQ(samples.status().code(), absl::StatusCode::kInvalidArgument);
  EXPECT_THAT(MessageOf(samples), HasSubstr("a.txt:" + GetParam().message));
}

constexpr char kPlain[] = "t_s,est_x,est_y,est_yaw\n";

INSTANTIATE_TEST_SUITE_P(
    Files, MalformedFileTest,
    ::testing::Values(
        Malformed{"Empty", "", "1: expected at least one pose, got none"},
        Malformed{"HeaderOnly", kHeader, " expected at least one pose"},
        Malformed{"NoHeader", "0,0,0,0\n",
                  "1: the format is none that is known by its beginning "
                  "\"0,0,0,0\"; --columns t=NAME,"},
        Malformed{"OtherHeader", "stamp,east,north\n0,0,0\n",
                  "1: the format is none that is known by its beginning "
                  "\"stamp,east,north\"; --columns t=NAME,"},
        Malformed{"MissingColumn", "t_s,est_x,est_yaw\n",
                  "1: expected a column est_y, got \"t_s\", \"est_x\", "
                  "\"est_yaw\"; --columns "},
        Malformed{"ColumnTwice", "t_s,est_x,est_y,est_yaw,t_s\n",
                  "1: column \"t_s\" stands twice"},
        Malformed{"PartOfTheTruth", "t_s,est_x,est_y,est_yaw,gt_x,gt_y\n",
                  "1: expected a column gt_yaw, since others of its group are "
                  "there"},
        Malformed{"PartOfTheCovariance", "t_s,est_x,est_y,est_yaw,pxx\n",
                  "1: expected a column ptt, since others of its group are "
                  "there"},
        Malformed{"TooFewFields", std::string(kPlain) + "0,0,0,0\n1,2,3\n",
                  "3: expected 4 fields as before, got 3"},
        Malformed{"TooManyFields", std::string(kPlain) + "0,0,0,0,\n",
                  "2: expected 4 fields as before, got 5"},
        Malformed{"NotANumber", std::string(kPlain) + "0,abc,0,0\n",
                  "2: expected a finite number for est_x, got \"abc\""},
        Malformed{"TrailingText", std::string(kPlain) + "0,1.0m,0,0\n",
                  "2: expected a finite number for est_x, got \"1.0m\""},
        Malformed{"DecimalComma", std::string(kPlain) + "0;1,0,0,0\n",
                  "2: expected a number or an ISO 8601 date for the time, got "
                  "\"0;1\""},
        Malformed{"Nan", std::string(kPlain) + "0,0,0,nan\n",
                  "2: expected a finite number for est_yaw, got \"nan\""},
        Malformed{"Overflow", std::string(kPlain) + "0,1e999,0,0\n",
                  "2: expected a finite number for est_x, got \"1e999\""},
        Malformed{"Time", std::string(kPlain) + "1e10,0,0,0\n",
                  "2: expected a time within 9.2e9 seconds of the Unix epoch, "
                  "got \"1e10\""},
        Malformed{"Date", std::string(kPlain) + "2021-02-30T00:00:00Z,0,0,0\n",
                  "2: expected a date and time such as"},
        Malformed{"ControlCharacters", std::string(kPlain) + "0,\x1b[31m,0,0\n",
                  "2: expected a finite number for est_x, got \"?[31m\""},
        Malformed{"TumFields", "0 1 2 3 0 0 0 1\n0 1 2\n",
                  "2: expected 8 fields \"t x y z qx qy qz qw\", got 3"},
        Malformed{"TumNumber", "# c\n0 1 2 3 0 0 0 1\n0 1 2 z 0 0 0 1\n",
                  "3: expected a finite number for z, got \"z\""},
        Malformed{"TumQuaternion", "0 1 2 3 0 0 0 2\n",
                  "1: expected a quaternion of norm 1, got one of norm "
                  "2.000000"},
        Malformed{"KittiFields", "1 0 0 0 0 1 0 0 0 0 1 0\n1\n",
                  "2: expected 12 numbers, the rows of a 3x4 matrix, got 1"},
        Malformed{"KittiRotation", "1 0 0 0 0 1 0 0 0 0 2 0\n",
                  "1: expected a rotation in numbers 1-3, 5-7 and 9-11"},
        Malformed{"LongLine", std::string(2 << 20, 'x'), "1: the "}),
    [](const auto& test) { return std::string(test.param.name); });

TEST(ReaderTest, HeaderOfManyColumnsIsNoOdometry) {
  std::string header = "time,x";
  for (int i = 2; i < 46; ++i) header += ",c" + std::to_string(i);
  EXPECT_THAT(MessageOf(ReadText(header + "\n")),
              HasSubstr("; --columns t=NAME,"));
}

TEST(ReaderTest, SaysWhenAFileIsNotThere) {
  EXPECT_EQ(
      OpenSamples("/nowhere/at/all.csv", ReaderOptions()).status(),
      absl::NotFoundError("/nowhere/at/all.csv: No such file or directory"));
  EXPECT_EQ(OpenSamples("/", ReaderOptions()).status().code(),
            absl::StatusCode::kInvalidArgument);
}

TEST(ReaderTest, RefusesOptionsThatDoNotGoTogether) {
  ReaderOptions options;
  options.rate_hz = 10.0;
  options.times_file = "times.txt";
  EXPECT_EQ(MessageOf(ReadText("1 0 0 0 0 1 0 0 0 0 1 0\n", options)),
            "--rate and --times exclude each other");
  options = ReaderOptions();
  options.columns = "t=a,speed=b";
  EXPECT_THAT(MessageOf(ReadText("a,b\n", options)),
              HasSubstr("--columns: expected WORD=NAME with a word such as"));
  options.columns = "x=east";
  EXPECT_THAT(
      MessageOf(ReadText("a,b\n", options)),
      HasSubstr(
          "a.txt:1: expected a column east as --columns says, got \"a\""));
}

}  // namespace
}  // namespace revisit::client
