#include "server/fleet/fix_datums.h"

#include <cmath>

#include "core/geometry/heading.h"
#include "gtest/gtest.h"

namespace revisit::server {
namespace {

constexpr core::StateSpace kSpatial = core::StateSpace::kSpatial;

TEST(FixDatumsTest, FramesLieWhereTheirOriginsAre) {
  // A minute of arc to the north is a nautical mile, about.
  const GeodeticOrigin anchor{45.0, 7.0, 200.0};
  const auto north =
      DatumOfFixes(anchor, {45.0 + 1.0 / 60.0, 7.0, 250.0}, 0.0, kSpatial);
  EXPECT_EQ(north->relation, core::RecordingRelation::kDatum);
  EXPECT_NEAR(north->datum.x, 0.0, 1e-6);
  EXPECT_NEAR(north->datum.y, 1852.0, 3.0);
  EXPECT_NEAR(north->datum.z, 50.0, 1.0);
  EXPECT_NEAR(north->datum.heading, 0.0, 1e-9);
  // Meridians converge by the sine of the latitude.
  const auto east = DatumOfFixes(anchor, {45.0, 7.1, 200.0}, 0.0, kSpatial);
  EXPECT_NEAR(east->datum.heading, 0.1 * core::kPi / 180.0 * std::sqrt(0.5),
              1e-5);
  EXPECT_GT(east->datum.x, 7000.0);
}

TEST(FixDatumsTest, FramesWithoutBiasErrTogether) {
  const GeodeticOrigin anchor{45.0, 7.0, 200.0};
  const GeodeticOrigin origin{45.01, 7.0, 0.0};
  const auto exact = DatumOfFixes(anchor, origin, 0.0, kSpatial);
  EXPECT_FALSE(exact->datum_id.empty());
  EXPECT_EQ(exact->datum_id,
            DatumOfFixes(anchor, anchor, 0.0, kSpatial)->datum_id);
  const auto biased = DatumOfFixes(anchor, origin, 3.0, kSpatial);
  EXPECT_TRUE(biased->datum_id.empty());
  for (int i = 0; i < 3; ++i) {
    EXPECT_NEAR(biased->covariance(i, i), 9.0, 1e-9);
  }
  EXPECT_LT(biased->covariance(3, 3), 1e-9);
  EXPECT_FALSE(core::FindDefect(*exact, kSpatial).has_value());
  EXPECT_FALSE(core::FindDefect(*biased, kSpatial).has_value());
}

TEST(FixDatumsTest, PosesThatAreReckonedErrWithTheFirst) {
  core::Covariance first;
  first(0, 0) = 4.0;
  first(1, 1) = 1.0;
  first(3, 3) = 0.01;
  const GeodeticOrigin anchor{45.0, 0.0, 0.0};
  // Turned by the convergence of meridians.
  const GeodeticOrigin origin{45.0, 45.0, 0.0};
  const auto datum = DatumOfFixes(anchor, origin, 3.0, kSpatial, first);
  EXPECT_TRUE(
      DatumOfFixes(anchor, origin, 0.0, kSpatial, first)->datum_id.empty());
  const double s = std::sin(datum->datum.heading);
  const double c = std::cos(datum->datum.heading);
  EXPECT_GT(s, 0.4);
  EXPECT_NEAR(datum->covariance(0, 0), 9.0 + 4.0 * c * c + s * s, 1e-9);
  EXPECT_NEAR(datum->covariance(1, 1), 9.0 + 4.0 * s * s + c * c, 1e-9);
  EXPECT_NEAR(datum->covariance(0, 1), 3.0 * s * c, 1e-9);
  EXPECT_NEAR(datum->covariance(3, 3), 0.01, 1e-9);
}

TEST(FixDatumsTest, PlanarFramesHaveNoHeight) {
  const auto datum = DatumOfFixes({45.0, 7.0, 200.0}, {45.0, 7.0, 300.0}, 1.0,
                                  core::StateSpace::kPlanar);
  EXPECT_EQ(datum->datum.z, 0.0);
  EXPECT_FALSE(core::FindDefect(*datum, core::StateSpace::kPlanar).has_value());
}

}  // namespace
}  // namespace revisit::server
