// Drives through a town by dead reckoning whose loop closures a verifier has
// confirmed, of which some are wrong.
#ifndef REVISIT_TESTS_CORE_DRIVE_CLOSED_DRIVES_H_
#define REVISIT_TESTS_CORE_DRIVE_CLOSED_DRIVES_H_

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <random>
#include <set>
#include <utility>
#include <vector>

#include "core/drive/confirmed_loop.h"
#include "core/drive/drive.h"
#include "core/drive/measured_loop.h"
#include "core/drive/suspects.h"
#include "core/geometry/frame_transform.h"
#include "core/geometry/heading.h"
#include "core/geometry/pose.h"
#include "core/settings.h"
#include "tests/bench/roads.h"
#include "tests/oracle/dead_reckoning.h"
#include "tests/random.h"

namespace revisit::core {

struct VerifiedLoop {
  // Indexes of the poses.
  std::size_t query = 0;
  std::size_t matched = 0;
  bool is_wrong = false;
  // How far apart the two poses truly are.
  double off_meters = 0.0;
};

struct ClosedDrive {
  explicit ClosedDrive(const DriveSettings& settings) : drive(settings) {}

  std::vector<Pose> truth;
  std::vector<PoseSample> samples;
  std::vector<VerifiedLoop> loops;
  Drive drive;
};

// Which closures are wrong, and how.
enum class WrongLoops { kAnywhere, kNear };

// Distances of a wrong match from the right place for kNear, and the least for
// kAnywhere.
inline constexpr double kWrongFrom = 30.0;
inline constexpr double kWrongUpTo = 100.0;

inline double TrueDistance(const std::vector<Pose>& truth, std::size_t a,
                           std::size_t b) {
  return std::hypot(truth[a].x - truth[b].x, truth[a].y - truth[b].y);
}

// The pose nearest to the query on an earlier pass of its road in the same
// direction, within 4 m and at least 200 m back; the query itself if there is
// none.
inline std::size_t EarlierPass(const std::vector<Pose>& truth,
                               std::size_t query) {
  std::size_t nearest = query;
  double least = 4.0;
  double back = 0.0;
  for (std::size_t i = query; i-- > 0;) {
    back += TrueDistance(truth, i, i + 1);
    const double meters = TrueDistance(truth, i, query);
    if (back > 200.0 && meters < least &&
        std::abs(WrapHeading(truth[i].heading - truth[query].heading)) < 0.3) {
      least = meters;
      nearest = i;
    }
  }
  return nearest;
}

inline std::size_t WrongMatch(const std::vector<Pose>& truth, std::size_t query,
                              std::size_t right, WrongLoops wrong,
                              std::mt19937_64& random) {
  for (int tries = 0; tries < 100'000; ++tries) {
    std::size_t i = static_cast<std::size_t>(
        UniformInt(random, 0, static_cast<int>(query) - 101));
    if (wrong == WrongLoops::kNear) {
      const int along = UniformInt(random, 15, 100);
      const auto at = static_cast<int>(right) +
                      (UniformInt(random, 0, 1) == 0 ? along : -along);
      if (at < 0 || at + 100 >= static_cast<int>(query)) continue;
      i = static_cast<std::size_t>(at);
    }
    const double meters = TrueDistance(truth, i, query);
    if (meters >= kWrongFrom &&
        (wrong == WrongLoops::kAnywhere || meters <= kWrongUpTo)) {
      return i;
    }
  }
  return right;
}

// Where the query lies as seen from the right match, measured to 0.2 m and 0.01
// rad; a verifier that errs claims as much.
inline std::shared_ptr<const MeasuredLoop> MeasuredBetween(
    const ClosedDrive& closed, std::size_t query, std::size_t matched,
    std::size_t right, std::mt19937_64& random) {
  MeasuredLoop loop;
  loop.query = {closed.samples[query].pose, closed.samples[query].covariance};
  loop.matched = {closed.samples[matched].pose,
                  closed.samples[matched].covariance};
  loop.measurement.relative =
      Compose(Inverse(closed.truth[right]), closed.truth[query]);
  loop.measurement.relative.x += Normal(random, 0.2);
  loop.measurement.relative.y += Normal(random, 0.2);
  loop.measurement.relative.heading += Normal(random, 0.01);
  for (const int k : {0, 1, 2}) loop.measurement.covariance(k, k) = 0.04;
  loop.measurement.covariance(3, 3) = 1e-4;
  return std::make_shared<const MeasuredLoop>(loop);
}

// Checks every 50 m. Wherever a drive passes a place again, this is confirmed,
// one time in five at a wrong place.
inline void CloseLoops(WrongLoops wrong, bool measured, std::mt19937_64& random,
                       ClosedDrive* closed) {
  const std::vector<Pose>& truth = closed->truth;
  double since_check = 0.0;
  double driven = 0.0;
  for (std::size_t query = 1; query < truth.size(); ++query) {
    const double step = TrueDistance(truth, query - 1, query);
    driven += step;
    since_check += step;
    if (since_check < 50.0 || driven < 300.0 || query < 150) continue;
    since_check = 0.0;
    const std::size_t right = EarlierPass(truth, query);
    if (right == query) continue;
    VerifiedLoop loop{query, right, UniformInt(random, 1, 5) == 1, 0.0};
    if (loop.is_wrong) {
      loop.matched = WrongMatch(truth, query, right, wrong, random);
      loop.is_wrong = loop.matched != right;
    }
    loop.off_meters = TrueDistance(truth, query, loop.matched);
    closed->drive.AddLoopClosure(
        query + 1, loop.matched + 1, closed->drive.revision() + 1,
        measured ? MeasuredBetween(*closed, query, loop.matched, right, random)
                 : nullptr);
    closed->loops.push_back(loop);
  }
}

// A simulated drive of so many nodes with such closures.
inline ClosedDrive RandomClosedDrive(const DriveSettings& settings,
                                     core::NodeIndex nodes, WrongLoops wrong,
                                     bool measured, std::mt19937_64& random) {
  ClosedDrive closed(settings);
  closed.truth = bench::TownDrive(random, nodes);
  oracle::Noise noise;
  noise.heading_radians = 0.002;
  closed.samples = oracle::WithCovariances(
      oracle::DrawEstimate(closed.truth, noise, random), noise);
  for (PoseSample& sample : closed.samples) {
    sample.pose.heading = WrapHeading(sample.pose.heading);
    sample.covariance(2, 2) = 1.0;
  }
  closed.drive.Append(closed.samples, 1);
  CloseLoops(wrong, measured, random, &closed);
  return closed;
}

// How often suspects were right.
struct SuspectScore {
  int wrong = 0;
  int wrong_suspected = 0;
  int right = 0;
  int right_suspected = 0;

  void Add(const ClosedDrive& closed, const std::vector<Suspect>& suspects) {
    std::set<std::pair<std::uint64_t, std::uint64_t>> suspected;
    for (const Suspect& suspect : suspects) {
      suspected.insert({suspect.query_sequence, suspect.matched_sequence});
    }
    for (const VerifiedLoop& loop : closed.loops) {
      const bool is_suspect =
          suspected.count({loop.query + 1, loop.matched + 1}) > 0;
      ++(loop.is_wrong ? wrong : right);
      if (is_suspect) ++(loop.is_wrong ? wrong_suspected : right_suspected);
    }
  }
  double recall() const {
    return static_cast<double>(wrong_suspected) / std::max(1, wrong);
  }
  double right_share() const {
    return static_cast<double>(right_suspected) / std::max(1, right);
  }
};

}  // namespace revisit::core

#endif  // REVISIT_TESTS_CORE_DRIVE_CLOSED_DRIVES_H_
