#include "client/formats/plausibility.h"

#include <Eigen/Geometry>
#include <cmath>
#include <cstdio>
#include <functional>
#include <string>

#include "client/formats/angles.h"
#include "client/formats/drive_file.h"
#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "tests/client/formats/reading.h"

namespace revisit::client {
namespace {

using ::testing::HasSubstr;

struct Point {
  double x = 0.0;
  double y = 0.0;
  double z = 0.0;
  double yaw = 0.0;
};

// A winding drive over a hill: a pose each metre, ten a second.
Point DriveAt(int i) {
  Point point;
  const auto yaw = [](int k) { return 0.3 + 1.2 * std::sin(k * 0.01); };
  for (int k = 0; k < i; ++k) {
    point.x += std::cos(yaw(k) + 0.006 * std::cos(k * 0.01));
    point.y += std::sin(yaw(k) + 0.006 * std::cos(k * 0.01));
  }
  point.z = 5.0 * std::sin(i * 0.005);
  point.yaw = yaw(i);
  return point;
}

std::string Line(const char* format, double a, double b, double c, double d,
                 double e, double f, double g, double h) {
  char line[400];
  std::snprintf(line, sizeof(line), format, a, b, c, d, e, f, g, h);
  return line;
}

std::string Csv(const std::function<Point(Point)>& change, int poses = 600) {
  std::string text = "t_s,est_x,est_y,est_yaw\n";
  for (int i = 0; i < poses; ++i) {
    const Point p = change(DriveAt(i));
    text += Line("%.1f,%.9f,%.9f,%.6f\n", 0.1 * i, p.x, p.y, p.yaw, 0, 0, 0, 0);
  }
  return text;
}

// TUM with orientations of these axes.
std::string Tum(Axes axes, bool w_first = false, int poses = 600) {
  std::string text;
  for (int i = 0; i < poses; ++i) {
    const Point p = DriveAt(i);
    const double s = std::sin(0.5 * p.yaw);
    const double c = std::cos(0.5 * p.yaw);
    std::array<double, 7> v = {p.x, p.y, p.z, 0.0, 0.0, s, c};
    if (axes == Axes::kCamera) v = {-p.y, -p.z, p.x, 0.0, -s, 0.0, c};
    if (axes == Axes::kNorthEastDown) {
      const double turned = 0.5 * (kPi / 2.0 - p.yaw);
      v = {p.y, p.x, -p.z, 0.0, 0.0, std::sin(turned), std::cos(turned)};
    }
    if (w_first) v = {v[0], v[1], v[2], v[6], v[3], v[4], v[5]};
    text += Line("%.1f %.9f %.9f %.9f %.9f %.9f %.9f %.9f\n", 0.1 * i, v[0],
                 v[1], v[2], v[3], v[4], v[5], v[6]);
  }
  return text;
}

std::string Refusal(const std::string& text,
                    const ReaderOptions& options = ReaderOptions()) {
  const auto samples = ReadText(text, options);
  EXPECT_EQ(samples.status().code(), absl::StatusCode::kInvalidArgument);
  EXPECT_THAT(MessageOf(samples), HasSubstr("; --accept-suspicious "));
  ReaderOptions accepting = options;
  accepting.accept_suspicious = true;
  EXPECT_TRUE(ReadText(text, accepting).ok());
  return MessageOf(samples);
}

void ExpectTheDrive(const std::string& text, const ReaderOptions& options) {
  const auto samples = ReadText(text, options);
  ASSERT_TRUE(samples.ok()) << samples.status();
  for (std::size_t i = 0; i < samples->size(); i += 100) {
    const Point expected = DriveAt(static_cast<int>(i));
    const Sample& sample = (*samples)[i];
    EXPECT_NEAR(sample.estimate.x, expected.x, 1e-6);
    EXPECT_NEAR(sample.estimate.y, expected.y, 1e-6);
    EXPECT_NEAR(std::remainder(sample.estimate.heading - expected.yaw, 2 * kPi),
                0.0, 1e-5);
  }
}

Point Same(Point p) { return p; }
Point InDegrees(Point p) {
  p.yaw /= kRadiansPerDegree;
  return p;
}
Point AsCompass(Point p) {
  p.yaw = (kPi / 2.0 - p.yaw) / kRadiansPerDegree;
  return p;
}

TEST(PlausibilityTest, TakesWhatIsRight) {
  ExpectTheDrive(Csv(Same), ReaderOptions());
  ExpectTheDrive(Tum(Axes::kForwardLeftUp), ReaderOptions());
}

TEST(PlausibilityTest, YawThatCountsTurnsIsRight) {
  ExpectTheDrive(Csv([](Point p) {
                   p.yaw += 6.0 * kPi;
                   return p;
                 }),
                 ReaderOptions());
}

TEST(PlausibilityTest, CameraAxesAreRefusedAndMended) {
  const std::string text = Tum(Axes::kCamera);
  EXPECT_THAT(Refusal(text), HasSubstr("they agree with --axes camera"));
  ReaderOptions options;
  options.conventions.axes = Axes::kCamera;
  ExpectTheDrive(text, options);
  EXPECT_THAT(Refusal(Tum(Axes::kForwardLeftUp), options),
              HasSubstr("they agree with --axes flu"));
}

TEST(PlausibilityTest, PositionsOfACameraAreRefusedToo) {
  std::string text = "t,x,y,z\n";
  for (int i = 0; i < 600; ++i) {
    const Point p = DriveAt(i);
    text += Line("%.1f,%.6f,%.6f,%.6f\n", 0.1 * i, -p.y, -p.z, p.x, 0, 0, 0, 0);
  }
  ReaderOptions options;
  options.columns = "t=t,x=x,y=y,z=z";
  EXPECT_THAT(Refusal(text, options),
              HasSubstr("they agree with --axes camera"));
  options.conventions.axes = Axes::kCamera;
  EXPECT_TRUE(ReadText(text, options).ok());
}

TEST(PlausibilityTest, NorthEastDownIsConverted) {
  ReaderOptions options;
  options.conventions.axes = Axes::kNorthEastDown;
  ExpectTheDrive(Tum(Axes::kNorthEastDown), options);
  ExpectTheDrive(Csv([](Point p) {
                   return Point{p.y, p.x, -p.z, kPi / 2.0 - p.yaw};
                 }),
                 options);
}

TEST(PlausibilityTest, DegreesAreRefusedAndMended) {
  const std::string text = Csv(InDegrees);
  EXPECT_THAT(Refusal(text), HasSubstr("--angles degrees"));
  ReaderOptions options;
  options.conventions.angles = Angles::kDegrees;
  ExpectTheDrive(text, options);
}

TEST(PlausibilityTest, CompassHeadingsAreRefusedAndMended) {
  const std::string text = Csv(AsCompass);
  EXPECT_THAT(Refusal(text), HasSubstr("--angles compass-degrees"));
  ReaderOptions options;
  options.conventions.angles = Angles::kCompassDegrees;
  ExpectTheDrive(text, options);
}

TEST(PlausibilityTest, QuaternionsWithWFirstAreRefusedAndMended) {
  const std::string text = Tum(Axes::kForwardLeftUp, true);
  EXPECT_THAT(Refusal(text), HasSubstr("--quaternion wxyz"));
  ReaderOptions options;
  options.conventions.quaternion = QuaternionOrder::kWxyz;
  ExpectTheDrive(text, options);
}

// TUM of bodies whose x, y and z point so in the vehicle, in a frame with z up.
std::string TumOfBody(const BodyAxes& body, double turned_left = 0.0) {
  std::string text;
  for (int i = 0; i < 600; ++i) {
    const Point p = DriveAt(i);
    Eigen::Matrix3d columns;
    for (int axis = 0; axis < 3; ++axis) {
      const char letter = body[static_cast<std::size_t>(axis)];
      columns.col(axis) = letter == 'f'   ? Eigen::Vector3d(1, 0, 0)
                          : letter == 'b' ? Eigen::Vector3d(-1, 0, 0)
                          : letter == 'l' ? Eigen::Vector3d(0, 1, 0)
                          : letter == 'r' ? Eigen::Vector3d(0, -1, 0)
                          : letter == 'u' ? Eigen::Vector3d(0, 0, 1)
                                          : Eigen::Vector3d(0, 0, -1);
    }
    const Eigen::Quaterniond q(
        Eigen::AngleAxisd(p.yaw + turned_left, Eigen::Vector3d::UnitZ())
            .toRotationMatrix() *
        columns);
    text += Line("%.1f %.9f %.9f %.9f %.9f %.9f %.9f %.9f\n", 0.1 * i, p.x, p.y,
                 p.z, q.x(), q.y(), q.z(), q.w());
  }
  return text;
}

TEST(PlausibilityTest, TurnedBodiesAreRefusedAndMended) {
  for (const char* axes : {"rdf", "rfu", "frd", "lbu", "blu", "bru"}) {
    const auto body = ReadBodyAxes(axes);
    if (!body.has_value()) continue;
    const std::string text = TumOfBody(*body);
    EXPECT_THAT(Refusal(text), HasSubstr(std::string("they agree with "
                                                     "--body-axes ") +
                                         axes + " (the body's x points "));
    ReaderOptions options;
    options.conventions.body = body;
    ExpectTheDrive(text, options);
  }
  EXPECT_EQ(ReadBodyAxes("camera"), ReadBodyAxes("rdf"));
  for (const char* wrong : {"", "flu ", "fld", "ffu", "fbu", "xyz", "FLU"}) {
    EXPECT_EQ(ReadBodyAxes(wrong), std::nullopt) << wrong;
  }
}

TEST(PlausibilityTest, BodiesTurnedByAnyAngleAreRefusedAndMended) {
  const double angle = 37.0 * kRadiansPerDegree;
  const std::string tum = TumOfBody({'r', 'f', 'u'}, angle);
  EXPECT_THAT(Refusal(tum),
              HasSubstr("--body-axes rfu --body-yaw 37 (the body's x points "
                        "right, y forward, z up, and the body is turned 37 "
                        "degrees to the left of where it moves)"));
  ReaderOptions options;
  options.conventions.body_yaw = angle;
  options.conventions.body = ReadBodyAxes("rfu");
  ExpectTheDrive(tum, options);

  const std::string csv = Csv([angle](Point p) {
    p.yaw -= 2.0 * angle;
    return p;
  });
  EXPECT_THAT(Refusal(csv), HasSubstr("they agree with --body-yaw -74 "));
  options.conventions = {};
  options.conventions.body_yaw = -2.0 * angle;
  ExpectTheDrive(csv, options);
}

TEST(PlausibilityTest, TurnedBodiesAreFoundByOtherConventionsToo) {
  // As the poses of Boreas have it: a LiDAR's heading, clockwise.
  const double angle = 43.0 * kRadiansPerDegree;
  const std::string text = Csv([angle](Point p) {
    p.yaw = kPi / 2.0 - (p.yaw + angle);
    return p;
  });
  EXPECT_THAT(Refusal(text),
              HasSubstr("they agree with --angles compass-radians --body-yaw "
                        "43 (radians clockwise from north; the body is turned "
                        "43 degrees to the left of where it moves)"));
  ReaderOptions options;
  options.conventions.angles = Angles::kCompassRadians;
  options.conventions.body_yaw = angle;
  ExpectTheDrive(text, options);
}

TEST(PlausibilityTest, YawAloneIsThatOfTheBodysX) {
  const std::string text = Csv([](Point p) {
    p.yaw -= kPi / 2.0;
    return p;
  });
  ReaderOptions options;
  options.conventions.body = ReadBodyAxes("rfu");
  ExpectTheDrive(text, options);
  options.conventions.body = ReadBodyAxes("dlf");
  EXPECT_THAT(MessageOf(ReadText(text, options)),
              HasSubstr("a.txt:2: --body-axes with x up or down needs"));
}

TEST(PlausibilityTest, KilometresAreRefused) {
  const auto kilometres = [](Point p) {
    p.x /= 1000.0;
    p.y /= 1000.0;
    return p;
  };
  EXPECT_THAT(Refusal(Csv(kilometres, 1200)),
              HasSubstr("whose positions are in kilometres; expected metres"));
  // A vehicle that shakes where it stands is none.
  EXPECT_TRUE(ReadText(Csv(
                           [](Point p) {
                             return Point{0.001 * std::sin(1e4 * p.x),
                                          0.001 * std::cos(3e4 * p.x), 0, 0};
                           },
                           1200),
                       ReaderOptions())
                  .ok());
}

TEST(PlausibilityTest, EarthCentredPositionsAreRefused) {
  std::string text = "t,x,y,z\n";
  for (int i = 0; i < 100; ++i) {
    // To the east at 47 degrees north.
    text += Line("%.1f,%.3f,%.3f,%.3f\n", 0.1 * i, 4.2e6 - 0.1 * i,
                 1.2e6 + 0.5 * i, 4.6e6, 0, 0, 0, 0);
  }
  ReaderOptions options;
  options.columns = "t=t,x=x,y=y,z=z";
  EXPECT_THAT(Refusal(text, options),
              HasSubstr("as earth-centred ones (ECEF)"));
  // Northings are as large.
  EXPECT_TRUE(ReadText(Csv([](Point p) {
                         p.x += 500'000.0;
                         p.y += 6'350'000.0;
                         return p;
                       }),
                       ReaderOptions())
                  .ok());
}

TEST(PlausibilityTest, LongitudeAndLatitudeAreRefusedAndMended) {
  const std::string text = Csv([](Point p) {
    p.x = 136.9 + p.x / 91000.0;
    p.y = 35.2 + p.y / 111000.0;
    return p;
  });
  EXPECT_THAT(Refusal(text), HasSubstr("--frame geodetic"));
  ReaderOptions options;
  options.frame = Frame::kGeodetic;
  const auto samples = ReadText(text, options);
  ASSERT_TRUE(samples.ok()) << samples.status();
  EXPECT_NEAR(samples->front().geodetic->longitude_degrees, 136.9, 1e-8);
  EXPECT_NEAR(samples->back().estimate.x, DriveAt(599).x, 5.0);
}

TEST(PlausibilityTest, TimesThatRunBackAreRefused) {
  std::string text = Csv(Same, 10);
  text += "0.3,9,0,0\n";
  EXPECT_THAT(Refusal(text),
              HasSubstr("a.txt:12: the time runs back by 0.6 s"));
}

TEST(PlausibilityTest, SpeedsNoVehicleHasAreRefused) {
  EXPECT_THAT(Refusal(Csv([](Point p) {
                p.x *= 1000.0;
                p.y *= 1000.0;
                return p;
              })),
              HasSubstr("more than 100 m/s"));
  ReaderOptions options;
  options.conventions.axes = Axes::kEastNorthUp;
  options.time_unit = TimeUnit::kMicroseconds;
  EXPECT_THAT(Refusal(Csv(Same), options), HasSubstr("--time-unit"));
}

TEST(PlausibilityTest, ConversionsAndSuspicionKeepTheCovarianceInPlace) {
  Sample sample;
  sample.quaternion = {0, 0, 0, 1};
  sample.covariance_36.emplace();
  for (std::size_t i = 0; i < 36; ++i) (*sample.covariance_36)[i] = 0.0;
  // Right 1, down 4, forward 9; pitch (about right) 16, yaw (about down) 25.
  (*sample.covariance_36)[0] = 1.0;
  (*sample.covariance_36)[7] = 4.0;
  (*sample.covariance_36)[14] = 9.0;
  (*sample.covariance_36)[21] = 16.0;
  (*sample.covariance_36)[28] = 25.0;
  // Forward with yaw.
  (*sample.covariance_36)[2 * 6 + 4] = (*sample.covariance_36)[4 * 6 + 2] = 3.0;
  Conventions camera;
  camera.axes = Axes::kCamera;
  const auto converted = Convert(sample, camera);
  ASSERT_TRUE(converted.ok());
  // x is forward, y left, and yaw counts the other way round.
  const std::array<double, 6> planar = {9, 0, -3, 1, 0, 25};
  EXPECT_EQ(converted->covariance, planar);
  EXPECT_EQ((*converted->covariance_36)[14], 4.0);
}

TEST(PlausibilityTest, CameraAxesNeedFullOrientations) {
  ReaderOptions options;
  options.conventions.axes = Axes::kCamera;
  EXPECT_EQ(MessageOf(ReadText("t_s,est_x,est_y,est_yaw\n0,0,0,0\n", options)),
            "a.txt:2: --axes camera needs orientations as quaternions; the "
            "file has yaw alone");
}

TEST(PlausibilityTest, ShippedDrivesAreNotSuspicious) {
  EXPECT_TRUE(ReadDriveFile("tests/data/boreas/boreas_glen_shields.csv",
                            ReaderOptions())
                  .ok());
  ReaderOptions boreas;
  boreas.columns = "t=GPSTime,x=easting,y=northing,z=altitude";
  for (const char* drive :
       {"tests/data/boreas/boreas-2021-08-05-13-34/lidar_poses_1hz.csv",
        "tests/data/boreas/boreas-2021-09-02-11-42/lidar_poses_1hz.csv"}) {
    const auto read = ReadDriveFile(drive, boreas);
    EXPECT_TRUE(read.ok()) << read.status();
  }
  // This heading is the LiDAR's, which does not look forward.
  boreas.columns += ",yaw=heading";
  EXPECT_FALSE(
      ReadDriveFile(
          "tests/data/boreas/boreas-2021-08-05-13-34/lidar_poses_1hz.csv",
          boreas)
          .ok());
}

}  // namespace
}  // namespace revisit::client
