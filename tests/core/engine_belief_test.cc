// An engine's searches learn from the drive before.
#include <gtest/gtest.h>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <utility>
#include <vector>

#include "absl/status/status.h"
#include "core/engine.h"
#include "tests/core/drives.h"
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
               Engine* engine, MarkMemory* memory) {
  Answers answers;
  for (std::size_t first = 0; first < samples.size(); first += batch) {
    const std::size_t last = std::min(samples.size(), first + batch);
    const AppendResult appended =
        engine->Append({samples.begin() + static_cast<std::ptrdiff_t>(first),
                        samples.begin() + static_cast<std::ptrdiff_t>(last)},
                       engine->revision() + 1);
    for (const NodeIndex node : appended.checks_due) {
      answers.emplace_back(
          node, *engine->FindCandidates(node, engine->settings().search,
                                        nullptr, memory));
    }
  }
  return answers;
}

void ExpectEqual(const CandidateSet& a, const CandidateSet& b) {
  EXPECT_EQ(a.new_place_probability, b.new_place_probability);
  ASSERT_EQ(a.scale.has_value(), b.scale.has_value());
  if (a.scale) {
    EXPECT_EQ(a.scale->scale, b.scale->scale);
    EXPECT_EQ(a.scale->low, b.scale->low);
    EXPECT_EQ(a.scale->high, b.scale->high);
  }
  ASSERT_EQ(a.candidates.size(), b.candidates.size());
  for (std::size_t k = 0; k < a.candidates.size(); ++k) {
    EXPECT_EQ(a.candidates[k].matched, b.candidates[k].matched);
    EXPECT_EQ(a.candidates[k].score, b.candidates[k].score);
    EXPECT_EQ(a.candidates[k].inflation, b.candidates[k].inflation);
    EXPECT_EQ(a.candidates[k].verdict, b.candidates[k].verdict);
    EXPECT_EQ(a.candidates[k].relative->probability,
              b.candidates[k].relative->probability);
    EXPECT_EQ(a.candidates[k].relative->meters_before,
              b.candidates[k].relative->meters_before);
    EXPECT_EQ(a.candidates[k].relative->meters_after,
              b.candidates[k].relative->meters_after);
  }
}

TEST(EngineBeliefTest, AnAnswerIsTheSameStreamedAskedLaterAndWithoutMemory) {
  std::mt19937_64 random = SeededRandom();
  const std::vector<PoseSample> samples = Laps(random, 2.0);
  Engine engine((EngineSettings()));
  MarkMemory memory;
  const Answers streamed = Stream(samples, 37, &engine, &memory);
  ASSERT_GT(streamed.size(), 50u);
  const SearchOptions& options = engine.settings().search;
  MarkMemory later;
  std::size_t found = 0;
  for (std::size_t k = streamed.size(); k-- > 0;) {
    SCOPED_TRACE(streamed[k].first);
    const auto& [node, answer] = streamed[k];
    ExpectEqual(answer,
                *engine.FindCandidates(node, options, nullptr, &memory));
    ExpectEqual(answer, *engine.FindCandidates(node, options, nullptr, &later));
    if (k % 10 == 0) {
      ExpectEqual(answer, *engine.FindCandidates(node, options, nullptr));
    }
    found += !answer.candidates.empty();
  }
  EXPECT_GT(found, 30u);
}

TEST(EngineBeliefTest, ClosuresAndRejectionsDoNotChangeWhatMarksHaveShown) {
  std::mt19937_64 random = SeededRandom();
  const std::vector<PoseSample> samples = Laps(random, 1.0);
  Engine engine((EngineSettings()));
  MarkMemory memory;
  const Answers streamed = Stream(samples, 100, &engine, &memory);
  const std::size_t marks = memory.size();
  const CandidateSet& last = streamed.back().second;
  ASSERT_FALSE(last.candidates.empty());
  const PoseGraph& graph = engine.graph();
  engine.AddLoopClosure(graph.node(*last.query).sequence,
                        graph.node(last.candidates[0].matched).sequence,
                        engine.revision() + 1);
  const CandidateSet known =
      *engine.FindCandidates(engine.settings().search, nullptr, &memory);
  MarkMemory anew;
  ExpectEqual(known,
              *engine.FindCandidates(engine.settings().search, nullptr, &anew));
  EXPECT_EQ(known.scale->scale, last.scale->scale);
  EXPECT_LE(memory.size(), marks + 1);
}

TEST(EngineBeliefTest, LearnsThatClaimsAreTooWideOrTooNarrow) {
  std::mt19937_64 random = SeededRandom();
  const auto learned = [&random](double claimed) {
    Engine engine((EngineSettings()));
    MarkMemory memory;
    return Stream(Laps(random, claimed), 100, &engine, &memory)
        .back()
        .second.scale->scale;
  };
  const double honest = learned(1.0);
  EXPECT_LT(learned(4.0), 0.8 * honest);
  EXPECT_GT(learned(0.25), 1.5 * honest);
}

TEST(EngineBeliefTest, WideClaimsFindAboutAsMuchAsHonestOnes) {
  std::mt19937_64 random = SeededRandom();
  const auto accepted = [&random](double claimed) {
    Engine engine((EngineSettings()));
    MarkMemory memory;
    int count = 0;
    for (const auto& [node, set] :
         Stream(Laps(random, claimed), 100, &engine, &memory)) {
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

TEST(EngineBeliefTest, NothingIsBelievedWhereTheSettingsSaySo) {
  std::mt19937_64 random = SeededRandom();
  const std::vector<PoseSample> samples = Laps(random, 1.0);
  Engine engine((EngineSettings()));
  engine.Append(samples, 1);
  MarkMemory memory;
  SearchOptions options = engine.settings().search;
  options.use_belief = false;
  EXPECT_FALSE(engine.FindCandidates(options, nullptr, &memory)->scale);
  options = engine.settings().search;
  options.alignment = AlignmentKind::kComposite;
  EXPECT_FALSE(engine.FindCandidates(options, nullptr, &memory)->scale);
  options = engine.settings().search;
  options.correlation_model = CorrelationModel::kIndependent;
  EXPECT_FALSE(engine.FindCandidates(options, nullptr, &memory)->scale);
  EXPECT_EQ(memory.size(), 0u);
}

TEST(EngineBeliefTest, MarksAreSearchedAnewWhereSettingsChange) {
  std::mt19937_64 random = SeededRandom();
  const std::vector<PoseSample> samples = Laps(random, 1.0);
  Engine engine((EngineSettings()));
  MarkMemory memory;
  Stream(samples, 100, &engine, &memory);
  EngineSettings settings = engine.settings();
  settings.search.place_tolerance.position_meters = 8.0;
  engine.ChangeSettings(settings, engine.revision() + 1);
  MarkMemory anew;
  ExpectEqual(
      *engine.FindCandidates(engine.settings().search, nullptr, &memory),
      *engine.FindCandidates(engine.settings().search, nullptr, &anew));
}

TEST(EngineBeliefTest, ASearchThatIsToldToStopStopsAtItsMarksToo) {
  std::mt19937_64 random = SeededRandom();
  Engine engine((EngineSettings()));
  engine.Append(Laps(random, 1.0), 1);
  MarkMemory memory;
  int asked = 0;
  const auto stop = [&asked] { return ++asked > 20; };
  EXPECT_TRUE(absl::IsCancelled(
      engine.FindCandidates(engine.settings().search, stop, &memory).status()));
  EXPECT_LE(asked, 21);
}

}  // namespace
}  // namespace revisit::core
