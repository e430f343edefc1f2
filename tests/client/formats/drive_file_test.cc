#include "client/formats/drive_file.h"

#include <clocale>
#include <ostream>
#include <sstream>
#include <string>

#include "gmock/gmock.h"
#include "gtest/gtest.h"

namespace revisit::client {
namespace {

constexpr char kHeader[] = "frame,t_s,gt_x,gt_y,gt_yaw,est_x,est_y,est_yaw\n";

absl::StatusOr<Drive> Read(const std::string& text,
                           DriveFormat format = DriveFormat::kDrive) {
  std::istringstream input(text);
  return ReadDrive(input, "some/dir/drive.one.csv", format);
}

TEST(DriveFileTest, ReadsEstimateAndTruth) {
  const auto drive = Read(std::string(kHeader) +
                          "0,10.5,1,2,-0.25,3,4,0.5\n"
                          "1,10.6,1e1,-2.5e-1,0,3.25,4,0.75\n");
  ASSERT_TRUE(drive.ok()) << drive.status();
  EXPECT_EQ(drive->name, "drive.one");
  ASSERT_EQ(drive->samples.size(), 2u);
  ASSERT_EQ(drive->truth.size(), 2u);
  EXPECT_EQ(drive->samples[0].time_seconds, 10.5);
  EXPECT_EQ(drive->samples[1].estimate.x, 3.25);
  EXPECT_EQ(drive->samples[1].estimate.y, 4.0);
  EXPECT_EQ(drive->samples[1].estimate.heading, 0.75);
  EXPECT_FALSE(drive->samples[0].covariance.has_value());
  EXPECT_EQ(drive->truth[0].heading, -0.25);
  EXPECT_EQ(drive->truth[1].x, 10.0);
  EXPECT_EQ(drive->truth[1].y, -0.25);
}

TEST(DriveFileTest, FindsColumnsByNameInAnyOrder) {
  const auto drive = Read(
      "ptt,est_yaw,pxx,t_s,pxy,est_x,pxt,est_y,pyy,pyt\n"
      "6,0.1,1,5,2,7,3,8,4,5\r\n");
  ASSERT_TRUE(drive.ok()) << drive.status();
  EXPECT_TRUE(drive->truth.empty());
  const DriveSample& sample = drive->samples[0];
  EXPECT_EQ(sample.estimate.x, 7.0);
  EXPECT_EQ(sample.estimate.y, 8.0);
  EXPECT_EQ(sample.estimate.heading, 0.1);
  const std::array<double, 6> expected = {1, 2, 3, 4, 5, 6};
  EXPECT_EQ(sample.covariance, expected);
}

TEST(DriveFileTest, ReadsNumbersInTheCLocaleWhateverIsSet) {
  // Not every machine has it; then the test says nothing, but passes rightly.
  std::setlocale(LC_ALL, "de_DE.UTF-8");
  const auto drive = Read("t_s,est_x,est_y,est_yaw\n1.5,2.5,3.5,0.5\n");
  std::setlocale(LC_ALL, "C");
  ASSERT_TRUE(drive.ok()) << drive.status();
  EXPECT_EQ(drive->samples[0].estimate.x, 2.5);
}

TEST(DriveFileTest, ReadsTumWithTheHeadingOfTheQuaternion) {
  // A quarter turn about z, then a third of one about a slanted axis.
  const auto drive = Read(
      "# time x y z qx qy qz qw\n"
      "1305031102.1758 1 2 3 0 0 0.70710678118654752 0.70710678118654752\n"
      "  1305031102.2758\t4 5 6 0.5 0.5 0.5 0.5\n",
      DriveFormat::kTum);
  ASSERT_TRUE(drive.ok()) << drive.status();
  ASSERT_EQ(drive->samples.size(), 2u);
  EXPECT_EQ(drive->samples[0].time_seconds, 1305031102.1758);
  EXPECT_EQ(drive->samples[0].estimate_z, 3.0);
  EXPECT_NEAR(drive->samples[0].estimate.heading, 1.5707963267948966, 1e-15);
  // x goes to y.
  EXPECT_NEAR(drive->samples[1].estimate.heading, 1.5707963267948966, 1e-15);
  ASSERT_TRUE(drive->samples[1].quaternion.has_value());
  EXPECT_EQ((*drive->samples[1].quaternion)[3], 0.5);
}

struct Malformed {
  const char* name;
  std::string text;
  DriveFormat format;
  std::string message;
};

void PrintTo(const Malformed& malformed, std::ostream* stream) {
  *stream << malformed.name;
}

class MalformedDriveFileTest : public ::testing::TestWithParam<Malformed> {};

TEST_P(MalformedDriveFileTest, IsRefusedWithLineAndExpectation) {
  const auto drive = Read(GetParam().text, GetParam().format);
  EXPECT_EQ(drive.status().code(), absl::StatusCode::kInvalidArgument);
  EXPECT_EQ(std::string(drive.status().message()),
            "some/dir/drive.one.csv:" + GetParam().message);
}

constexpr DriveFormat kDrive = DriveFormat::kDrive;
constexpr DriveFormat kTum = DriveFormat::kTum;
constexpr char kKnownColumns[] =
    "1: expected a header line of the columns frame, t_s, gt_x, gt_y, gt_yaw, "
    "est_x, est_y, est_yaw, pxx, pxy, pxt, pyy, pyt, ptt, got ";

INSTANTIATE_TEST_SUITE_P(
    Files, MalformedDriveFileTest,
    ::testing::Values(
        Malformed{"Empty", "", kDrive, "0: expected a header line"},
        Malformed{"HeaderOnly", kHeader, kDrive,
                  "1: expected at least one pose after this line"},
        Malformed{"NoHeader", "0,0,0,0\n", kDrive,
                  std::string(kKnownColumns) + "\"0\""},
        Malformed{"UnknownColumn", "t_s,est_x,est_y,est_yaw,speed\n", kDrive,
                  std::string(kKnownColumns) + "\"speed\""},
        Malformed{"MissingColumn", "t_s,est_x,est_yaw\n", kDrive,
                  "1: expected a column est_y"},
        Malformed{"ColumnTwice", "t_s,est_x,est_y,est_yaw,t_s\n", kDrive,
                  "1: column t_s stands twice"},
        Malformed{"PartOfTheTruth", "t_s,est_x,est_y,est_yaw,gt_x,gt_y\n",
                  kDrive,
                  "1: expected a column gt_yaw, since others of its group are "
                  "there"},
        Malformed{"PartOfTheCovariance", "t_s,est_x,est_y,est_yaw,pxx\n",
                  kDrive,
                  "1: expected a column ptt, since others of its group are "
                  "there"},
        Malformed{"TooFewFields", "t_s,est_x,est_y,est_yaw\n0,0,0,0\n1,2,3\n",
                  kDrive, "3: expected 4 fields as in the header, got 3"},
        Malformed{"TooManyFields", "t_s,est_x,est_y,est_yaw\n0,0,0,0,\n",
                  kDrive, "2: expected 4 fields as in the header, got 5"},
        Malformed{"EmptyLine", "t_s,est_x,est_y,est_yaw\n0,0,0,0\n\n", kDrive,
                  "3: expected 4 fields as in the header, got 1"},
        Malformed{"NotANumber", "t_s,est_x,est_y,est_yaw\n0,abc,0,0\n", kDrive,
                  "2: expected a finite number for est_x, got \"abc\""},
        Malformed{"TrailingText", "t_s,est_x,est_y,est_yaw\n0,1.0m,0,0\n",
                  kDrive,
                  "2: expected a finite number for est_x, got \"1.0m\""},
        Malformed{"DecimalComma", "t_s,est_x,est_y,est_yaw\n0;1,0,0,0\n",
                  kDrive, "2: expected a finite number for t_s, got \"0;1\""},
        Malformed{"Nan", "t_s,est_x,est_y,est_yaw\n0,0,0,nan\n", kDrive,
                  "2: expected a finite number for est_yaw, got \"nan\""},
        Malformed{"Infinity", "t_s,est_x,est_y,est_yaw\n0,inf,0,0\n", kDrive,
                  "2: expected a finite number for est_x, got \"inf\""},
        Malformed{"Overflow", "t_s,est_x,est_y,est_yaw\n0,1e999,0,0\n", kDrive,
                  "2: expected a finite number for est_x, got \"1e999\""},
        Malformed{"Time", "t_s,est_x,est_y,est_yaw\n1e10,0,0,0\n", kDrive,
                  "2: expected a time within 9.2e9 seconds of the Unix epoch, "
                  "got 10000000000.000000"},
        Malformed{"Compressed", "\x1f\x8b\x08", kDrive,
                  "1: the file is compressed; expected plain text (gunzip it)"},
        Malformed{"ControlCharacters",
                  "t_s,est_x,est_y,est_yaw\n0,\x1b[31m,0,0\n", kDrive,
                  "2: expected a finite number for est_x, got \"?[31m\""},
        Malformed{"TumFields", "0 1 2 3 0 0 0\n", kTum,
                  "1: expected 8 fields \"t x y z qx qy qz qw\", got 7"},
        Malformed{"TumAsDrive", "0 1 2 3 0 0 0 1\n", kDrive,
                  std::string(kKnownColumns) + "\"0 1 2 3 0 0 0 1\""},
        Malformed{"TumNumber", "# c\n0 1 2 z 0 0 0 1\n", kTum,
                  "2: expected a finite number for z, got \"z\""},
        Malformed{"TumQuaternion", "0 1 2 3 0 0 0 2\n", kTum,
                  "1: expected a quaternion of norm 1, got one of norm "
                  "2.000000"}),
    [](const auto& test) { return std::string(test.param.name); });

TEST(DriveFileTest, SaysWhenAFileIsNotThere) {
  const auto drive = ReadDriveFile("/nowhere/at/all.csv", kDrive);
  EXPECT_EQ(
      drive.status(),
      absl::NotFoundError("/nowhere/at/all.csv: No such file or directory"));
}

TEST(DriveFileTest, RefusesADirectory) {
  const auto drive = ReadDriveFile("/", kDrive);
  EXPECT_EQ(drive.status().code(), absl::StatusCode::kInvalidArgument);
}

}  // namespace
}  // namespace revisit::client
