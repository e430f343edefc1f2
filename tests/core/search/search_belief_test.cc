// Searches learn from the drive before.
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <iterator>
#include <optional>
#include <utility>
#include <vector>

#include "absl/status/status.h"
#include "core/drive/drive.h"
#include "core/drive/pose_graph.h"
#include "core/geometry/pose.h"
#include "core/search/search.h"
#include "core/settings.h"
#include "tests/core/drive/drives.h"
#include "tests/core/search/candidate_sets.h"
#include "tests/oracle/dead_reckoning.h"
#include "tests/random.h"

namespace revisit::core {
namespace {

oracle::Noise SomeNoise() {
  oracle::Noise noise;
  noise.along_meters = 0.05;
  noise.across_meters = 0.03;
  noise.heading_radians = 0.001;
  return noise;
}

// Four laps whose claims are so many times as large as the noise.
std::vector<PoseSample> Laps(std::mt19937_64& random, double claimed) {
  std::vector<PoseSample> samples = oracle::WithCovariances(
      oracle::DrawEstimate(Ring(4200.0), SomeNoise(), random), SomeNoise());
  for (PoseSample& sample : samples) {
    for (double& entry : sample.covariance.upper) entry *= claimed * claimed;
  }
  return samples;
}

// The findings of each check.
using Answers = std::vector<std::pair<NodeIndex, CandidateSet>>;

// Streams the poses in batches, and searches at each check.
Answers Stream(const std::vector<PoseSample>& samples, std::size_t batch,
               Drive* drive, Search* search) {
  Answers answers;
  for (std::size_t first = 0; first < samples.size(); first += batch) {
    const std::size_t last = std::min(samples.size(), first + batch);
    const AppendResult appended =
        drive->Append({samples.begin() + static_cast<std::ptrdiff_t>(first),
                       samples.begin() + static_cast<std::ptrdiff_t>(last)},
                      drive->revision() + 1);
    for (const NodeIndex node : appended.checks_due) {
      answers.emplace_back(
          node, *search->At(node, drive->settings().search, nullptr));
    }
  }
  return answers;
}

TEST(SearchBeliefTest, AnAnswerIsTheSameStreamedAskedLaterAndByAnotherSearch) {
  std::mt19937_64 random = SeededRandom();
  const std::vector<PoseSample> samples = Laps(random, 2.0);
  Drive drive((DriveSettings()));
  Search search(&drive);
  const Answers streamed = Stream(samples, 37, &drive, &search);
  ASSERT_GT(streamed.size(), 50u);
  const SearchOptions& options = drive.settings().search;
  Search later(&drive);
  std::size_t found = 0;
  for (std::size_t k = streamed.size(); k-- > 0;) {
    SCOPED_TRACE(streamed[k].first);
    const auto& [node, answer] = streamed[k];
    ExpectSameAnswers(answer, *search.At(node, options, nullptr));
    ExpectSameAnswers(answer, *later.At(node, options, nullptr));
    if (k % 10 == 0) {
      ExpectSameAnswers(answer, *Search(&drive).At(node, options, nullptr));
    }
    found += !answer.candidates.empty();
  }
  EXPECT_GT(found, 30u);
}

TEST(SearchBeliefTest, ClosuresAndRejectionsDoNotChangeWhatMarksHaveShown) {
  std::mt19937_64 random = SeededRandom();
  const std::vector<PoseSample> samples = Laps(random, 1.0);
  Drive drive((DriveSettings()));
  Search search(&drive);
  const Answers streamed = Stream(samples, 100, &drive, &search);
  const std::size_t marks = search.mark_count();
  const CandidateSet& last = streamed.back().second;
  ASSERT_FALSE(last.candidates.empty());
  const PoseGraph& graph = drive.graph();
  drive.AddLoopClosure(graph.node(*last.query).sequence,
                       graph.node(last.candidates[0].matched).sequence,
                       drive.revision() + 1);
  const CandidateSet known = *search.AtEnd(drive.settings().search, nullptr);
  Search anew(&drive);
  ExpectSameAnswers(known, *anew.AtEnd(drive.settings().search, nullptr));
  EXPECT_EQ(known.scale->scale, last.scale->scale);
  EXPECT_LE(search.mark_count(), marks + 1);
}

// The ring, so many times as large: the less a road bends, the less its shape
// says where along it the vehicle is.
std::vector<Pose> WideRing(double meters, int times) {
  std::vector<Pose> poses;
  for (Pose pose : Ring(meters / times)) {
    for (int i = 0; i < times; ++i) {
      poses.push_back({times * pose.x + i * std::cos(pose.heading),
                       times * pose.y + i * std::sin(pose.heading), 0.0,
                       pose.heading});
    }
  }
  return poses;
}

// A verifier confirms what is some metres off, and the next candidate would be
// found from there, and so on.
TEST(SearchBeliefTest, AClosureOutweighsOnlyTheMarksThatItContradicts) {
  std::mt19937_64 random = SeededRandom();
  const std::vector<PoseSample> samples = oracle::WithCovariances(
      oracle::DrawEstimate(WideRing(4600.0, 3), SomeNoise(), random),
      SomeNoise());
  Drive drive((DriveSettings()));
  Search search(&drive);
  const CandidateSet alone =
      Stream(samples, 100, &drive, &search).back().second;
  ASSERT_FALSE(alone.candidates.empty());
  const NodeIndex here = *alone.query;
  const NodeIndex there = alone.candidates[0].matched;
  const auto meters_moved = [&](NodeIndex confirmed) {
    const PoseGraph& graph = drive.graph();
    const std::uint64_t query = graph.node(here).sequence;
    const std::uint64_t matched = graph.node(confirmed).sequence;
    drive.AddLoopClosure(query, matched, drive.revision() + 1);
    const CandidateSet set = *search.At(here, drive.settings().search, nullptr);
    drive.RemoveLoopClosure(query, matched, drive.revision() + 1);
    return graph.node(set.candidates.at(0).matched).travelled_meters -
           graph.node(there).travelled_meters;
  };
  // Twelve meters, and fifty, either way.
  EXPECT_NEAR(meters_moved(there - 6), 0.0, 4.0);
  EXPECT_NEAR(meters_moved(there + 6), 0.0, 4.0);
  EXPECT_LT(meters_moved(there - 25), -25.0);
  EXPECT_GT(meters_moved(there + 25), 25.0);
}

TEST(SearchBeliefTest, LearnsThatClaimsAreTooWideOrTooNarrow) {
  const std::mt19937_64 random = SeededRandom();
  // The errors are the same under all claims: how far one drive has drifted
  // changes what is learned by more than the bounds.
  const auto learned = [&random](double claimed) {
    std::mt19937_64 same = random;
    Drive drive((DriveSettings()));
    Search search(&drive);
    return Stream(Laps(same, claimed), 100, &drive, &search)
        .back()
        .second.scale->scale;
  };
  const double honest = learned(1.0);
  EXPECT_LT(learned(4.0), 0.8 * honest);
  EXPECT_GT(learned(0.25), 1.5 * honest);
}

TEST(SearchBeliefTest, WideClaimsFindAboutAsMuchAsHonestOnes) {
  std::mt19937_64 random = SeededRandom();
  const auto accepted = [&random](double claimed) {
    Drive drive((DriveSettings()));
    Search search(&drive);
    int count = 0;
    for (const auto& [node, set] :
         Stream(Laps(random, claimed), 100, &drive, &search)) {
      count += !set.candidates.empty() &&
               set.candidates[0].verdict == Verdict::kAccepted;
    }
    return count;
  };
  const int honest = accepted(1.0);
  EXPECT_GT(honest, 40);
  EXPECT_GE(accepted(4.0), honest * 9 / 10);
  EXPECT_GE(accepted(0.25), honest * 9 / 10);
}

TEST(SearchBeliefTest, NothingIsBelievedWhereTheSettingsSaySo) {
  std::mt19937_64 random = SeededRandom();
  const std::vector<PoseSample> samples = Laps(random, 1.0);
  Drive drive((DriveSettings()));
  drive.Append(samples, 1);
  Search search(&drive);
  SearchOptions options = drive.settings().search;
  options.use_belief = false;
  EXPECT_FALSE(search.AtEnd(options, nullptr)->scale);
  options = drive.settings().search;
  options.alignment = AlignmentKind::kComposite;
  EXPECT_FALSE(search.AtEnd(options, nullptr)->scale);
  options = drive.settings().search;
  options.correlation_model = CorrelationModel::kIndependent;
  EXPECT_FALSE(search.AtEnd(options, nullptr)->scale);
  EXPECT_EQ(search.mark_count(), 0u);
}

// Searches at the newest node after a change of the settings, and compares with
// a drive that has had no others. Returns whether the marks that were known
// before are still known.
bool KeepsMarks(const std::vector<PoseSample>& samples,
                const std::function<void(DriveSettings*)>& change) {
  Drive drive((DriveSettings()));
  drive.Append(samples, 1);
  const NodeIndex query = drive.graph().size() - 1;
  Search search(&drive);
  EXPECT_TRUE(search.AtEnd(drive.settings().search, nullptr).ok());
  DriveSettings settings = drive.settings();
  change(&settings);
  EXPECT_TRUE(drive.ChangeSettings(settings, drive.revision() + 1).ok());
  // Whether or not a search begins with a belief now, one could.
  SearchOptions believing = settings.search;
  believing.use_belief = true;
  const bool keeps = !search.FindMissingMark(query, believing);
  Drive fresh(settings);
  fresh.Append(samples, 1);
  Search anew(&fresh);
  ExpectSameAnswers(*search.AtEnd(settings.search, nullptr),
                    *anew.AtEnd(settings.search, nullptr));
  return keeps;
}

TEST(SearchBeliefTest, MarksOutliveSettingsThatTheyDoNotDependOn) {
  std::mt19937_64 random = SeededRandom();
  const std::vector<PoseSample> samples = Laps(random, 1.0);
  const std::function<void(DriveSettings*)> changes[] = {
      [](DriveSettings*) {},
      [](DriveSettings* s) { s->check_interval_meters = 80.0; },
      [](DriveSettings* s) { s->apply_inflation = true; },
      [](DriveSettings* s) { s->max_inflation = 5.0; },
      [](DriveSettings* s) { s->retention.max_passes = 3; },
      [](DriveSettings* s) { s->search.gate_probability = 0.9; },
      [](DriveSettings* s) { s->search.max_candidates = 2; },
      [](DriveSettings* s) { s->search.acceptance_probability = 0.6; },
      [](DriveSettings* s) { s->search.exhaustive = true; },
      [](DriveSettings* s) { s->search.use_belief = false; },
      [](DriveSettings* s) { s->search.fix_correlation_meters = 30.0; },
      [](DriveSettings* s) {
        s->search.likelihood_form = LikelihoodForm::kAsPrinted;
      }};
  for (std::size_t k = 0; k < std::size(changes); ++k) {
    SCOPED_TRACE(k);
    EXPECT_TRUE(KeepsMarks(samples, changes[k]));
  }
}

TEST(SearchBeliefTest, MarksAreSearchedAnewWhereSettingsChangeThem) {
  std::mt19937_64 random = SeededRandom();
  const std::vector<PoseSample> samples = Laps(random, 1.0);
  const std::function<void(DriveSettings*)> changes[] = {
      [](DriveSettings* s) { s->search.direction = SearchDirection::kEither; },
      [](DriveSettings* s) { s->search.sequence_length_meters = 120.0; },
      [](DriveSettings* s) { s->search.place_tolerance.position_meters = 8; },
      [](DriveSettings* s) { s->search.place_tolerance.heading_radians = 1; },
      [](DriveSettings* s) { s->search.candidate_separation_meters = 40.0; },
      [](DriveSettings* s) { s->search.shape.tolerance.position_meters = 2; },
      [](DriveSettings* s) { s->search.shape.correlation_meters = 30.0; },
      [](DriveSettings* s) { s->search.road_spacing_meters = 50.0; }};
  for (std::size_t k = 0; k < std::size(changes); ++k) {
    SCOPED_TRACE(k);
    EXPECT_FALSE(KeepsMarks(samples, changes[k]));
  }
}

TEST(SearchBeliefTest, MarksMayBeLearnedOneByOneBeforeASearch) {
  std::mt19937_64 random = SeededRandom();
  Drive drive((DriveSettings()));
  drive.Append(Laps(random, 1.0), 1);
  const SearchOptions& options = drive.settings().search;
  const NodeIndex query = drive.graph().size() - 1;
  const CandidateSet at_once = *Search(&drive).At(query, options, nullptr);
  Search search(&drive);
  std::int64_t comparisons = 0;
  while (const auto missing = search.FindMissingMark(query, options)) {
    const std::size_t known = search.mark_count();
    ASSERT_TRUE(search.LearnMark(*missing, nullptr).ok());
    ASSERT_EQ(search.mark_count(), known + 1);
    EXPECT_EQ(missing->comparisons_of_search, at_once.comparisons);
    EXPECT_LE(missing->comparisons, at_once.comparisons);
    comparisons += missing->comparisons;
  }
  const std::size_t known = search.mark_count();
  EXPECT_GT(known, 30u);
  EXPECT_GT(comparisons, 10 * at_once.comparisons);
  // Nothing is left for the search.
  const CandidateSet later = *search.At(query, options, nullptr);
  ExpectSameAnswers(later, at_once);
  EXPECT_LE(search.mark_count(), known + 1);
  EXPECT_EQ(later.comparisons, at_once.comparisons);
  EXPECT_EQ(search.ComparisonsAt(query, options), at_once.comparisons);
}

TEST(SearchBeliefTest, NoMarkIsMissingWhereASearchNeedsNone) {
  std::mt19937_64 random = SeededRandom();
  Drive drive((DriveSettings()));
  drive.Append(Laps(random, 1.0), 1);
  const NodeIndex query = drive.graph().size() - 1;
  Search search(&drive);
  SearchOptions options = drive.settings().search;
  ASSERT_TRUE(search.FindMissingMark(query, options));
  // No path, too much work, no belief.
  EXPECT_FALSE(search.FindMissingMark(10, options));
  EXPECT_EQ(search.ComparisonsAt(10, options), 0);
  options.max_comparisons = 1000;
  EXPECT_FALSE(search.FindMissingMark(query, options));
  EXPECT_EQ(search.ComparisonsAt(query, options), 0);
  options = drive.settings().search;
  options.use_belief = false;
  EXPECT_FALSE(search.FindMissingMark(query, options));
}

TEST(SearchBeliefTest, ASearchThatIsToldToStopStopsAtItsMarksToo) {
  std::mt19937_64 random = SeededRandom();
  Drive drive((DriveSettings()));
  drive.Append(Laps(random, 1.0), 1);
  Search search(&drive);
  int asked = 0;
  const auto stop = [&asked] { return ++asked > 20; };
  EXPECT_TRUE(
      absl::IsCancelled(search.AtEnd(drive.settings().search, stop).status()));
  EXPECT_LE(asked, 21);
}

}  // namespace
}  // namespace revisit::core
