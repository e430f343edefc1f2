// The paper's simulation (section on the simulated vehicle, Fig. 3): the car of
// Bailey and Nieto's SLAM simulators drives laps of a closed course; its
// estimator only predicts, so uncertainty grows; it checks every 5 m with
// sequences of 30 m.
//
// Parameters are those of the simulators' configuration (2004): 3 m/s,
// wheelbase 4 m, steering within 30 degrees at 20 degrees/s, controls every 25
// ms with noise of 0.3 m/s and 3 degrees at each. The course is our own.
//
// The drawing of the run is left beside the test program: car_simulation.svg.
#include <gtest/gtest.h>

#include <Eigen/Core>
#include <Eigen/Eigenvalues>
#include <cmath>
#include <fstream>
#include <iostream>
#include <optional>
#include <string>
#include <vector>

#include "core/drive/drive.h"
#include "core/drive/pose_graph.h"
#include "core/geometry/heading.h"
#include "core/geometry/pose.h"
#include "core/geometry/state_matrix.h"
#include "core/search/search.h"
#include "core/settings.h"
#include "tests/random.h"

namespace revisit::core {
namespace {

constexpr double kSpeed = 3.0;
constexpr double kWheelbase = 4.0;
constexpr double kMaxSteer = 30.0 * kPi / 180.0;
constexpr double kMaxSteerRate = 20.0 * kPi / 180.0;
constexpr double kPeriod = 0.025;
constexpr double kSigmaSpeed = 0.3;
constexpr double kSigmaSteer = 3.0 * kPi / 180.0;
constexpr double kAtWaypoint = 1.0;

struct Point {
  double x;
  double y;
};

// Counter-clockwise, about 600 m.
const std::vector<Point> kCourse = {
    {30, 0},    {110, -5},  {160, 10}, {175, 50}, {150, 80},
    {165, 120}, {130, 150}, {80, 140}, {55, 105}, {10, 110},
    {-25, 85},  {-15, 40},  {-20, 5}};

struct SimulatedDrive {
  std::vector<Pose> truth;
  std::vector<PoseSample> estimate;
};

// The truth follows the course; the estimate integrates the noisy controls.
SimulatedDrive Simulate(int laps, std::mt19937_64& random) {
  SimulatedDrive run;
  Pose truth;
  Pose estimate;
  Eigen::Matrix3d covariance = 1e-6 * Eigen::Matrix3d::Identity();
  double steer = 0.0;
  std::size_t waypoint = 0;
  const std::size_t end = kCourse.size() * static_cast<std::size_t>(laps);
  const Eigen::Matrix2d control_noise =
      Eigen::Vector2d(kSigmaSpeed * kSigmaSpeed, kSigmaSteer * kSigmaSteer)
          .asDiagonal();
  for (int step = 0; waypoint < end && step < 100'000; ++step) {
    const Point goal = kCourse[waypoint % kCourse.size()];
    if (std::hypot(goal.x - truth.x, goal.y - truth.y) < kAtWaypoint) {
      ++waypoint;
      continue;
    }
    const double wanted = WrapHeading(
        std::atan2(goal.y - truth.y, goal.x - truth.x) - truth.heading - steer);
    steer += std::max(-kMaxSteerRate * kPeriod,
                      std::min(kMaxSteerRate * kPeriod, wanted));
    steer = std::max(-kMaxSteer, std::min(kMaxSteer, steer));

    const auto move = [](Pose* pose, double speed, double angle) {
      pose->x += speed * kPeriod * std::cos(angle + pose->heading);
      pose->y += speed * kPeriod * std::sin(angle + pose->heading);
      pose->heading += speed * kPeriod * std::sin(angle) / kWheelbase;
    };
    move(&truth, kSpeed, steer);

    const double v = kSpeed + Normal(random, kSigmaSpeed);
    const double g = steer + Normal(random, kSigmaSteer);
    const double s = std::sin(g + estimate.heading);
    const double c = std::cos(g + estimate.heading);
    Eigen::Matrix3d by_state = Eigen::Matrix3d::Identity();
    by_state(0, 2) = -v * kPeriod * s;
    by_state(1, 2) = v * kPeriod * c;
    Eigen::Matrix<double, 3, 2> by_control;
    by_control << kPeriod * c, -v * kPeriod * s,  //
        kPeriod * s, v * kPeriod * c,             //
        kPeriod * std::sin(g) / kWheelbase,
        v * kPeriod * std::cos(g) / kWheelbase;
    covariance = (by_state * covariance * by_state.transpose() +
                  by_control * control_noise * by_control.transpose())
                     .eval();
    move(&estimate, v, g);

    if (step % 8 != 0) continue;
    PoseSample sample;
    sample.sequence = run.estimate.size() + 1;
    sample.pose = estimate;
    sample.covariance = ToCovariance<3>(covariance);
    run.estimate.push_back(sample);
    run.truth.push_back(truth);
  }
  return run;
}

struct Check {
  NodeIndex query;
  NodeIndex matched;
  double error_meters;      // Between the true positions.
  double squared_in_plane;  // Squared Mahalanobis distance of x and y alone.
  double across_meters;     // Offset across the ellipse's longer axis,
  double along_meters;      // and along it.
  bool accepted;
  bool with_corner;  // In the sequence.
};

void Draw(const SimulatedDrive& run, const PoseGraph& graph,
          const std::vector<Check>& checks, const std::string& file) {
  std::ofstream svg(file);
  svg << "<svg xmlns='http://www.w3.org/2000/svg' viewBox='-60 -190 280 230'"
         " width='1120' height='920'>\n"
         "<rect x='-60' y='-190' width='280' height='230' fill='white'/>\n"
         "<g transform='scale(1,-1)' fill='none'>\n";
  const auto line = [&svg](const auto& poses, const char* colour,
                           const char* width) {
    svg << "<polyline stroke='" << colour << "' stroke-width='" << width
        << "' points='";
    for (const Pose& pose : poses) svg << pose.x << "," << pose.y << " ";
    svg << "'/>\n";
  };
  std::vector<Pose> estimate;
  for (const PoseSample& sample : run.estimate) estimate.push_back(sample.pose);
  line(run.truth, "#bbbbbb", "1.2");
  line(estimate, "#1f5fa8", "0.6");
  for (std::size_t i = 0; i < checks.size(); i += 2) {  // To keep them apart.
    const Check& check = checks[i];
    const Pose& pose = graph.node(check.query).pose;
    const Pose& matched = graph.node(check.matched).pose;
    const Eigen::Matrix2d position =
        ToMatrix<3>(graph.node(check.query).covariance).topLeftCorner<2, 2>();
    const Eigen::SelfAdjointEigenSolver<Eigen::Matrix2d> axes(position);
    const Eigen::Vector2d major = axes.eigenvectors().col(1);
    // 95 % of two degrees of freedom: 5.991.
    svg << "<ellipse cx='0' cy='0' rx='"
        << std::sqrt(5.991 * axes.eigenvalues()(1)) << "' ry='"
        << std::sqrt(5.991 * axes.eigenvalues()(0)) << "' transform='translate("
        << pose.x << "," << pose.y << ") rotate("
        << std::atan2(major.y(), major.x()) * 180.0 / kPi
        << ")' stroke='#d9822b' stroke-width='0.15'/>\n";
    svg << "<line x1='" << pose.x << "' y1='" << pose.y << "' x2='" << matched.x
        << "' y2='" << matched.y << "' stroke='"
        << (check.with_corner ? "#1a7f37" : "#b3261e")
        << "' stroke-width='0.5'/>\n"
        << "<circle cx='" << matched.x << "' cy='" << matched.y
        << "' r='0.9' fill='" << (check.with_corner ? "#1a7f37" : "#b3261e")
        << "'/>\n";
  }
  svg << "</g>\n<text x='-52' y='-178' font-size='5' font-family='sans-serif'>"
         "Best candidate of each check on laps 2 and 3 (green: a corner in the "
         "sequence; red: none),</text>\n<text x='-52' y='-170' font-size='5' "
         "font-family='sans-serif'>95 % ellipses; estimate blue, truth "
         "grey</text>\n</svg>\n";
}

struct Judged {
  SimulatedDrive run;
  PoseGraph graph;
  std::vector<Check> checks;
};

// Drives three laps and checks on the second and third, where every check is a
// true loop.
Judged DriveAndCheck(AlignmentKind alignment, std::mt19937_64& random) {
  Judged judged;
  judged.run = Simulate(3, random);
  DriveSettings settings;
  settings.node_spacing_meters = 1.0;
  settings.check_interval_meters = 5.0;
  settings.search.alignment = alignment;
  settings.search.sequence_length_meters = 30.0;
  settings.search.place_tolerance = {0.5, 0.05};
  Drive drive(settings);
  for (const PoseSample& sample : judged.run.estimate) {
    EXPECT_FALSE(FindDefect(sample, StateSpace::kPlanar)) << sample.sequence;
  }
  const AppendResult appended = drive.Append(judged.run.estimate, 1);
  const PoseGraph& graph = drive.graph();
  const auto truth = [&](NodeIndex i) {
    const Node& node = graph.node(i);
    const Pose& a = judged.run.truth[node.sequence - 1];
    if (node.fraction == 0.0) return a;
    const Pose step = Difference(judged.run.truth[node.sequence], a);
    return Pose{a.x + node.fraction * step.x, a.y + node.fraction * step.y, 0.0,
                a.heading + node.fraction * step.heading};
  };
  const double lap = drive.travelled_meters() / 3.0;
  Search search(&drive);
  for (NodeIndex query : appended.checks_due) {
    if (graph.node(query).travelled_meters < lap + 40.0) continue;
    const auto set = search.At(query, settings.search, nullptr);
    if (!set.ok() || set->candidates.empty()) {
      ADD_FAILURE() << "no candidate at node " << query;
      continue;
    }
    const Candidate& best = set->candidates[0];
    Check check;
    check.query = query;
    check.matched = best.matched;
    check.error_meters =
        Distance(truth(query), truth(best.matched), StateSpace::kPlanar);
    check.accepted = best.difference->gate.verdict == GateVerdict::kAccepted;
    const Eigen::Vector2d d(best.difference->difference.x,
                            best.difference->difference.y);
    Eigen::Matrix2d gamma =
        ToMatrix<3>(best.difference->covariance).topLeftCorner<2, 2>();
    gamma += 0.25 * Eigen::Matrix2d::Identity();
    check.squared_in_plane = d.dot(gamma.inverse() * d);
    const Eigen::SelfAdjointEigenSolver<Eigen::Matrix2d> axes(gamma);
    check.across_meters = std::abs(axes.eigenvectors().col(0).dot(d));
    check.along_meters = std::abs(axes.eigenvectors().col(1).dot(d));
    // Largest turn within the sequence.
    double turn = 0.0;
    for (NodeIndex i = query - 29; i <= query; ++i) {
      turn =
          std::max(turn, std::abs(WrapHeading(graph.node(i).pose.heading -
                                              graph.node(query).pose.heading)));
    }
    check.with_corner = turn > 35.0 * kPi / 180.0;
    judged.checks.push_back(check);
  }
  judged.graph = graph;
  return judged;
}

// Results of the checks of some drives.
struct Tally {
  int inside = 0;
  int accepted = 0;
  int straight = 0;
  int corner = 0;
  double straight_error = 0.0;
  double corner_error = 0.0;
  double across = 0.0;
  double along = 0.0;

  double count() const { return straight + corner; }
};

// Draws the first drive if a file is given.
Tally DriveMuch(int runs, AlignmentKind alignment,
                const std::optional<std::string>& drawing,
                std::mt19937_64& random) {
  Tally tally;
  for (int run = 0; run < runs; ++run) {
    const Judged judged = DriveAndCheck(alignment, random);
    if (run == 0 && drawing) {
      Draw(judged.run, judged.graph, judged.checks, *drawing);
    }
    for (const Check& check : judged.checks) {
      tally.inside += check.squared_in_plane <= 5.991;  // 95 % of two degrees.
      tally.accepted += check.accepted;
      tally.across += check.across_meters;
      tally.along += check.along_meters;
      if (check.with_corner) {
        ++tally.corner;
        tally.corner_error += check.error_meters;
      } else {
        ++tally.straight;
        tally.straight_error += check.error_meters;
      }
    }
  }
  tally.straight_error /= tally.straight;
  tally.corner_error /= tally.corner;
  std::cout << runs << " runs, " << tally.count() << " checks: accepted "
            << tally.accepted / tally.count() << ", within the 95 % ellipse "
            << tally.inside / tally.count()
            << "; mean offset along the ellipse " << tally.along / tally.count()
            << " m, across it " << tally.across / tally.count()
            << " m; mean error " << tally.straight_error << " m on "
            << tally.straight << " straight sequences, " << tally.corner_error
            << " m on " << tally.corner << " with a corner\n";
  EXPECT_GT(tally.straight, 100 * runs);
  EXPECT_GT(tally.corner, 80 * runs);
  return tally;
}

TEST(CarSimulationTest, CandidatesLieAlongTheEllipseAndImproveWithACorner) {
  std::mt19937_64 random = SeededRandom();
  const Tally tally =
      DriveMuch(24, AlignmentKind::kComposite, "car_simulation.svg", random);
  EXPECT_GE(tally.inside / tally.count(), 0.95);
  EXPECT_GE(tally.accepted / tally.count(), 0.95);
  EXPECT_LT(tally.across, 0.7 * tally.along);
  // Fewer drives are too few: with twelve, some seeds result in 0.79.
  EXPECT_LT(tally.corner_error, 0.75 * tally.straight_error);
}

TEST(CarSimulationTest, RelativeAlignmentComesWithinAMeterAfterACorner) {
  std::mt19937_64 random = SeededRandom();
  const Tally tally =
      DriveMuch(3, AlignmentKind::kRelative, std::nullopt, random);
  EXPECT_LT(tally.corner_error, 1.0);
  EXPECT_LT(tally.corner_error, 0.5 * tally.straight_error);
}

}  // namespace
}  // namespace revisit::core
