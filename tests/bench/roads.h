// A vehicle that drives a town's streets for as long as it takes, on honest
// dead reckoning: what the benchmarks search.
#ifndef REVISIT_TESTS_BENCH_ROADS_H_
#define REVISIT_TESTS_BENCH_ROADS_H_

#include <Eigen/Core>
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <map>
#include <memory>
#include <optional>
#include <random>
#include <vector>

#include "core/drive/pose_graph.h"
#include "core/geometry/frame_transform.h"
#include "core/geometry/heading.h"
#include "core/geometry/pose.h"
#include "core/geometry/recording_start.h"
#include "tests/oracle/dead_reckoning.h"
#include "tests/random.h"

namespace revisit::bench {

inline constexpr double kSpacing = 2.0;
// Sequences of 150 m.
inline constexpr std::int64_t kSteps = 75;

// Streets in blocks of about 100 m that nowhere lie quite straight: the town is
// a square that holds as many crossings as it takes for the drive to come by
// each road some twice. Corners are rounded off over 10 m.
inline std::vector<core::Pose> TownDrive(std::mt19937_64& random,
                                         core::NodeIndex nodes) {
  const double length = kSpacing * static_cast<double>(nodes);
  const int side = std::max(3, static_cast<int>(std::sqrt(length / 400.0)));
  const auto crossing = [side, &random] {
    std::vector<Eigen::Vector2d> at;
    for (int i = 0; i < side * side; ++i) {
      // Each by itself: compilers do not agree in which order arguments come.
      const double up = Uniform(random, -25.0, 25.0);
      const double along = Uniform(random, -25.0, 25.0);
      at.emplace_back(100.0 * (i % side) + along, 100.0 * (i / side) + up);
    }
    return at;
  }();
  // The middle line, then nodes along it.
  std::vector<Eigen::Vector2d> line = {crossing[0]};
  double driven = 0.0;
  int x = 0;
  int y = 0;
  int heading = 0;
  while (driven < length + 200.0) {
    // Straight on, or a turn; never back, unless nothing else is left.
    const int turns[] = {0, 0, 1, 3};
    int next = (heading + turns[UniformInt(random, 0, 3)]) % 4;
    for (int tries = 0;; ++tries) {
      static constexpr int kDx[] = {1, 0, -1, 0};
      static constexpr int kDy[] = {0, 1, 0, -1};
      const int to_x = x + kDx[next];
      const int to_y = y + kDy[next];
      if (to_x >= 0 && to_x < side && to_y >= 0 && to_y < side &&
          (next != (heading + 2) % 4 || tries > 20)) {
        x = to_x;
        y = to_y;
        heading = next;
        break;
      }
      next = UniformInt(random, 0, 3);
    }
    const auto to =
        static_cast<std::size_t>(y) * static_cast<std::size_t>(side) +
        static_cast<std::size_t>(x);
    driven += (crossing[to] - line.back()).norm();
    line.push_back(crossing[to]);
  }
  std::vector<core::Pose> path;
  std::size_t part = 0;
  double along = 0.0;
  const auto point = [&line](std::size_t i, double s) -> Eigen::Vector2d {
    const Eigen::Vector2d step = line[i + 1] - line[i];
    return line[i] + step * (s / step.norm());
  };
  // A lane's width to and fro, slowly.
  double swerve = 0.0;
  while (static_cast<core::NodeIndex>(path.size()) < nodes) {
    const double left = (line[part + 1] - line[part]).norm() - along;
    if (left <= 0.0) {
      ++part;
      along = -left;
      continue;
    }
    swerve = 0.95 * swerve + Normal(random, 0.15);
    const Eigen::Vector2d here = point(part, along);
    core::Pose pose;
    pose.x = here.x() + swerve;
    pose.y = here.y() - swerve;
    path.push_back(pose);
    along += kSpacing;
  }
  // Corners: a running mean over 10 m.
  std::vector<core::Pose> smooth = path;
  for (std::size_t i = 2; i + 2 < path.size(); ++i) {
    smooth[i].x = smooth[i].y = 0.0;
    for (std::size_t k = i - 2; k <= i + 2; ++k) {
      smooth[i].x += path[k].x / 5.0;
      smooth[i].y += path[k].y / 5.0;
    }
  }
  for (std::size_t i = 0; i + 1 < smooth.size(); ++i) {
    smooth[i].heading = std::atan2(smooth[i + 1].y - smooth[i].y,
                                   smooth[i + 1].x - smooth[i].x);
  }
  smooth.back().heading = smooth[smooth.size() - 2].heading;
  return smooth;
}

// The estimated drive, with the covariance of its dead reckoning, in so many
// recordings of about as many poses. Where there are several, each has a frame
// that begins where the vehicle is, and a datum of 10 m and 1 degree.
inline std::vector<core::PoseSample> RecordRoads(core::NodeIndex nodes,
                                                 core::NodeIndex recordings) {
  constexpr double kDatumMeters = 10.0;
  constexpr double kDatumRadians = core::kPi / 180.0;
  std::mt19937_64 random(20101015);
  const std::vector<core::Pose> truth = TownDrive(random, nodes);
  const oracle::Noise noise;
  std::vector<core::PoseSample> all;
  for (core::NodeIndex k = 0; k < recordings; ++k) {
    std::vector<core::Pose> part(truth.begin() + nodes * k / recordings,
                                 truth.begin() + nodes * (k + 1) / recordings);
    const core::Pose start = part.front();
    if (recordings > 1) {
      for (core::Pose& pose : part) {
        pose = core::Compose(core::Inverse(start), pose);
      }
    }
    for (core::PoseSample& sample : oracle::WithCovariances(
             oracle::DrawEstimate(part, noise, random), noise)) {
      sample.sequence = all.size() + 1;
      sample.pose.heading = core::WrapHeading(sample.pose.heading);
      // z is not reckoned: a level town, known to a metre.
      sample.covariance(2, 2) = 1.0;
      all.push_back(sample);
    }
    if (recordings == 1) continue;
    core::RecordingStart begun;
    begun.relation = core::RecordingRelation::kDatum;
    begun.datum = start;
    begun.datum.x += Normal(random, kDatumMeters);
    begun.datum.y += Normal(random, kDatumMeters);
    begun.datum.heading =
        core::WrapHeading(start.heading + Normal(random, kDatumRadians));
    for (const int i : {0, 1})
      begun.covariance(i, i) = kDatumMeters * kDatumMeters;
    begun.covariance(2, 2) = 1.0;
    begun.covariance(3, 3) = kDatumRadians * kDatumRadians;
    all[all.size() - part.size()].recording_start =
        std::make_shared<const core::RecordingStart>(begun);
  }
  return all;
}

// The same, in one recording.
inline core::PoseGraph MakeRoads(core::NodeIndex nodes) {
  core::PoseGraph graph;
  for (const core::PoseSample& sample : RecordRoads(nodes, 1)) {
    core::Node node;
    node.sequence = sample.sequence;
    node.travelled_meters = kSpacing * static_cast<double>(sample.sequence - 1);
    node.pose = sample.pose;
    node.covariance = sample.covariance;
    graph.AddNode(node, graph.size() == 0, std::nullopt);
  }
  return graph;
}

// The same drive by satellite fixes of 3 m and 0.05 rad; without noise, as
// something smooths them that claims as much.
inline core::PoseGraph MakeFixes(core::NodeIndex nodes, bool noise) {
  std::mt19937_64 random(20101015);
  core::PoseGraph graph;
  for (const core::Pose& truth : TownDrive(random, nodes)) {
    core::Node node;
    node.sequence = static_cast<std::uint64_t>(graph.size()) + 1;
    node.travelled_meters = kSpacing * static_cast<double>(graph.size());
    node.pose = truth;
    if (noise) {
      node.pose.x += Normal(random, 3.0);
      node.pose.y += Normal(random, 3.0);
      node.pose.heading += Normal(random, 0.05);
    }
    node.pose.heading = core::WrapHeading(node.pose.heading);
    for (const int i : {0, 1, 2}) node.covariance(i, i) = 9.0;
    node.covariance(3, 3) = 0.0025;
    graph.AddNode(node, graph.size() == 0, std::nullopt);
  }
  return graph;
}
inline core::PoseGraph MakeFixedRoads(core::NodeIndex nodes) {
  return MakeFixes(nodes, true);
}
inline core::PoseGraph MakeSmoothRoads(core::NodeIndex nodes) {
  return MakeFixes(nodes, false);
}

// Each is built once a process.
template <core::PoseGraph (*kMake)(core::NodeIndex)>
const core::PoseGraph& Built(core::NodeIndex nodes) {
  static std::map<core::NodeIndex, core::PoseGraph> graphs;
  auto found = graphs.find(nodes);
  if (found == graphs.end()) found = graphs.emplace(nodes, kMake(nodes)).first;
  return found->second;
}

inline const core::PoseGraph& Roads(core::NodeIndex nodes) {
  return Built<MakeRoads>(nodes);
}
inline const core::PoseGraph& FixedRoads(core::NodeIndex nodes) {
  return Built<MakeFixedRoads>(nodes);
}
inline const core::PoseGraph& SmoothRoads(core::NodeIndex nodes) {
  return Built<MakeSmoothRoads>(nodes);
}

}  // namespace revisit::bench

#endif  // REVISIT_TESTS_BENCH_ROADS_H_
