#include "core/settings_table.h"

#include <gtest/gtest.h>

#include <cmath>
#include <cstdint>
#include <optional>
#include <set>
#include <string>
#include <tuple>
#include <type_traits>
#include <vector>

#include "core/base/byte_stream.h"
#include "core/drive/drive.h"
#include "core/drive/pose_graph.h"
#include "core/geometry/pose.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/dead_reckoning.h"
#include "core/settings.h"

namespace revisit::core {
namespace {

// A winding road of some 20 km, uphill, with one long step. Each pose brings
// its error transition.
std::vector<PoseSample> LongDrive() {
  std::vector<PoseSample> samples(10'000);
  for (std::size_t i = 0; i < samples.size(); ++i) {
    const auto at = static_cast<double>(i);
    PoseSample& sample = samples[i];
    sample.sequence = i + 1;
    for (int k = 0; k < 4; ++k) sample.covariance(k, k) = 0.01 + 1e-4 * at;
    if (i == 0) continue;
    const Pose& before = samples[i - 1].pose;
    const double step = i == 300 ? 80.0 : 2.0;
    sample.pose.heading = before.heading + 0.05 * std::sin(0.03 * at);
    sample.pose.x = before.x + step * std::cos(before.heading);
    sample.pose.y = before.y + step * std::sin(before.heading);
    sample.pose.z = before.z + 0.01;
    sample.transition =
        ToErrorTransition<4>(DeadReckoningTransition<4>(before, sample.pose));
  }
  return samples;
}

Drive Driven(const DriveSettings& settings) {
  static const std::vector<PoseSample>* const kSamples =
      new std::vector<PoseSample>(LongDrive());
  Drive drive(settings);
  drive.Append(*kSamples, 1);
  drive.AddLoopClosure(900, 898, 2);
  return drive;
}

std::string NodesOf(const Drive& drive) {
  ByteWriter writer;
  drive.graph().SaveRest(0, &writer);
  return writer.Take();
}

std::vector<double> Others(double value) { return {0.5 * value, 2.0 * value}; }
std::vector<int> Others(int value) { return {value + 1}; }
std::vector<bool> Others(bool value) { return {!value}; }
std::vector<std::int64_t> Others(std::int64_t value) { return {value / 2}; }
std::vector<std::optional<std::int64_t>> Others(
    const std::optional<std::int64_t>&) {
  return {kLeastAgeNanoseconds};
}
std::vector<StateSpace> Others(StateSpace) { return {StateSpace::kSpatial}; }
std::vector<AlignmentKind> Others(AlignmentKind) {
  return {AlignmentKind::kComposite};
}
std::vector<LikelihoodForm> Others(LikelihoodForm) {
  return {LikelihoodForm::kAsPrinted};
}
std::vector<SearchDirection> Others(SearchDirection) {
  return {SearchDirection::kOpposite, SearchDirection::kEither};
}
std::vector<CorrelationModel> Others(CorrelationModel) {
  return {CorrelationModel::kIndependent, CorrelationModel::kFilter,
          CorrelationModel::kCorrelatedFixes};
}

struct Change {
  std::string field;
  DriveSettings settings;
};

// The default settings with each setting changed alone, to each of the other
// values that are allowed.
std::vector<Change> EachChangedAlone() {
  std::vector<Change> changes;
  DriveSettings settings;
  VisitSettings(settings, [&](const SettingRow& row, const auto& get) {
    if constexpr (std::is_lvalue_reference_v<decltype(get(settings))>) {
      const auto original = get(settings);
      for (const auto& other : Others(original)) {
        get(settings) = other;
        if (FindProblems(settings).empty()) {
          changes.push_back({row.field, settings});
        }
        get(settings) = original;
      }
    }
  });
  return changes;
}

TEST(SettingsTableTest, EveryFieldHasARow) {
  // A field more, and these do not compile: then give it a row.
  const auto& [alignment, model, meters, form, direction, length, gate,
               tolerance, separation, candidates, paths, comparisons, shape,
               exhaustive, spacing, acceptance, belief] = SearchOptions();
  (void)std::tie(alignment, model, meters, form, direction, length, gate,
                 tolerance, separation, candidates, paths, comparisons, shape,
                 exhaustive, spacing, acceptance, belief);
  const auto& [space, node_spacing, interval, step, inflation, most, search,
               retention] = DriveSettings();
  (void)std::tie(space, node_spacing, interval, step, inflation, most, search,
                 retention);
  std::set<std::string> changed;
  for (const Change& change : EachChangedAlone()) changed.insert(change.field);
  // Tolerances have two numbers, the shape three, and retention two.
  EXPECT_EQ(changed.size(), (17u - 2u) + 2u + 3u + (8u - 2u) + 2u);
}

TEST(SettingsTableTest, OnlyASettingThatSaysSoMovesNodes) {
  const DriveSettings before;
  const std::string nodes = NodesOf(Driven(before));
  std::set<std::string> moving;
  for (const Change& change : EachChangedAlone()) {
    if (NodesOf(Driven(change.settings)) == nodes) continue;
    moving.insert(change.field);
    EXPECT_TRUE(MovesNodes(before, change.settings)) << change.field;
  }
  EXPECT_EQ(moving,
            (std::set<std::string>{"correlation_model", "max_step_meters",
                                   "node_spacing_meters", "state_space"}));
}

TEST(SettingsTableTest, OnlyAModelThatCarriesTransitionsOrClaimsMovesNodes) {
  const auto moves = [](CorrelationModel from, CorrelationModel to) {
    DriveSettings before;
    DriveSettings after;
    before.search.correlation_model = from;
    after.search.correlation_model = to;
    return MovesNodes(before, after);
  };
  EXPECT_FALSE(moves(CorrelationModel::kIndependent,
                     CorrelationModel::kCorrelatedFixes));
  for (const CorrelationModel model :
       {CorrelationModel::kFilter, CorrelationModel::kDeadReckoning}) {
    EXPECT_TRUE(moves(CorrelationModel::kIndependent, model));
    EXPECT_TRUE(moves(model, CorrelationModel::kIndependent));
  }
}

TEST(SettingsTableTest, ADriveRefusesSettingsThatMoveItsNodes) {
  const DriveSettings before;
  Drive drive = Driven(before);
  for (const Change& change : EachChangedAlone()) {
    const absl::Status status =
        drive.ChangeSettings(change.settings, drive.revision() + 1);
    if (MovesNodes(before, change.settings)) {
      EXPECT_EQ(status.code(), absl::StatusCode::kFailedPrecondition)
          << change.field;
      continue;
    }
    EXPECT_TRUE(status.ok()) << change.field << ": " << status;
    ASSERT_TRUE(drive.ChangeSettings(before, drive.revision() + 1).ok());
  }
  DriveSettings invalid;
  invalid.search.max_candidates = 0;
  EXPECT_EQ(drive.ChangeSettings(invalid, drive.revision() + 1).code(),
            absl::StatusCode::kInvalidArgument);
  EXPECT_EQ(drive.settings().search.max_candidates,
            before.search.max_candidates);
}

// What a drive makes anew by these rows is what it would have made from the
// beginning.
TEST(SettingsTableTest, AChangedDriveIsAsOneThatWasMadeSo) {
  const DriveSettings before;
  const Drive made_before = Driven(before);
  for (const Change& change : EachChangedAlone()) {
    if (MovesNodes(before, change.settings)) continue;
    Drive changed = Driven(before);
    ASSERT_TRUE(changed.ChangeSettings(change.settings, 3).ok());
    const Drive made = Driven(change.settings);
    EXPECT_EQ(changed.SavePart(0), made.SavePart(0)) << change.field;
    EXPECT_EQ(changed.consistency().inflation, made.consistency().inflation)
        << change.field;
    const unsigned remade = RemadeBetween(before, change.settings);
    if ((remade & kRemadeMotionHistory) == 0) {
      EXPECT_EQ(made.SavePart(0), made_before.SavePart(0)) << change.field;
    }
    if ((remade & kRemadeConsistency) == 0) {
      EXPECT_EQ(made.consistency().inflation,
                made_before.consistency().inflation)
          << change.field;
    }
    if ((remade & kRemadeMarks) != 0) {
      EXPECT_NE(changed.mark_settings_version(), made.mark_settings_version())
          << change.field;
    }
  }
}

}  // namespace
}  // namespace revisit::core
