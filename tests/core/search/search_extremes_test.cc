// All inputs that pass FindDefect() and FindProblems() must be answered: the
// search runs in a server that serves other vehicles too.
#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <sstream>
#include <vector>

#include "core/drive/drive.h"
#include "core/geometry/heading.h"
#include "core/geometry/pose.h"
#include "core/search/search.h"
#include "core/settings.h"
#include "tests/random.h"

namespace revisit::core {
namespace {

double AnyOf(std::mt19937_64& random, const std::vector<double>& values) {
  return values[static_cast<std::size_t>(
      UniformInt(random, 0, static_cast<int>(values.size()) - 1))];
}

struct Extremes {
  DriveSettings settings;
  std::vector<PoseSample> samples;

  std::string Text() const {
    std::ostringstream text;
    text << samples.size() << " poses, spacing " << settings.node_spacing_meters
         << " m, model " << static_cast<int>(settings.search.correlation_model)
         << ", space " << static_cast<int>(settings.state_space)
         << ", first variances " << samples[0].covariance(0, 0) << " "
         << samples[0].covariance(3, 3);
    return text.str();
  }
};

Extremes DrawExtremes(std::mt19937_64& random) {
  Extremes extremes;
  DriveSettings& settings = extremes.settings;
  settings.state_space =
      UniformInt(random, 0, 1) ? StateSpace::kPlanar : StateSpace::kSpatial;
  settings.node_spacing_meters = AnyOf(random, {0.01, 2.0, 1000.0});
  settings.check_interval_meters = 1000.0;
  settings.max_step_meters =
      std::min(1e6, 1000.0 * settings.node_spacing_meters);
  settings.apply_inflation = UniformInt(random, 0, 1) == 1;
  settings.max_inflation = AnyOf(random, {1.0, 10.0, 100.0});
  SearchOptions& search = settings.search;
  search.correlation_model =
      static_cast<CorrelationModel>(UniformInt(random, 0, 2));
  search.direction = SearchDirection::kEither;
  search.sequence_length_meters =
      settings.node_spacing_meters * UniformInt(random, 1, 25);
  search.gate_probability =
      AnyOf(random, {std::numeric_limits<double>::denorm_min(), 1e-12, 0.5,
                     0.95, 1.0 - 1e-12, std::nextafter(1.0, 0.0)});
  search.place_tolerance = {AnyOf(random, {0.0, 2.0, 1000.0}),
                            AnyOf(random, {0.0, 0.1, 3.0})};
  search.candidate_separation_meters = AnyOf(random, {0.0, 10.0});
  search.shape.tolerance = {AnyOf(random, {0.01, 1.0, 1000.0}),
                            AnyOf(random, {0.001, 0.06, 3.0})};
  search.shape.correlation_meters = AnyOf(random, {0.01, 10.0, 1e6});
  search.road_spacing_meters = AnyOf(random, {1.0, 200.0, 1e6});
  search.acceptance_probability =
      AnyOf(random, {std::numeric_limits<double>::denorm_min(), 0.4,
                     std::nextafter(1.0, 0.0)});

  const double corner = AnyOf(random, {0.0, 9e7, -9e7});
  const double heading_turns = AnyOf(random, {0.0, 9.9e5, -9.9e5});
  const std::vector<double> deviations = {1e-6, 1e-3, 1.0, 1e3, 3e8};
  const double position = AnyOf(random, deviations);
  const double heading = AnyOf(random, deviations);
  const bool steady = UniformInt(random, 0, 1) == 1;
  const double transition = AnyOf(random, {0.0, 0.5, 1.0, 1e3, 1e9});
  const int poses = UniformInt(random, 60, 120);
  const std::int64_t stamp = UniformInt(random, 0, 1)
                                 ? std::numeric_limits<std::int64_t>::max()
                                 : std::numeric_limits<std::int64_t>::min();
  double along = 0.0;
  for (int i = 0; i < poses; ++i) {
    PoseSample sample;
    sample.sequence = static_cast<std::uint64_t>(i) + 1;
    sample.stamp_ns = stamp;
    // A circle of 40 steps, now and then a jump or a standstill.
    const double angle = 2.0 * kPi * along / 40.0;
    const double radius = 40.0 * settings.node_spacing_meters / (2.0 * kPi);
    sample.pose = {corner + radius * std::cos(angle),
                   corner + radius * std::sin(angle), corner,
                   heading_turns + angle};
    const int chance = UniformInt(random, 0, 40);
    if (chance == 0) sample.pose.x = -sample.pose.x;
    along += chance == 1 ? 0.0 : 1.0;
    for (int k = 0; k < 4; ++k) {
      const double deviation =
          steady ? (k == 3 ? heading : position) : AnyOf(random, deviations);
      sample.covariance(k, k) = deviation * deviation;
    }
    // Correlations close to the limit.
    if (UniformInt(random, 0, 1)) {
      sample.covariance(0, 3) = (1.0 - 1e-9) *
                                std::sqrt(sample.covariance(0, 0)) *
                                std::sqrt(sample.covariance(3, 3));
    }
    if (search.correlation_model == CorrelationModel::kFilter) {
      ErrorTransition a;
      for (double& value : a.values)
        value = transition * Uniform(random, -1.0, 1.0);
      sample.transition = a;
    }
    extremes.samples.push_back(sample);
  }
  return extremes;
}

void ExpectSane(const absl::StatusOr<CandidateSet>& set) {
  ASSERT_TRUE(set.ok());
  if (set->scale) {
    EXPECT_GT(set->scale->low, 0.0);
    EXPECT_LE(set->scale->low, set->scale->scale);
    EXPECT_LE(set->scale->scale, set->scale->high);
    EXPECT_TRUE(std::isfinite(set->scale->high));
  }
  if (set->new_place_probability) {
    EXPECT_GE(*set->new_place_probability, 0.0);
    EXPECT_LE(*set->new_place_probability, 1.0);
  }
  for (const Candidate& candidate : set->candidates) {
    EXPECT_TRUE(std::isfinite(candidate.score));
    EXPECT_TRUE(std::isfinite(candidate.inflation));
    EXPECT_GT(candidate.inflation, 0.0);
    EXPECT_FALSE(std::isnan(candidate.difference->gate.p_value));
    EXPECT_FALSE(candidate.path.empty());
    if (!candidate.relative) continue;
    EXPECT_GE(candidate.relative->probability, 0.0);
    EXPECT_LE(candidate.relative->probability, 1.0);
    EXPECT_FALSE(std::isnan(candidate.relative->path_gate.p_value));
    EXPECT_FALSE(std::isnan(candidate.relative->path_gate.threshold));
    EXPECT_FALSE(std::isnan(candidate.relative->squared_end_difference));
    EXPECT_FALSE(std::isnan(candidate.relative->log_likelihood_ratio));
  }
}

TEST(SearchExtremesTest, AnswersWhateverIsValid) {
  std::mt19937_64 random = SeededRandom();
  int with_candidates = 0;
  for (int trial = 0; trial < 400; ++trial) {
    const Extremes extremes = DrawExtremes(random);
    SCOPED_TRACE(extremes.Text());
    ASSERT_TRUE(FindProblems(extremes.settings).empty());
    for (const PoseSample& sample : extremes.samples) {
      const auto defect = FindDefect(sample, extremes.settings.state_space);
      ASSERT_FALSE(defect) << defect->description;
    }
    Drive drive(extremes.settings);
    drive.Append(extremes.samples, 1);
    std::uint64_t revision = 1;
    Search search(&drive);
    const auto any = [&] {
      return static_cast<std::uint64_t>(
          UniformInt(random, 1, static_cast<int>(extremes.samples.size())));
    };
    for (int k = 0; k < 6; ++k) {
      for (const AlignmentKind alignment :
           {AlignmentKind::kRelative, AlignmentKind::kComposite}) {
        SearchOptions options = extremes.settings.search;
        options.alignment = alignment;
        const auto set = search.AtEnd(options, nullptr);
        ExpectSane(set);
        with_candidates += set.ok() && !set->candidates.empty();
      }
      if (k % 3 == 2) {
        drive.AddRejection(any(), any(), ++revision);
      } else {
        drive.AddLoopClosure(any(), any(), ++revision);
      }
      EXPECT_TRUE(std::isfinite(drive.consistency().inflation));
      EXPECT_GE(drive.consistency().inflation, 1.0);
      EXPECT_LE(drive.consistency().inflation,
                extremes.settings.max_inflation * (1.0 + 1e-12));
    }
  }
  EXPECT_GT(with_candidates, 1000);
}

}  // namespace
}  // namespace revisit::core
