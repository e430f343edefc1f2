// How candidates in the drives of many other vehicles are judged, which have no
// more in common than a map in which each was placed with an error.
//
//   street_fleet ASKING OTHERS DATUM_METERS DATUM_DEGREES SEQUENCE_METERS
//     DRIVE...
//
// The first ASKING drives ask, each behind the first OTHERS of those that
// follow, every 50 m and in the others' histories alone. The truth of all
// drives is in one frame; each drive is in that of its first pose, which a
// datum places in the common one, with random errors of these standard
// deviations; with 0 metres, nothing places it. Nobody verifies. A candidate is
// right within 10 m and 45 degrees of the truth; a place is new where no other
// vehicle passed within 60 m in this direction. Prints one row: P and R of the
// best candidate of each check, how many at new places are accepted, the mean
// probability of a new place there, how many of those that are accepted with a
// probability of at least 0.9 are right, and the time of a check.
#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <iostream>
#include <memory>
#include <random>
#include <vector>

#include "absl/strings/str_format.h"
#include "client/formats/drive_file.h"
#include "core/drive/drive.h"
#include "core/drive/joined_drives.h"
#include "core/geometry/frame_transform.h"
#include "core/geometry/heading.h"
#include "core/geometry/pose.h"
#include "core/geometry/recording_start.h"
#include "core/search/search.h"
#include "core/search/search_scope.h"
#include "core/settings.h"
#include "tests/evaluation/claimed_samples.h"

namespace {

using namespace revisit::core;  // NOLINT: a program of one file.

struct Vehicle {
  std::vector<Pose> truth;
  std::unique_ptr<Drive> drive;
  std::shared_ptr<const DriveView> view;
  std::shared_ptr<const RecordingStart> datum;

  // The true pose of a node, but for what lies between two samples.
  const Pose& TruthOf(const PoseGraph& graph, NodeIndex node) const {
    return truth[graph.node(node).sequence - 1];
  }
};

Vehicle Load(const char* path, double meters, double radians,
             std::mt19937_64& random) {
  const auto read = revisit::client::ReadDriveFile(path, {});
  if (!read.ok() || read->truth.empty()) {
    std::cerr << path << ": it is no drive with truth\n";
    std::exit(1);
  }
  Vehicle vehicle;
  for (const revisit::client::PlanarPose& pose : read->truth) {
    vehicle.truth.push_back({pose.x, pose.y, 0.0, pose.heading});
  }
  std::normal_distribution<double> normal;
  Pose datum = vehicle.truth.front();
  datum.x += meters * normal(random);
  datum.y += meters * normal(random);
  datum.heading += radians * normal(random);
  auto start = std::make_shared<RecordingStart>();
  start->relation = RecordingRelation::kDatum;
  start->datum = datum;
  start->covariance(0, 0) = start->covariance(1, 1) = meters * meters;
  start->covariance(2, 2) = 1.0;
  start->covariance(3, 3) = radians * radians;
  if (meters > 0.0) vehicle.datum = start;
  std::vector<PoseSample> samples = revisit::evaluation::SamplesOf(*read);
  const Pose to_own = Inverse(vehicle.truth.front());
  for (PoseSample& sample : samples) {
    sample.pose = Compose(to_own, sample.pose);
  }
  // Claims are those of the axes of the map.
  const double c = std::cos(to_own.heading);
  const double s = std::sin(to_own.heading);
  for (PoseSample& sample : samples) {
    const Covariance map = sample.covariance;
    Covariance& own = sample.covariance;
    own(0, 0) = c * c * map(0, 0) - 2 * c * s * map(0, 1) + s * s * map(1, 1);
    own(1, 1) = s * s * map(0, 0) + 2 * c * s * map(0, 1) + c * c * map(1, 1);
    own(0, 1) = c * s * (map(0, 0) - map(1, 1)) + (c * c - s * s) * map(0, 1);
    own(0, 3) = c * map(0, 3) - s * map(1, 3);
    own(1, 3) = s * map(0, 3) + c * map(1, 3);
  }
  vehicle.drive = std::make_unique<Drive>(DriveSettings());
  vehicle.drive->Append(samples, 1);
  vehicle.view = vehicle.drive->View(1.0);
  return vehicle;
}

bool IsSamePlace(const Pose& a, const Pose& b, double meters) {
  return std::hypot(a.x - b.x, a.y - b.y) <= meters &&
         std::abs(WrapHeading(a.heading - b.heading)) <= kPi / 4;
}

bool IsPassed(const std::vector<Vehicle>& others, const Pose& truth,
              double meters) {
  for (const Vehicle& other : others) {
    for (const Pose& pose : other.truth) {
      if (IsSamePlace(pose, truth, meters)) return true;
    }
  }
  return false;
}

struct Score {
  int checks = 0;
  int passed = 0;
  int accepted = 0;
  int right = 0;
  int at_new = 0;
  int accepted_at_new = 0;
  double new_probability = 0.0;
  int sure = 0;
  int sure_right = 0;
  double seconds = 0.0;
};

void Ask(const Vehicle& asking, const std::vector<Vehicle>& others,
         double sequence_meters, Score* score) {
  std::vector<JoinedDrive> joined;
  for (const Vehicle& other : others) {
    joined.push_back({other.view, other.datum});
  }
  joined.push_back({asking.view, asking.datum});
  const SearchScope scope{std::make_shared<const JoinedDrives>(
                              std::move(joined), std::vector<FrameLink>()),
                          others.size(), /*exclude_own=*/true};
  const PoseGraph& graph = asking.drive->graph();
  SearchOptions options = asking.drive->settings().search;
  options.sequence_length_meters = sequence_meters;
  Search search(asking.drive.get());
  for (NodeIndex node = 25; node < graph.size(); node += 25) {
    const auto begin = std::chrono::steady_clock::now();
    const auto found = search.At(node, options, scope, nullptr);
    score->seconds +=
        std::chrono::duration<double>(std::chrono::steady_clock::now() - begin)
            .count();
    if (!found.ok() || found->empty_reason == EmptyReason::kPathTooShort) {
      continue;
    }
    const Pose& truth = asking.TruthOf(graph, node);
    const bool passed = IsPassed(others, truth, 10.0);
    const bool is_new = !IsPassed(others, truth, 60.0);
    const bool accepted =
        !found->candidates.empty() &&
        found->candidates.front().verdict == Verdict::kAccepted;
    ++score->checks;
    score->passed += passed ? 1 : 0;
    score->at_new += is_new ? 1 : 0;
    if (is_new) {
      score->accepted_at_new += accepted ? 1 : 0;
      score->new_probability += found->new_place_probability.value_or(1.0);
    }
    if (!accepted) continue;
    const Candidate& best = found->candidates.front();
    const Vehicle& other = others[*best.drive];
    const bool right = IsSamePlace(
        other.TruthOf(other.drive->graph(), best.matched), truth, 10.0);
    ++score->accepted;
    score->right += right ? 1 : 0;
    if (best.relative->probability < 0.9) continue;
    ++score->sure;
    score->sure_right += right ? 1 : 0;
  }
}

}  // namespace

int main(int argc, char** argv) {
  if (argc < 8) {
    std::cerr << "usage: street_fleet ASKING OTHERS DATUM_METERS "
                 "DATUM_DEGREES SEQUENCE_METERS DRIVE...\n";
    return 2;
  }
  const int asking = std::atoi(argv[1]);
  const int others = std::atoi(argv[2]);
  const double meters = std::atof(argv[3]);
  const double radians = std::atof(argv[4]) * kPi / 180.0;
  const double sequence_meters = std::atof(argv[5]);
  if (asking < 1 || others < 1 || argc < 6 + asking + others) {
    std::cerr << "there are fewer drives than that\n";
    return 2;
  }
  std::mt19937_64 random(20101015);
  std::vector<Vehicle> asked;
  std::vector<Vehicle> behind;
  for (int i = 0; i < asking + others; ++i) {
    (i < asking ? asked : behind)
        .push_back(Load(argv[6 + i], meters, radians, random));
  }
  Score score;
  for (const Vehicle& vehicle : asked)
    Ask(vehicle, behind, sequence_meters, &score);
  std::cout << absl::StrFormat(
      "| %d | %.0f m | %.0f m | %d | %d | %.3f | %.3f | %d of %d | %.2f | %d "
      "of %d | "
      "%.1f ms |\n",
      others, meters, sequence_meters, score.checks, score.passed,
      score.right / std::max(1.0, 1.0 * score.accepted),
      score.right / std::max(1.0, 1.0 * score.passed), score.accepted_at_new,
      score.at_new, score.new_probability / std::max(1, score.at_new),
      score.sure_right, score.sure,
      1e3 * score.seconds / std::max(1, score.checks));
  return 0;
}
