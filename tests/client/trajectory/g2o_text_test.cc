// Poses as other programs want them: lines, relative poses, edges.
#include "client/trajectory/g2o_text.h"

#include <array>
#include <cmath>
#include <sstream>

#include "client/answers/exact_text.h"
#include "client/formats/angles.h"
#include "client/trajectory/trajectory_text.h"
#include "gmock/gmock.h"
#include "gtest/gtest.h"

namespace revisit::client {
namespace {

using ::testing::DoubleNear;
using ::testing::ElementsAre;
using ::testing::Pointwise;

v1::VehicleSettings G2oSettings(v1::StateSpace space) {
  v1::VehicleSettings settings;
  settings.set_state_space(space);
  settings.set_correlation_model(v1::CORRELATION_MODEL_DEAD_RECKONING);
  settings.set_max_step_meters(100.0);
  return settings;
}

// A level pose with independent errors of these variances.
LocalPose LevelPose(std::uint64_t sequence, double x, double y, double heading,
                    const std::array<double, 4>& variances) {
  LocalPose pose;
  pose.sequence = sequence;
  pose.position = {x, y, 0.0};
  pose.heading = heading;
  pose.orientation = {0.0, 0.0, std::sin(0.5 * heading),
                      std::cos(0.5 * heading)};
  for (std::size_t i = 0; i < 4; ++i) {
    pose.covariance[5 * i] = variances[i];
  }
  return pose;
}

TEST(RelativePose, StepHasTheNoiseThatDeadReckoningAdds) {
  // Facing north; the step leads 10 m to the east, which is to the right. What
  // it adds: 0.04 m2 east, 0.09 m2 north, 0.0001 rad2.
  const LocalPose from =
      LevelPose(1, 5.0, 5.0, 0.5 * kPi, {4.0, 9.0, 0.0, 0.01});
  LocalPose to = LevelPose(2, 15.0, 5.0, 0.5 * kPi,
                           {4.0 + 0.04, 9.0 + 0.09, 0.0, 0.01 + 0.0001});
  // The heading error of the earlier pose has swung the later one north.
  to.covariance[5] += 10.0 * 10.0 * 0.01;
  to.covariance[7] = to.covariance[13] = 10.0 * 0.01;
  const Step step = StepBetween(from, to, G2oSettings(v1::STATE_SPACE_PLANAR));
  EXPECT_FALSE(step.raised);
  EXPECT_THAT(step.relative.position,
              Pointwise(DoubleNear(1e-12), {0.0, -10.0, 0.0}));
  EXPECT_NEAR(step.relative.heading, 0.0, 1e-12);
  // Ahead is north.
  EXPECT_NEAR(step.relative.covariance[0], 0.09, 1e-9);
  EXPECT_NEAR(step.relative.covariance[5], 0.04, 1e-9);
  EXPECT_NEAR(step.relative.covariance[1], 0.0, 1e-9);
  EXPECT_NEAR(step.relative.covariance[15], 0.0001, 1e-12);
}

TEST(RelativePose, StepOfIndependentFixesHasTheNoiseOfBoth) {
  v1::VehicleSettings settings = G2oSettings(v1::STATE_SPACE_PLANAR);
  settings.set_correlation_model(v1::CORRELATION_MODEL_INDEPENDENT);
  const Step step =
      StepBetween(LevelPose(1, 0.0, 0.0, 0.0, {1.0, 1.0, 0.0, 0.01}),
                  LevelPose(2, 2.0, 0.0, 0.0, {1.0, 1.0, 0.0, 0.01}), settings);
  EXPECT_NEAR(step.relative.covariance[0], 2.0, 1e-12);
  EXPECT_NEAR(step.relative.covariance[5], 2.0 + 4.0 * 0.01, 1e-12);
  EXPECT_NEAR(step.relative.covariance[15], 0.02, 1e-12);
}

TEST(RelativePose, StepOfCorrelatedFixesHasWhatTheyDoNotShare) {
  v1::VehicleSettings settings = G2oSettings(v1::STATE_SPACE_PLANAR);
  settings.set_correlation_model(v1::CORRELATION_MODEL_CORRELATED_FIXES);
  settings.set_fix_correlation_meters(50.0);
  const LocalPose from = LevelPose(1, 0.0, 0.0, 0.0, {1.0, 1.0, 0.0, 0.01});
  const double kept = std::exp(-2.0 / 50.0);
  const Step alike = StepBetween(
      from, LevelPose(2, 2.0, 0.0, 0.0, {1.0, 1.0, 0.0, 0.01}), settings);
  EXPECT_NEAR(alike.relative.covariance[0], (1.0 - kept) * 2.0, 1e-12);
  EXPECT_NEAR(alike.relative.covariance[15], (1.0 - kept) * 0.02, 1e-12);
  // Errors that are not alike share 2 * 1 * 3 / (1 + 9).
  const Step better = StepBetween(
      from, LevelPose(2, 2.0, 0.0, 0.0, {9.0, 9.0, 0.0, 0.01}), settings);
  EXPECT_NEAR(better.relative.covariance[0], (1.0 - 0.6 * kept) * 10.0, 1e-12);
}

TEST(RelativePose, StepOfAFilterForgetsWhatItsTransitionForgets) {
  v1::VehicleSettings settings = G2oSettings(v1::STATE_SPACE_PLANAR);
  settings.set_correlation_model(v1::CORRELATION_MODEL_FILTER);
  const LocalPose from = LevelPose(1, 0.0, 0.0, 0.0, {1.0, 1.0, 0.0, 0.01});
  LocalPose to = LevelPose(2, 0.0, 0.0, 0.0, {1.0, 1.0, 0.0, 0.01});
  // Half of each error is carried on.
  to.error_transition =
      StateMatrix{0.5, 0, 0, 0, 0, 0.5, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0.5};
  const Step step = StepBetween(from, to, settings);
  EXPECT_NEAR(step.relative.covariance[0], 1.0 + 1.0 - 2.0 * 0.5, 1e-12);
  EXPECT_NEAR(step.relative.covariance[15], 0.01, 1e-12);
}

TEST(RelativePose, StepOfAModelOfANewerServerIsAsUncertainAsBothEnds) {
  v1::VehicleSettings settings = G2oSettings(v1::STATE_SPACE_PLANAR);
  settings.set_correlation_model(static_cast<v1::CorrelationModel>(99));
  const LocalPose from = LevelPose(1, 0.0, 0.0, 0.0, {1.0, 1.0, 0.0, 0.01});
  const Step step = StepBetween(
      from, LevelPose(2, 2.0, 0.0, 0.0, {1.0, 1.5, 0.0, 0.02}), settings);
  EXPECT_FALSE(step.raised);
  EXPECT_NEAR(step.relative.covariance[0], 2.0, 1e-12);
  EXPECT_NEAR(step.relative.covariance[15], 0.03, 1e-12);
}

TEST(RelativePose, StepIsNeverCertain) {
  // The claimed covariance shrinks.
  const Step step =
      StepBetween(LevelPose(1, 0.0, 0.0, 0.3, {1.0, 1.0, 0.0, 0.01}),
                  LevelPose(2, 1.0, 0.0, 0.3, {0.5, 0.5, 0.0, 0.001}),
                  G2oSettings(v1::STATE_SPACE_PLANAR));
  EXPECT_TRUE(step.raised);
  for (const double entry : PlanarInformation(step.relative)) {
    EXPECT_TRUE(std::isfinite(entry));
  }
  EXPECT_GE(step.relative.covariance[15], 0.999e-8);
  EXPECT_LT(step.relative.covariance[15], 1e-3);
}

TEST(RelativePose, ClosureWithoutMeasurementHeadsTheWayTheEstimatesDo) {
  const LocalPose matched = LevelPose(1, 0.0, 0.0, 0.2, {1, 1, 0, 0.01});
  const LocalPose same = LevelPose(9, 3.0, 0.0, 0.5, {1, 1, 0, 0.01});
  const LocalPose opposite = LevelPose(9, 3.0, 0.0, 3.0, {1, 1, 0, 0.01});
  const v1::LoopClosure closure;
  EXPECT_EQ(ClosureBetween(closure, matched, same).heading, 0.0);
  EXPECT_EQ(ClosureBetween(closure, matched, opposite).heading, kPi);
  EXPECT_THAT(ClosureBetween(closure, matched, same).position,
              ElementsAre(0.0, 0.0, 0.0));
}

TEST(RelativePose, InformationIsInTheAxesOfTheLaterPose) {
  // The later pose faces left: what is ahead of the earlier one, and known to
  // 0.1 m, is to the right of it.
  RelativePose relative;
  relative.heading = 0.5 * kPi;
  relative.covariance[0] = 0.01;
  relative.covariance[5] = 1.0;
  relative.covariance[15] = 0.25;
  EXPECT_THAT(PlanarInformation(relative),
              Pointwise(DoubleNear(1e-9), {1.0, 0.0, 0.0, 100.0, 0.0, 4.0}));
}

TEST(RelativePose, LevelSpatialEdgeIsThePlanarOne) {
  RelativePose relative;
  relative.position = {4.0, 1.0, 0.5};
  relative.heading = 0.5 * kPi;
  relative.covariance = {0.01, 0, 0, 0, 0, 1.0, 0, 0,
                         0,    0, 4, 0, 0, 0,   0, 0.25};
  const LocalPose from = LevelPose(1, 0, 0, 0.3, {1, 1, 1, 1});
  const LocalPose to = LevelPose(2, 0, 0, 1.0, {1, 1, 1, 1});
  const SpatialEdge edge = SpatialEdgeOf(relative, from, to);
  EXPECT_THAT(edge.position, Pointwise(DoubleNear(1e-12), {4.0, 1.0, 0.5}));
  const double half = std::sqrt(0.5);
  EXPECT_THAT(edge.orientation,
              Pointwise(DoubleNear(1e-12), {0.0, 0.0, half, half}));
  const auto& m = edge.information;
  EXPECT_NEAR(m[0], 1.0, 1e-9);
  EXPECT_NEAR(m[6], 100.0, 1e-9);
  EXPECT_NEAR(m[11], 0.25, 1e-9);
  // Roll and pitch are as uncertain as the heading.
  EXPECT_NEAR(m[15], 4.0, 1e-9);
  EXPECT_NEAR(m[18], 4.0, 1e-9);
  EXPECT_NEAR(m[20], 4.0, 1e-9);
}

// A pose that was never revised.
void Add(const LocalPose& pose, G2oWriter* writer) { writer->Add(pose, pose); }

TEST(G2oText, StepsAreThoseThatWereSentHoweverPosesWereRevised) {
  const v1::VehicleSettings settings = G2oSettings(v1::STATE_SPACE_PLANAR);
  const std::vector<v1::LoopClosure> none;
  const LocalPose first = LevelPose(1, 0.0, 0.0, 0.0, {1.0, 1.0, 0.0, 0.25});
  const LocalPose second =
      LevelPose(2, 2.0, 0.0, 0.0, {1.5, 2.25, 0.0, 0.3125});
  LocalPose revised = second;
  revised.position = {2.5, -0.5, 0.0};
  revised.heading = 0.25;
  std::ostringstream before;
  G2oWriter writer(settings, none, &before);
  Add(first, &writer);
  Add(second, &writer);
  std::ostringstream after;
  G2oWriter second_round(settings, none, &after);
  Add(first, &second_round);
  second_round.Add(revised, second);
  const auto edge = [](const std::ostringstream& out) {
    return out.str().substr(out.str().find("EDGE_SE2"));
  };
  EXPECT_EQ(edge(before), edge(after));
  EXPECT_THAT(after.str(), ::testing::HasSubstr("VERTEX_SE2 2 2.5 -0.5 0.25"));
  EXPECT_EQ(second_round.counts().raised, writer.counts().raised);
}

TEST(G2oText, VerticesAreSequencesAndClosuresLeadFromTheMatch) {
  v1::LoopClosure closure;
  closure.set_query_sequence(3);
  closure.set_matched_sequence(1);
  v1::LoopClosureMeasurement* measured = closure.mutable_measurement();
  measured->set_x_meters(0.5);
  measured->set_heading_radians(0.0);
  measured->mutable_covariance()->set_form(v1::COVARIANCE_FORM_PLANAR_6);
  for (const double value : {0.25, 0.0, 0.0, 0.25, 0.0, 0.0625}) {
    measured->mutable_covariance()->add_values(value);
  }
  const std::vector<v1::LoopClosure> closures = {closure};
  const v1::VehicleSettings settings = G2oSettings(v1::STATE_SPACE_PLANAR);
  std::ostringstream out;
  G2oWriter writer(settings, closures, &out);
  Add(LevelPose(1, 0.0, 0.0, 0.0, {1.0, 1.0, 0.0, 0.25}), &writer);
  // Nothing is known of a jump but its length.
  Add(LevelPose(2, 200.0, 0.0, 0.0, {1.25, 1.25, 0.0, 0.5}), &writer);
  Add(LevelPose(3, 200.0, 0.0, 0.0, {1.5, 1.5, 0.0, 0.75}), &writer);
  writer.AddClosures();
  EXPECT_EQ(writer.counts().poses, 3);
  EXPECT_EQ(writer.counts().jumps, 1);
  EXPECT_EQ(writer.counts().closures, 1);
  EXPECT_EQ(writer.counts().unmeasured_closures, 0);
  EXPECT_EQ(writer.counts().raised, 0);
  std::istringstream lines(out.str());
  std::string line;
  std::getline(lines, line);
  EXPECT_EQ(line, "VERTEX_SE2 1 0 0 0");
  std::getline(lines, line);
  EXPECT_EQ(line, "VERTEX_SE2 2 200 0 0");
  std::getline(lines, line);
  EXPECT_THAT(line, ::testing::StartsWith("EDGE_SE2 1 2 200 0 0 2.5"));
  std::getline(lines, line);
  std::getline(lines, line);
  EXPECT_THAT(line, ::testing::StartsWith("EDGE_SE2 2 3 0 0 0 "));
  std::getline(lines, line);
  EXPECT_EQ(line, "EDGE_SE2 1 3 0.5 0 0 4 0 0 4 0 16");
}

TEST(G2oText, StepOverDroppedPosesIsAsUncertainAsBothEnds) {
  for (const auto model :
       {v1::CORRELATION_MODEL_DEAD_RECKONING, v1::CORRELATION_MODEL_FILTER,
        v1::CORRELATION_MODEL_CORRELATED_FIXES}) {
    v1::VehicleSettings settings = G2oSettings(v1::STATE_SPACE_PLANAR);
    settings.set_correlation_model(model);
    std::ostringstream out;
    const std::vector<v1::LoopClosure> none;
    G2oWriter writer(settings, none, &out);
    Add(LevelPose(1, 0.0, 0.0, 0.0, {1.0, 1.0, 0.0, 0.125}), &writer);
    // A lap later, at the same place.
    Add(LevelPose(400, 0.0, 0.0, 0.0, {1.0, 1.0, 0.0, 0.125}), &writer);
    EXPECT_EQ(writer.counts().jumps, 0);
    EXPECT_EQ(writer.counts().gaps, 1);
    std::istringstream edge(out.str().substr(out.str().find("EDGE_SE2")));
    std::string tag;
    std::array<double, 11> numbers{};
    edge >> tag;
    for (double& number : numbers) edge >> number;
    EXPECT_THAT(numbers,
                Pointwise(DoubleNear(1e-9), {1.0, 400.0, 0.0, 0.0, 0.0, 0.5,
                                             0.0, 0.0, 0.5, 0.0, 4.0}));
  }
}

TEST(TrajectoryText, LinesHoldEveryDigit) {
  LocalPose pose = LevelPose(7, 0.1, -2.0, 0.5 * kPi, {1, 2, 3, 4});
  pose.position[2] = 1.0 / 3.0;
  pose.orientation = {0.0, 0.0, 0.6, 0.8};
  pose.stamp.emplace();
  pose.stamp->set_seconds(1606417097);
  pose.stamp->set_nanos(528000001);
  std::ostringstream tum;
  WriteTumLine(pose, tum);
  EXPECT_EQ(tum.str(),
            "1606417097.528000001 0.1 -2 0.3333333333333333 0 0 0.6 0.8\n");
  std::ostringstream kitti;
  WriteKittiLine(pose, kitti);
  std::istringstream numbers(kitti.str());
  std::vector<double> matrix(12);
  for (double& number : matrix) numbers >> number;
  EXPECT_THAT(matrix, Pointwise(DoubleNear(1e-15),
                                {0.28, -0.96, 0.0, 0.1, 0.96, 0.28, 0.0, -2.0,
                                 0.0, 0.0, 1.0, 1.0 / 3.0}));
  std::ostringstream csv;
  WriteCsvHeader(csv);
  WriteCsvLine(pose, false, csv);
  EXPECT_EQ(csv.str(),
            "sequence,t_s,est_x,est_y,est_z,est_yaw,qx,qy,qz,qw,"
            "pxx,pxy,pxz,pxt,pyy,pyz,pyt,pzz,pzt,ptt\n"
            "7,1606417097.528000001,0.1,-2,0.3333333333333333,"
            "1.5707963267948966,0,0,0.6,0.8,1,0,,0,2,,0,,,4\n");
}

TEST(ExactText, StampsBeforeTheEpochHaveOneSign) {
  google::protobuf::Timestamp stamp;
  stamp.set_seconds(-1);
  stamp.set_nanos(750'000'000);
  EXPECT_EQ(StampSeconds(stamp), "-0.25");
  stamp.set_seconds(-3);
  EXPECT_EQ(StampSeconds(stamp), "-2.25");
  stamp.set_seconds(12);
  stamp.set_nanos(999'999'999);
  EXPECT_EQ(StampText(stamp), "1970-01-01T00:00:13Z");
}

TEST(LocalFrame, GeodeticPosesAreTurnedIntoTheFrameOfTheOrigin) {
  v1::VehicleSettings settings = G2oSettings(v1::STATE_SPACE_SPATIAL);
  settings.set_coordinate_frame(v1::COORDINATE_FRAME_GEODETIC);
  settings.mutable_geodetic_origin()->set_latitude_degrees(60.0);
  settings.mutable_geodetic_origin()->set_longitude_degrees(10.0);
  const LocalFrame frame(settings);
  v1::Pose pose;
  pose.set_sequence(4);
  pose.mutable_geodetic()->set_latitude_degrees(60.0);
  pose.mutable_geodetic()->set_longitude_degrees(11.0);
  pose.set_heading_radians(0.0);
  pose.mutable_covariance()->set_form(v1::COVARIANCE_FORM_SPATIAL_10);
  for (const double value : {4., 0., 0., 0., 1., 0., 0., 1., 0., 0.01}) {
    pose.mutable_covariance()->add_values(value);
  }
  const LocalPose local = frame.Localize(pose);
  // One degree of longitude is half as long there as on the equator.
  EXPECT_NEAR(local.position[0], 55.8e3, 100.0);
  // East has turned by the convergence of the meridians.
  EXPECT_NEAR(local.heading,
              std::sin(60.0 * kRadiansPerDegree) * kRadiansPerDegree, 1e-4);
  EXPECT_NEAR(local.covariance[0], 4.0, 0.01);
  EXPECT_NEAR(local.covariance[1], 3.0 * local.heading, 1e-3);
  const v1::GeodeticPosition back = frame.ToGeodetic(local.position);
  EXPECT_NEAR(back.longitude_degrees(), 11.0, 1e-12);
  EXPECT_NEAR(back.latitude_degrees(), 60.0, 1e-12);
}

v1::Covariance PlanarVariances(double x, double y, double heading) {
  v1::Covariance covariance;
  covariance.set_form(v1::COVARIANCE_FORM_PLANAR_6);
  for (const double value : {x, 0.0, 0.0, y, 0.0, heading}) {
    covariance.add_values(value);
  }
  return covariance;
}

// The edges of a graph, without their tag: ids, relative pose, information.
std::vector<std::vector<double>> EdgesOf(const std::string& text) {
  std::vector<std::vector<double>> edges;
  std::istringstream lines(text);
  for (std::string line; std::getline(lines, line);) {
    if (line.rfind("EDGE_SE2 ", 0) != 0) continue;
    std::istringstream numbers(line.substr(9));
    edges.emplace_back();
    for (double number = 0.0; numbers >> number;) {
      edges.back().push_back(number);
    }
  }
  return edges;
}

TEST(G2oText, RecordingThatBeginsWhereTheLastEndedHasAnEdgeAcrossTheGap) {
  const std::vector<v1::LoopClosure> none;
  const v1::VehicleSettings settings = G2oSettings(v1::STATE_SPACE_PLANAR);
  std::ostringstream out;
  G2oWriter writer(settings, none, &out);
  Add(LevelPose(1, 0.0, 0.0, 0.0, {1.0, 1.0, 0.0, 0.25}), &writer);
  // Facing along y in its own frame, in whose x the gap is known best: that is
  // to the right of the body.
  LocalPose start = LevelPose(2, 500.0, 0.0, 0.5 * kPi, {1.0, 1.0, 0.0, 0.25});
  start.recording_start.emplace();
  *start.recording_start->mutable_after() = PlanarVariances(1.0, 4.0, 0.25);
  Add(start, &writer);
  const auto edges = EdgesOf(out.str());
  ASSERT_EQ(edges.size(), 1u);
  EXPECT_THAT(edges[0],
              Pointwise(DoubleNear(1e-9), {1.0, 2.0, 0.0, 0.0, 0.0, 0.25, 0.0,
                                           0.0, 1.0, 0.0, 4.0}));
  EXPECT_EQ(writer.counts().jumps, 0);
  EXPECT_EQ(writer.counts().recordings, 1);
  EXPECT_EQ(writer.counts().untied, 0);
}

TEST(G2oText, RecordingsWithDatumsAreJoinedFromStartToStart) {
  const std::vector<v1::LoopClosure> none;
  const v1::VehicleSettings settings = G2oSettings(v1::STATE_SPACE_PLANAR);
  std::ostringstream out;
  G2oWriter writer(settings, none, &out);
  LocalPose first = LevelPose(1, 0.0, 0.0, 0.0, {0.25, 0.25, 0.0, 0.25});
  first.recording_start.emplace();
  v1::Datum* const datum = first.recording_start->mutable_datum();
  *datum->mutable_covariance() = PlanarVariances(0.75, 0.75, 0.25);
  datum->mutable_pose()->set_x_meters(10.0);
  Add(first, &writer);
  Add(LevelPose(2, 5.0, 0.0, 0.0, {1.0, 1.0, 0.0, 1.0}), &writer);
  // Its frame is turned to the left, and begins where the first pose is.
  LocalPose second = first;
  second.sequence = 3;
  second.recording_start->mutable_datum()->mutable_pose()->set_heading_radians(
      0.5 * kPi);
  Add(second, &writer);
  const auto edges = EdgesOf(out.str());
  ASSERT_EQ(edges.size(), 2u);
  // Both datums and both poses err by 1 m2 and 0.5 rad2 together.
  EXPECT_THAT(edges[1],
              Pointwise(DoubleNear(1e-9), {1.0, 3.0, 0.0, 0.0, 0.5 * kPi, 0.5,
                                           0.0, 0.0, 0.5, 0.0, 1.0}));
  // Two recordings of one datum differ by the error of the poses alone.
  datum->set_datum_id("map");
  second.sequence = 2;
  second.recording_start->mutable_datum()->set_datum_id("map");
  std::ostringstream shared;
  G2oWriter again(settings, none, &shared);
  Add(first, &again);
  Add(second, &again);
  EXPECT_THAT(EdgesOf(shared.str())[0],
              Pointwise(DoubleNear(1e-9), {1.0, 2.0, 0.0, 0.0, 0.5 * kPi, 2.0,
                                           0.0, 0.0, 2.0, 0.0, 2.0}));
}

TEST(G2oText, NothingLeadsToARecordingOfWhichNothingIsKnown) {
  const std::vector<v1::LoopClosure> none;
  const v1::VehicleSettings settings = G2oSettings(v1::STATE_SPACE_PLANAR);
  std::ostringstream out;
  G2oWriter writer(settings, none, &out);
  Add(LevelPose(1, 0.0, 0.0, 0.0, {1.0, 1.0, 0.0, 0.25}), &writer);
  LocalPose unknown = LevelPose(2, 0.0, 0.0, 0.0, {1.0, 1.0, 0.0, 0.25});
  unknown.recording_start.emplace();
  unknown.recording_start->set_unknown(true);
  Add(unknown, &writer);
  // Nor to one with a datum where no other has one.
  LocalPose datum = unknown;
  datum.sequence = 3;
  datum.recording_start->mutable_datum();
  Add(datum, &writer);
  EXPECT_TRUE(EdgesOf(out.str()).empty());
  EXPECT_EQ(writer.counts().recordings, 2);
  EXPECT_EQ(writer.counts().untied, 2);
}

TEST(LocalPoseTest, PoseOfAFrameIsTurnedAndMovedWithItsCovariance) {
  const LocalPose pose = LevelPose(1, 2.0, 1.0, 0.25, {4.0, 9.0, 0.0, 0.01});
  v1::StatePose frame;
  frame.set_x_meters(100.0);
  frame.set_heading_radians(0.5 * kPi);
  const LocalPose moved = InOuterFrame(pose, frame);
  EXPECT_THAT(moved.position, Pointwise(DoubleNear(1e-12), {99.0, 2.0, 0.0}));
  EXPECT_NEAR(moved.heading, 0.5 * kPi + 0.25, 1e-12);
  EXPECT_NEAR(moved.covariance[0], 9.0, 1e-12);
  EXPECT_NEAR(moved.covariance[5], 4.0, 1e-12);
  EXPECT_NEAR(moved.covariance[15], 0.01, 1e-12);
  EXPECT_NEAR(2.0 * std::asin(moved.orientation[2]), 0.5 * kPi + 0.25, 1e-12);
}

TEST(TrajectoryText, CommentOfTumMarksWhereARecordingBegins) {
  LocalPose pose = LevelPose(7, 0.0, 0.0, 0.0, {1, 1, 1, 1});
  pose.stamp.emplace();
  pose.recording_start.emplace();
  pose.recording_start->set_label("tuesday");
  pose.recording_start->set_unknown(true);
  std::ostringstream tum;
  WriteTumLine(pose, tum);
  EXPECT_EQ(tum.str(),
            "# recording {\"label\":\"tuesday\",\"unknown\":true}\n"
            "0 0 0 0 0 0 0 1\n");
}

}  // namespace
}  // namespace revisit::client
