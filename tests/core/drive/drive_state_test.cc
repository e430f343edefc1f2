// Drives that were saved as bytes and loaded, beside those that never were.
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "core/drive/confirmed_loop.h"
#include "core/drive/drive.h"
#include "core/drive/pose_graph.h"
#include "core/geometry/pose.h"
#include "core/search/search.h"
#include "core/settings.h"
#include "tests/core/graphs.h"
#include "tests/core/search/candidate_sets.h"
#include "tests/random.h"

namespace revisit::core {
namespace {

struct Kind {
  StateSpace space;
  CorrelationModel model;
};

const Kind kKinds[] = {
    {StateSpace::kPlanar, CorrelationModel::kDeadReckoning},
    {StateSpace::kPlanar, CorrelationModel::kIndependent},
    {StateSpace::kPlanar, CorrelationModel::kCorrelatedFixes},
    {StateSpace::kPlanar, CorrelationModel::kFilter},
    {StateSpace::kSpatial, CorrelationModel::kDeadReckoning},
    {StateSpace::kSpatial, CorrelationModel::kIndependent},
    {StateSpace::kSpatial, CorrelationModel::kCorrelatedFixes},
    {StateSpace::kSpatial, CorrelationModel::kFilter}};

DriveSettings SettingsOf(const Kind& kind) {
  DriveSettings settings;
  settings.state_space = kind.space;
  settings.search.correlation_model = kind.model;
  settings.apply_inflation = true;
  return settings;
}

// Laps of a closed road, with stops, jumps, poses of any distance and stamps
// that are there or not.
class Driver {
 public:
  Driver(const Kind& kind, std::mt19937_64* random)
      : kind_(kind), random_(*random) {}

  std::vector<PoseSample> Next(int count) {
    std::vector<PoseSample> samples;
    for (int i = 0; i < count; ++i) samples.push_back(NextPose());
    return samples;
  }

 private:
  PoseSample NextPose() {
    const double any = Uniform(random_, 0.0, 1.0);
    double step = Uniform(random_, 0.0, 4.0);
    if (any < 0.05) step = 0.0;
    if (any > 0.9995) angle_ += 1.0;
    angle_ += step / 400.0;
    PoseSample sample;
    sample.sequence = ++sequence_;
    if (Uniform(random_, 0.0, 1.0) < 0.9) {
      sample.stamp_ns = static_cast<std::int64_t>(sequence_) * 100'000'000 +
                        UniformInt(random_, 0, 1'000'000);
    }
    const double radius =
        400.0 + 50.0 * std::cos(3.0 * angle_) + 30.0 * std::sin(7.0 * angle_);
    sample.pose.x = radius * std::cos(angle_) + Normal(random_, 0.01);
    sample.pose.y = radius * std::sin(angle_) + Normal(random_, 0.01);
    sample.pose.heading = angle_ + 1.57 + Normal(random_, 0.001);
    if (kind_.space == StateSpace::kSpatial) {
      sample.pose.z = 5.0 * std::sin(angle_) + Normal(random_, 0.01);
    }
    const bool grows = kind_.model == CorrelationModel::kDeadReckoning ||
                       kind_.model == CorrelationModel::kFilter;
    const double variance = grows ? 0.01 + 1e-4 * static_cast<double>(sequence_)
                                  : Uniform(random_, 0.5, 2.0);
    for (int k : {0, 1, 2}) sample.covariance(k, k) = variance;
    sample.covariance(0, 1) = 0.2 * variance;
    sample.covariance(3, 3) = 1e-4;
    if (kind_.model == CorrelationModel::kFilter && sequence_ > 1) {
      ErrorTransition transition;
      for (double& value : transition.values) value += Normal(random_, 1e-3);
      sample.transition = transition;
    }
    return sample;
  }

  const Kind kind_;
  std::mt19937_64& random_;
  std::uint64_t sequence_ = 0;
  double angle_ = 0.0;
};

std::vector<std::string> SavedParts(const Drive& drive) {
  std::vector<std::string> parts;
  for (std::size_t k = 0; k < drive.whole_parts(); ++k) {
    parts.push_back(drive.SavePart(k));
  }
  return parts;
}

// Null if the bytes are not usable.
std::unique_ptr<Drive> Loaded(const DriveSettings& settings,
                              const std::vector<std::string>& parts,
                              const std::string& rest) {
  auto drive = std::make_unique<Drive>(settings);
  for (const std::string& part : parts) {
    if (!drive->LoadPart(part)) return nullptr;
  }
  return drive->LoadRest(rest) ? std::move(drive) : nullptr;
}

struct Pair {
  bool is_closure;
  std::uint64_t query;
  std::uint64_t matched;
  std::shared_ptr<const MeasuredLoop> measured;
};

void Add(const Pair& pair, Drive* drive) {
  const std::uint64_t revision = drive->revision() + 1;
  if (pair.is_closure) {
    drive->AddLoopClosure(pair.query, pair.matched, revision, pair.measured);
  } else {
    drive->AddRejection(pair.query, pair.matched, revision);
  }
}

void ExpectSameSet(const CandidateSet& a, const CandidateSet& b) {
  ExpectSameAnswers(a, b);
  EXPECT_EQ(a.nodes_considered, b.nodes_considered);
  EXPECT_EQ(a.nodes_pruned, b.nodes_pruned);
}

void ExpectSameAnswers(const Drive& a, const Drive& b, NodeIndex query) {
  const auto never = [] { return false; };
  const auto& options = a.settings().search;
  const auto left = Search(&a).At(query, options, never);
  const auto right = Search(&b).At(query, options, never);
  ASSERT_TRUE(left.ok() && right.ok());
  ExpectSameSet(*left, *right);
  SearchOptions composite = options;
  composite.alignment = AlignmentKind::kComposite;
  const auto left_sum = Search(&a).At(query, composite, never);
  const auto right_sum = Search(&b).At(query, composite, never);
  ASSERT_TRUE(left_sum.ok() && right_sum.ok());
  ExpectSameSet(*left_sum, *right_sum);
}

TEST(DriveStateTest, ALoadedDriveGoesOnAsIfItHadNeverBeenSaved) {
  std::mt19937_64 random = SeededRandom();
  for (const Kind& kind : kKinds) {
    SCOPED_TRACE(static_cast<int>(kind.space));
    SCOPED_TRACE(static_cast<int>(kind.model));
    const DriveSettings settings = SettingsOf(kind);
    Driver driver(kind, &random);
    Drive never(settings);
    auto loaded = std::make_unique<Drive>(settings);
    std::vector<std::string> parts;
    std::vector<Pair> pairs;
    std::vector<PoseSample> all;
    while (never.graph().size() < 18'000) {
      // Now and then a step of any size, most often a long way.
      const bool is_long = Uniform(random, 0.0, 1.0) < 0.7;
      const auto samples =
          driver.Next(UniformInt(random, 1, is_long ? 4000 : 200));
      all.insert(all.end(), samples.begin(), samples.end());
      const AppendResult a = never.Append(samples, never.revision() + 1);
      const AppendResult b = loaded->Append(samples, loaded->revision() + 1);
      EXPECT_EQ(a.checks_due, b.checks_due);
      ASSERT_EQ(a.jumps.size(), b.jumps.size());
      ASSERT_EQ(a.findings.size(), b.findings.size());
      const auto query = static_cast<std::uint64_t>(
          UniformInt(random, 2, static_cast<int>(all.size())));
      const auto matched = static_cast<std::uint64_t>(
          UniformInt(random, 1, static_cast<int>(query) - 1));
      Pair pair{Uniform(random, 0.0, 1.0) < 0.7, query, matched, nullptr};
      if (pair.is_closure && Uniform(random, 0.0, 1.0) < 0.5) {
        const PoseSample& q = all[query - 1];
        const PoseSample& m = all[matched - 1];
        pair.measured = RandomMeasurement(random, {q.pose, q.covariance},
                                          {m.pose, m.covariance}, 0.5);
      }
      pairs.push_back(pair);
      Add(pair, &never);
      Add(pair, loaded.get());
      if (Uniform(random, 0.0, 1.0) < 0.5) {
        // Parts that were saved before stay as they are.
        for (std::size_t k = parts.size(); k < loaded->whole_parts(); ++k) {
          parts.push_back(loaded->SavePart(k));
        }
        const std::string rest = loaded->SaveRest(parts.size());
        loaded = Loaded(settings, parts, rest);
        ASSERT_NE(loaded, nullptr);
        for (const Pair& each : pairs) Add(each, loaded.get());
      }
    }
    EXPECT_EQ(parts, [&] {
      auto now = SavedParts(never);
      now.resize(std::min(now.size(), parts.size()));
      return now;
    }());
    EXPECT_EQ(SavedParts(*loaded), SavedParts(never));
    EXPECT_EQ(loaded->SaveRest(0), never.SaveRest(0));
    EXPECT_EQ(loaded->last_sequence(), never.last_sequence());
    EXPECT_EQ(loaded->travelled_meters(), never.travelled_meters());
    EXPECT_EQ(loaded->graph().LoopEdges(), never.graph().LoopEdges());
    EXPECT_EQ(loaded->consistency().inflation, never.consistency().inflation);
    EXPECT_EQ(loaded->findings().size(), never.findings().size());
    for (const NodeIndex query :
         {NodeIndex{300}, NodeIndex{9000}, never.graph().size() - 1}) {
      ExpectSameAnswers(*loaded, never, query);
    }
  }
}

TEST(DriveStateTest, AnEmptyDriveIsSavedAndLoaded) {
  const DriveSettings settings;
  const Drive empty(settings);
  const auto loaded = Loaded(settings, {}, empty.SaveRest(0));
  ASSERT_NE(loaded, nullptr);
  EXPECT_EQ(loaded->SaveRest(0), empty.SaveRest(0));
}

TEST(DriveStateTest, BytesOfOtherSettingsOrOutOfOrderAreNotUsable) {
  std::mt19937_64 random = SeededRandom();
  const Kind kind = kKinds[0];
  const DriveSettings settings = SettingsOf(kind);
  Driver driver(kind, &random);
  Drive drive(settings);
  drive.Append(driver.Next(20'000), 1);
  const std::vector<std::string> parts = SavedParts(drive);
  ASSERT_EQ(parts.size(), 2u);
  const std::string rest = drive.SaveRest(2);
  ASSERT_NE(Loaded(settings, parts, rest), nullptr);

  EXPECT_EQ(Loaded(settings, {}, rest), nullptr);
  EXPECT_EQ(Loaded(settings, {parts[0]}, rest), nullptr);
  EXPECT_EQ(Loaded(settings, {parts[1], parts[0]}, rest), nullptr);
  EXPECT_EQ(Loaded(settings, {parts[0], parts[0]}, rest), nullptr);
  EXPECT_EQ(Loaded(settings, {parts[0], rest}, parts[1]), nullptr);
  EXPECT_NE(Loaded(settings, {}, drive.SaveRest(0)), nullptr);

  DriveSettings other = settings;
  other.check_interval_meters = 70.0;
  EXPECT_NE(Loaded(other, parts, rest), nullptr);
  for (const auto& change : std::vector<std::function<void(DriveSettings*)>>{
           [](DriveSettings* s) { s->state_space = StateSpace::kSpatial; },
           [](DriveSettings* s) { s->node_spacing_meters = 2.5; },
           [](DriveSettings* s) { s->max_step_meters = 50.0; },
           [](DriveSettings* s) { s->search.sequence_length_meters = 20.0; },
           [](DriveSettings* s) {
             s->search.correlation_model = CorrelationModel::kIndependent;
           }}) {
    other = settings;
    change(&other);
    EXPECT_EQ(Loaded(other, parts, rest), nullptr);
  }
}

TEST(DriveStateTest, BytesThatWereCutAreNotUsable) {
  std::mt19937_64 random = SeededRandom();
  for (const Kind& kind : {kKinds[0], kKinds[7]}) {
    const DriveSettings settings = SettingsOf(kind);
    Driver driver(kind, &random);
    Drive drive(settings);
    drive.Append(driver.Next(300), 1);
    const std::string rest = drive.SaveRest(0);
    for (std::size_t size = 0; size < rest.size(); ++size) {
      EXPECT_EQ(Loaded(settings, {}, rest.substr(0, size)), nullptr) << size;
    }
    EXPECT_EQ(Loaded(settings, {}, rest + '\0'), nullptr);
    drive.Append(driver.Next(12'000), 2);
    const std::string part = drive.SavePart(0);
    for (std::size_t size = 0; size < part.size(); size += 997) {
      Drive loaded(settings);
      EXPECT_FALSE(loaded.LoadPart(part.substr(0, size))) << size;
    }
  }
}

// The storage's checksums find such damage; here it must only do no harm.
TEST(DriveStateTest, FlippedBitsAreRefusedOrDoNoHarm) {
  std::mt19937_64 random = SeededRandom();
  int usable = 0;
  for (const Kind& kind : {kKinds[0], kKinds[7]}) {
    const DriveSettings settings = SettingsOf(kind);
    Driver driver(kind, &random);
    Drive drive(settings);
    drive.Append(driver.Next(11'000), 1);
    const std::vector<std::string> parts = SavedParts(drive);
    ASSERT_EQ(parts.size(), 1u);
    const std::string rest = drive.SaveRest(1);
    const auto more = driver.Next(300);
    for (int round = 0; round < 300; ++round) {
      std::vector<std::string> flipped = {parts[0], rest};
      std::string& bytes = flipped[static_cast<std::size_t>(round % 2)];
      // Where the numbers are small there are most ways to go wrong.
      const bool at_end = round % 4 == 1;
      const int from = at_end ? static_cast<int>(bytes.size()) - 1000 : 0;
      const int at =
          UniformInt(random, from, static_cast<int>(bytes.size()) - 1);
      bytes[static_cast<std::size_t>(at)] ^=
          static_cast<char>(1 << UniformInt(random, 0, 7));
      const auto loaded = Loaded(settings, {flipped[0]}, flipped[1]);
      if (loaded == nullptr) continue;
      ++usable;
      loaded->Append(more, 1);
      if (round % 10 != 0) continue;
      EXPECT_TRUE(Search(loaded.get())
                      .AtEnd(settings.search, [] { return false; })
                      .ok());
    }
  }
  EXPECT_GT(usable, 0);
}

// If this fails, and the change is meant: raise kStateVersion of drive.cc, so
// that no server takes what an older one has saved, and set the sum anew.
TEST(DriveStateTest, TheBytesOfThisVersionAreKnown) {
  Drive drive((DriveSettings()));
  std::vector<PoseSample> samples;
  for (int i = 0; i < 9000; ++i) {
    PoseSample sample;
    sample.sequence = samples.size() + 1;
    sample.stamp_ns = i;
    sample.pose.x = 2.0 * i;
    sample.covariance(0, 0) = 1.0;
    sample.covariance(1, 1) = 1.0;
    sample.covariance(3, 3) = 0.25;
    samples.push_back(sample);
  }
  drive.Append(samples, 1);
  // FNV-1a.
  std::uint64_t sum = 0xcbf29ce484222325;
  for (const std::string& bytes : {drive.SavePart(0), drive.SaveRest(1)}) {
    for (const char byte : bytes) {
      sum = (sum ^ static_cast<unsigned char>(byte)) * 0x100000001b3;
    }
  }
  EXPECT_EQ(sum, 1296657443649424916u);
}

}  // namespace
}  // namespace revisit::core
