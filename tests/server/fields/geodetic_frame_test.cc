#include "server/fields/geodetic_frame.h"

#include <array>
#include <cmath>
#include <random>

#include "core/geometry/heading.h"
#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "tests/random.h"
#include "tests/server/conversion/conversion_testing.h"
#include "tests/server/error_matchers.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using ::testing::StartsWith;

// The expected numbers come from formulas that are written anew here.

struct Vector3 {
  double x, y, z;
};
Vector3 operator-(const Vector3& a, const Vector3& b) {
  return {a.x - b.x, a.y - b.y, a.z - b.z};
}
double Dot(const Vector3& a, const Vector3& b) {
  return a.x * b.x + a.y * b.y + a.z * b.z;
}

struct Geo {
  double latitude, longitude, height;
};

Vector3 EarthCentred(const Geo& geo) {
  // WGS84: NIMA TR8350.2, table 3.1.
  const double a = 6378137.0;
  const double f = 1.0 / 298.257223563;
  const double e2 = f * (2.0 - f);
  const double lat = geo.latitude * core::kPi / 180.0;
  const double lon = geo.longitude * core::kPi / 180.0;
  const double n = a / std::sqrt(1.0 - e2 * std::sin(lat) * std::sin(lat));
  return {(n + geo.height) * std::cos(lat) * std::cos(lon),
          (n + geo.height) * std::cos(lat) * std::sin(lon),
          (n * (1.0 - e2) + geo.height) * std::sin(lat)};
}

// East, north and up as earth-centred unit vectors.
std::array<Vector3, 3> Axes(const Geo& geo) {
  const double lat = geo.latitude * core::kPi / 180.0;
  const double lon = geo.longitude * core::kPi / 180.0;
  return {Vector3{-std::sin(lon), std::cos(lon), 0.0},
          Vector3{-std::sin(lat) * std::cos(lon),
                  -std::sin(lat) * std::sin(lon), std::cos(lat)},
          Vector3{std::cos(lat) * std::cos(lon), std::cos(lat) * std::sin(lon),
                  std::sin(lat)}};
}

// The state (x, y, z, heading), in the frame of the origin, of a vehicle that
// stands `offset` east, north and up of a place and faces `heading` there.
std::array<double, 4> LocalState(const Geo& origin, const Geo& place,
                                 const Vector3& offset, double heading) {
  const auto from = Axes(place);
  const auto to = Axes(origin);
  const auto rotated = [&](const Vector3& v) {
    return Vector3{from[0].x * v.x + from[1].x * v.y + from[2].x * v.z,
                   from[0].y * v.x + from[1].y * v.y + from[2].y * v.z,
                   from[0].z * v.x + from[1].z * v.y + from[2].z * v.z};
  };
  const Vector3 shift = rotated(offset);
  const Vector3 base = EarthCentred(place) - EarthCentred(origin);
  const Vector3 d{base.x + shift.x, base.y + shift.y, base.z + shift.z};
  const Vector3 f = rotated({std::cos(heading), std::sin(heading), 0.0});
  return {Dot(to[0], d), Dot(to[1], d), Dot(to[2], d),
          std::atan2(Dot(to[1], f), Dot(to[0], f))};
}

// The derivative of LocalState() by (east, north, up, heading), by central
// differences.
std::array<std::array<double, 4>, 4> LocalJacobian(const Geo& origin,
                                                   const Geo& place,
                                                   double heading) {
  std::array<std::array<double, 4>, 4> jacobian{};
  for (std::size_t c = 0; c < 4; ++c) {
    const double step = c < 3 ? 1.0 : 1e-5;
    const auto at = [&](double by) {
      return LocalState(
          origin, place,
          {c == 0 ? by : 0.0, c == 1 ? by : 0.0, c == 2 ? by : 0.0},
          c == 3 ? heading + by : heading);
    };
    const auto plus = at(step);
    const auto minus = at(-step);
    for (std::size_t r = 0; r < 4; ++r) {
      const double change =
          r == 3 ? core::WrapHeading(plus[r] - minus[r]) : plus[r] - minus[r];
      jacobian[r][c] = change / (2.0 * step);
    }
  }
  return jacobian;
}

TEST(GeodeticTest, PutsPosesIntoTheFrameOfTheOrigin) {
  std::mt19937_64 random = SeededRandom();
  for (int i = 0; i < 50; ++i) {
    const Geo origin{Uniform(random, -85, 85), Uniform(random, -180, 180),
                     Uniform(random, -100, 3000)};
    const Geo place{
        origin.latitude + Uniform(random, -2, 2),
        std::remainder(origin.longitude + Uniform(random, -2, 2), 360.0),
        Uniform(random, -100, 3000)};
    const double heading = Uniform(random, -3, 3);
    VehicleConfig config = Geodetic(Spatial());
    config.origin =
        GeodeticOrigin{origin.latitude, origin.longitude, origin.height};
    v1::Pose pose =
        GeodeticPose(1, place.latitude, place.longitude, place.height);
    pose.set_heading_radians(heading);
    SetCovariance(v1::COVARIANCE_FORM_ROS_36, RosMatrix(), &pose);
    const auto sample = DecodeOne(pose, config);
    ASSERT_THAT(sample, IsOk());

    const auto expected = LocalState(origin, place, {0, 0, 0}, heading);
    EXPECT_NEAR(sample->pose.x, expected[0], 1e-6);
    EXPECT_NEAR(sample->pose.y, expected[1], 1e-6);
    EXPECT_NEAR(sample->pose.z, expected[2], 1e-6);
    EXPECT_NEAR(core::WrapHeading(sample->pose.heading - expected[3]), 0.0,
                1e-12);

    core::Covariance before;
    before.upper = UpperOf(DecodeOne(
        [&] {
          v1::Pose local = pose;
          local.mutable_local();
          return local;
        }(),
        Spatial()));
    const auto j = LocalJacobian(origin, place, heading);
    for (std::size_t r = 0; r < 4; ++r) {
      for (std::size_t c = r; c < 4; ++c) {
        double sum = 0.0;
        for (std::size_t k = 0; k < 4; ++k) {
          for (std::size_t l = 0; l < 4; ++l) {
            sum += j[r][k] * before(static_cast<int>(k), static_cast<int>(l)) *
                   j[c][l];
          }
        }
        EXPECT_NEAR(
            sample->covariance(static_cast<int>(r), static_cast<int>(c)), sum,
            1e-6);
      }
    }
  }
}

TEST(GeodeticTest, PlanarVehicleLeavesHeightOut) {
  VehicleConfig config = Geodetic(Planar());
  config.origin = GeodeticOrigin{60, 10, 0};
  const Geo origin{60, 10, 0};
  const Geo place{60.5, 11, 100};
  const auto sample = DecodeOne(
      GeodeticPose(1, place.latitude, place.longitude, place.height), config);
  ASSERT_THAT(sample, IsOk());
  const auto j = LocalJacobian(origin, place, 0.5);
  const std::size_t kept[] = {0, 1, 3};
  const double before[3][3] = {{4, 0.1, 0.2}, {0.1, 5, 0.3}, {0.2, 0.3, 0.06}};
  for (int r = 0; r < 3; ++r) {
    for (int c = r; c < 3; ++c) {
      double sum = 0.0;
      for (int k = 0; k < 3; ++k) {
        for (int l = 0; l < 3; ++l) {
          sum += j[kept[r]][kept[k]] * before[k][l] * j[kept[c]][kept[l]];
        }
      }
      EXPECT_NEAR(sample->covariance(static_cast<int>(kept[r]),
                                     static_cast<int>(kept[c])),
                  sum, 1e-6);
    }
  }
}

TEST(GeodeticTest, FirstPoseIsTheOriginWhereNoneIsGiven) {
  const auto batch = DecodeAll(
      {GeodeticPose(1, 43.8, -79.5, 150), GeodeticPose(2, 43.9, -79.5, 150)},
      Geodetic(Planar()));
  ASSERT_THAT(batch, IsOk());
  ASSERT_TRUE(batch->origin.has_value());
  EXPECT_EQ(batch->origin->latitude_degrees, 43.8);
  EXPECT_EQ(batch->origin->longitude_degrees, -79.5);
  EXPECT_EQ(batch->origin->height_meters, 150);
  EXPECT_NEAR(batch->samples[0].pose.x, 0.0, 1e-9);
  EXPECT_NEAR(batch->samples[0].pose.heading, 0.5, 1e-12);
  EXPECT_GT(batch->samples[1].pose.y, 10000.0);
}

// A pose sideways of the origin, where east has turned by the convergence of
// the meridians: an error that grows eastwards there grows along the turned
// axis here.
TEST(GeodeticTest, TransitionsTurnWithTheAxes) {
  VehicleConfig config = Filter(Geodetic(Planar()));
  config.origin = GeodeticOrigin{60, 0, 0};
  v1::Pose pose = GeodeticPose(2, 60, 3, 0);
  for (const double value : {2.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0}) {
    pose.add_error_transition(value);
  }
  const auto sample = DecodeOne(pose, config);
  ASSERT_THAT(sample, IsOk());
  const auto j = LocalJacobian({60, 0, 0}, {60, 3, 0}, 0.5);
  // The transition Psi' in the local frame satisfies Psi' J = J Psi; here entry
  // by entry over (x, y).
  const auto& psi = sample->transition->values;
  EXPECT_NEAR(psi[0] * j[0][0] + psi[1] * j[1][0], 2.0 * j[0][0], 1e-9);
  EXPECT_NEAR(psi[0] * j[0][1] + psi[1] * j[1][1], j[0][1], 1e-9);
  EXPECT_NEAR(psi[4] * j[0][0] + psi[5] * j[1][0], 2.0 * j[1][0], 1e-9);
  EXPECT_NEAR(psi[4] * j[0][1] + psi[5] * j[1][1], j[1][1], 1e-9);
  EXPECT_NEAR(psi[15], 1.0, 1e-12);
  EXPECT_GT(std::abs(psi[1]), 0.01);
}

TEST(GeodeticTest, RefusesAHeadingThatIsNoneInTheLocalFrame) {
  VehicleConfig config = Geodetic(Planar());
  config.origin = GeodeticOrigin{0, 0, 0};
  // A quarter of the way round the earth, facing east is facing straight down.
  v1::Pose pose = GeodeticPose(1, 0, 90, 0);
  pose.set_heading_radians(0);
  EXPECT_THAT(DecodeOne(pose, config),
              IsError(StatusCode::kInvalidArgument, "INVALID_FIELD",
                      StartsWith("poses[0].orientation: so far from")));
}

}  // namespace
}  // namespace revisit::server
