#include "server/conversion/pose_inspection.h"

#include <cmath>
#include <cstdint>
#include <functional>
#include <memory>
#include <set>
#include <string>
#include <vector>

#include "core/geometry/heading.h"
#include "core/geometry/pose.h"
#include "core/geometry/recording_start.h"
#include "gmock/gmock.h"
#include "gtest/gtest.h"

namespace revisit::server {
namespace {

using ::testing::ElementsAre;
using ::testing::IsEmpty;

using Samples = std::vector<core::PoseSample>;

// A circle at 10 m/s and 10 Hz, known to `deviation` metres.
Samples Circle(int count, double radius, double deviation = 0.05) {
  Samples samples;
  for (int i = 0; i < count; ++i) {
    const double angle = i / radius;
    core::PoseSample sample;
    sample.sequence = static_cast<std::uint64_t>(i) + 1;
    sample.stamp_ns = 100'000'000LL * i;
    sample.pose = {radius * std::cos(angle), radius * std::sin(angle), 0.0,
                   core::WrapHeading(angle + 0.5 * core::kPi)};
    for (int k : {0, 1, 3}) sample.covariance(k, k) = deviation * deviation;
    samples.push_back(sample);
  }
  return samples;
}

Samples Changed(Samples samples,
                const std::function<void(core::PoseSample*)>& change) {
  for (core::PoseSample& sample : samples) change(&sample);
  return samples;
}

// The reasons, as the batches bring them.
std::vector<v1::WarningReason> Reasons(
    const Samples& samples, CoordinateFrame frame = CoordinateFrame::kLocal) {
  PoseInspector inspector(frame);
  PoseInspector::Warnings warnings;
  for (std::size_t i = 0; i < samples.size(); i += 64) {
    const auto begin = samples.begin() + static_cast<std::ptrdiff_t>(i);
    const auto end = samples.begin() + static_cast<std::ptrdiff_t>(
                                           std::min(i + 64, samples.size()));
    inspector.Look(Samples(begin, end), &warnings);
  }
  std::vector<v1::WarningReason> reasons;
  for (const v1::Warning& warning : warnings) {
    reasons.push_back(warning.reason());
  }
  return reasons;
}

TEST(PoseInspectorTest, FindsNothingWrongWithGoodPoses) {
  EXPECT_THAT(Reasons(Circle(20'000, 100.0)), IsEmpty());
  EXPECT_THAT(Reasons({}), IsEmpty());
  EXPECT_THAT(Reasons(Circle(1, 100.0)), IsEmpty());
}

TEST(PoseInspectorTest, MeasuresTheAngleBetweenHeadingAndCourse) {
  for (const double degrees : {-170.0, -90.0, -25.0, 25.0, 90.0, 180.0}) {
    const Samples turned =
        Changed(Circle(400, 100.0), [&](core::PoseSample* sample) {
          sample->pose.heading = core::WrapHeading(sample->pose.heading +
                                                   degrees * core::kPi / 180.0);
        });
    PoseInspector inspector(CoordinateFrame::kLocal);
    PoseInspector::Warnings warnings;
    inspector.Look(turned, &warnings);
    ASSERT_EQ(warnings.size(), 1) << degrees;
    const v1::Warning& warning = warnings[0];
    EXPECT_EQ(warning.reason(), v1::WARNING_REASON_HEADING_OFF_COURSE);
    const auto number = [&](const std::string& name) {
      return std::stod(warning.metadata().at(name));
    };
    EXPECT_NEAR(number("median_degrees"), std::abs(degrees), 1e-6);
    EXPECT_NEAR(std::remainder(number("turned_degrees") - degrees, 360.0), 0.0,
                1e-6);
  }
  EXPECT_THAT(Reasons(Changed(Circle(400, 100.0),
                              [](core::PoseSample* sample) {
                                sample->pose.heading +=
                                    15.0 * core::kPi / 180.0;
                              })),
              IsEmpty());
}

TEST(PoseInspectorTest, VehicleAtRestIsNotOffCourse) {
  // Fixes that scatter by 3 m, and are known to 2 m.
  Samples scattered = Circle(3000, 100.0, 2.0);
  for (std::size_t i = 0; i < scattered.size(); ++i) {
    const double n = static_cast<double>(i);
    scattered[i].pose = {40.0 + 3.0 * std::sin(7.0 * n),
                         50.0 + 3.0 * std::cos(11.0 * n),
                         5.0 * std::sin(13.0 * n), 0.3};
  }
  EXPECT_THAT(Reasons(scattered), IsEmpty());
}

TEST(PoseInspectorTest, HeadingsInDegreesAreBeyondATurn) {
  const auto reasons =
      Reasons(Changed(Circle(400, 100.0), [](core::PoseSample* sample) {
        sample->pose.heading *= 180.0 / core::kPi;
      }));
  EXPECT_THAT(reasons, ElementsAre(v1::WARNING_REASON_HEADING_BEYOND_TURN,
                                   v1::WARNING_REASON_HEADING_OFF_COURSE));
}

TEST(PoseInspectorTest, StampsInMillisecondsMakeSpeeds) {
  EXPECT_THAT(Reasons(Changed(Circle(400, 100.0),
                              [](core::PoseSample* sample) {
                                sample->stamp_ns = *sample->stamp_ns / 1000;
                              })),
              ElementsAre(v1::WARNING_REASON_IMPLAUSIBLE_SPEED));
}

TEST(PoseInspectorTest, StampsThatStandStillAreNoSign) {
  Samples samples = Changed(Circle(400, 100.0), [](core::PoseSample* sample) {
    sample->stamp_ns = 5;
  });
  EXPECT_THAT(Reasons(samples), IsEmpty());
  samples[300].stamp_ns = 4;
  samples[350].stamp_ns = 3;
  EXPECT_THAT(Reasons(samples),
              ElementsAre(v1::WARNING_REASON_STAMPS_BACKWARDS));
}

TEST(PoseInspectorTest, LongitudeAndLatitudeMoveOnWithoutGettingFar) {
  const Samples degrees =
      Changed(Circle(400, 100.0), [](core::PoseSample* sample) {
        sample->pose.x = 11.5 + sample->pose.x / 74'000.0;
        sample->pose.y = 48.1 + sample->pose.y / 111'000.0;
      });
  EXPECT_THAT(Reasons(degrees),
              ElementsAre(v1::WARNING_REASON_POSITIONS_LIKE_DEGREES));
  EXPECT_THAT(Reasons(degrees, CoordinateFrame::kGeodetic), IsEmpty());
  // At rest, also exactly.
  EXPECT_THAT(Reasons(Changed(degrees,
                              [](core::PoseSample* sample) {
                                sample->pose = {11.5, 48.1, 0.0, 0.0};
                              })),
              IsEmpty());
}

TEST(PoseInspectorTest, PathThatGoesForwardInZIsSteep) {
  EXPECT_THAT(
      Reasons(Changed(
          Circle(400, 100.0),
          [](core::PoseSample* sample) {
            sample->pose = {-sample->pose.x + 100.0, 0.0, sample->pose.y, 0.0};
          })),
      ElementsAre(v1::WARNING_REASON_STEEP_PATH));
}

TEST(PoseInspectorTest, NothingIsToldAcrossRecordings) {
  Samples samples = Circle(400, 100.0);
  const Samples earlier =
      Changed(Circle(400, 100.0), [](core::PoseSample* sample) {
        sample->sequence += 400;
        sample->stamp_ns = *sample->stamp_ns - 1'000'000'000'000;
        sample->pose.x += 5000.0;
      });
  samples.insert(samples.end(), earlier.begin(), earlier.end());
  EXPECT_THAT(Reasons(samples),
              ElementsAre(v1::WARNING_REASON_STAMPS_BACKWARDS));
  samples[400].recording_start = std::make_shared<core::RecordingStart>();
  EXPECT_THAT(Reasons(samples), IsEmpty());
}

TEST(PoseInspectorTest, EachRecordingIsJudgedByItself) {
  // Half as many steps as are needed, then a way in another frame.
  Samples samples = Circle(30, 100.0);
  const Samples turned =
      Changed(Circle(400, 100.0), [](core::PoseSample* sample) {
        sample->sequence += 30;
        sample->pose.heading =
            core::WrapHeading(sample->pose.heading + 0.5 * core::kPi);
      });
  samples.insert(samples.end(), turned.begin(), turned.end());
  samples[30].recording_start = std::make_shared<core::RecordingStart>();
  EXPECT_THAT(Reasons(samples),
              ElementsAre(v1::WARNING_REASON_HEADING_OFF_COURSE));
  // Degrees are looked for over as many poses of a frame.
  Samples degrees = Circle(60, 100.0);
  for (std::size_t i = 0; i < degrees.size(); ++i) {
    degrees[i].stamp_ns = static_cast<std::int64_t>(i) * 1'000'000'000;
    degrees[i].pose = {11.5 + 1e-4 * static_cast<double>(i), 48.1, 0.0, 0.0};
  }
  EXPECT_THAT(Reasons(degrees),
              ElementsAre(v1::WARNING_REASON_POSITIONS_LIKE_DEGREES));
  degrees[20].recording_start = std::make_shared<core::RecordingStart>();
  EXPECT_THAT(Reasons(degrees), IsEmpty());
}

TEST(PoseInspectorTest, LooksAtTheFirstPosesOnly) {
  Samples samples = Circle(PoseInspector::kMostPoses + 10, 100.0);
  samples.back().stamp_ns = 0;
  EXPECT_THAT(Reasons(samples), IsEmpty());
  PoseInspector inspector(CoordinateFrame::kLocal);
  PoseInspector::Warnings warnings;
  EXPECT_FALSE(inspector.done());
  inspector.Look(samples, &warnings);
  EXPECT_TRUE(inspector.done());
}

}  // namespace
}  // namespace revisit::server
