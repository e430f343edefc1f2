#include "core/settings.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>

namespace revisit::core {
namespace {

using ::testing::ElementsAre;
using ::testing::Field;
using ::testing::IsEmpty;

TEST(SettingsTest, DefaultsAreValid) {
  EXPECT_THAT(FindProblems(DriveSettings{}), IsEmpty());
  EXPECT_THAT(FindProblems(SearchOptions{}, DriveSettings{}), IsEmpty());
}

TEST(SettingsTest, TellsAllProblemsWithWhatIsAllowed) {
  DriveSettings settings;
  settings.node_spacing_meters = 0.0;
  settings.max_step_meters = std::nan("");
  settings.search.gate_probability = 1.0;
  settings.search.max_candidates = 0;
  const auto problems = FindProblems(settings);
  EXPECT_THAT(problems,
              ElementsAre(Field(&SettingProblem::field, "node_spacing_meters"),
                          Field(&SettingProblem::field, "max_step_meters"),
                          Field(&SettingProblem::field, "gate_probability"),
                          Field(&SettingProblem::field, "max_candidates")));
  EXPECT_EQ(problems[0].description, "got 0; allowed is [0.01, 1000]");
  EXPECT_EQ(problems[3].description, "got 0; allowed is [1, 100]");
}

TEST(SettingsTest, ASequenceHoldsFromOneToAThousandNodes) {
  DriveSettings settings;
  settings.search.sequence_length_meters = 1.0;
  EXPECT_EQ(FindProblems(settings).size(), 1u);
  settings.search.sequence_length_meters = 2.0;
  EXPECT_THAT(FindProblems(settings), IsEmpty());
  settings.search.sequence_length_meters = 2001.0;
  EXPECT_EQ(FindProblems(settings).size(), 1u);
  EXPECT_EQ(SequenceNodes(150.0, 2.0), 75);
  EXPECT_EQ(SequenceNodes(150.0, 0.7), 214);
}

TEST(SettingsTest, AStepHoldsAtMostAThousandNodes) {
  DriveSettings settings;
  settings.node_spacing_meters = 0.2;
  settings.max_step_meters = 200.0;
  settings.search.sequence_length_meters = 30.0;
  EXPECT_THAT(FindProblems(settings), IsEmpty());
  settings.max_step_meters = 201.0;
  const auto problems = FindProblems(settings);
  ASSERT_EQ(problems.size(), 1u);
  EXPECT_EQ(problems[0].field, "max_step_meters");
  EXPECT_EQ(problems[0].description, "got 201; allowed is [0.01, 200]");
}

TEST(SettingsTest, TheDefaultStepFitsEverySpacing) {
  EXPECT_EQ(DefaultMaxStep(2.0), 100.0);
  EXPECT_EQ(DefaultMaxStep(0.1), 100.0);
  EXPECT_EQ(DefaultMaxStep(0.01), 10.0);
  EXPECT_EQ(DefaultMaxStep(0.0), 100.0);
}

TEST(SettingsTest, RelativeAlignmentHasRangesOfItsOwn) {
  const auto problems_of = [](const auto& change) {
    DriveSettings settings;
    change(&settings);
    return FindProblems(settings);
  };
  const double nan = std::nan("");
  struct Range {
    const char* field;
    double SearchOptions::*value;
    double lowest;
    double highest;
    const char* description_of_minus_one;
  };
  const Range ranges[] = {
      {"road_spacing_meters", &SearchOptions::road_spacing_meters, 1.0, 1e6,
       "got -1; allowed is [1, 1000000]"},
      {"fix_correlation_meters", &SearchOptions::fix_correlation_meters, 1.0,
       1e6, "got -1; allowed is [1, 1000000]"},
      {"acceptance_probability", &SearchOptions::acceptance_probability, 1e-300,
       std::nextafter(1.0, 0.0), "got -1; allowed is above 0 and below 1"},
  };
  for (const Range& range : ranges) {
    for (const double valid : {range.lowest, range.highest}) {
      EXPECT_THAT(problems_of([&](DriveSettings* settings) {
                    settings->search.*range.value = valid;
                  }),
                  IsEmpty())
          << range.field;
    }
    for (const double invalid :
         {-1.0, nan, std::nextafter(range.highest, 1e9)}) {
      const auto problems = problems_of([&](DriveSettings* settings) {
        settings->search.*range.value = invalid;
      });
      ASSERT_EQ(problems.size(), 1u) << range.field;
      EXPECT_EQ(problems[0].field, range.field);
      if (invalid == -1.0) {
        EXPECT_EQ(problems[0].description, range.description_of_minus_one);
      }
    }
  }

  const auto shape_problems = [&](const ShapeModel& shape) {
    return problems_of(
        [&](DriveSettings* settings) { settings->search.shape = shape; });
  };
  EXPECT_THAT(shape_problems({{0.01, 0.001}, 0.01}), IsEmpty());
  EXPECT_THAT(shape_problems({{1000.0, 3.0}, 1e6}), IsEmpty());
  EXPECT_THAT(
      shape_problems({{0.0, 0.0}, 0.0}),
      ElementsAre(
          Field(&SettingProblem::field, "shape.tolerance.position_meters"),
          Field(&SettingProblem::field, "shape.tolerance.heading_radians"),
          Field(&SettingProblem::field, "shape.correlation_meters")));
  EXPECT_EQ(shape_problems({{1001.0, 3.1}, 1.1e6}).size(), 3u);
  EXPECT_EQ(shape_problems({{nan, nan}, nan}).size(), 3u);

  for (const double most : {1.0, 100.0}) {
    EXPECT_THAT(problems_of([&](DriveSettings* settings) {
                  settings->max_inflation = most;
                }),
                IsEmpty());
  }
  for (const double most : {0.99, 100.5, nan}) {
    EXPECT_THAT(problems_of([&](DriveSettings* settings) {
                  settings->max_inflation = most;
                }),
                ElementsAre(Field(&SettingProblem::field, "max_inflation")));
  }
}

TEST(SettingsTest, KeepsAnyAgeOrOneInRangeAndAFewPasses) {
  DriveSettings settings;
  EXPECT_THAT(FindProblems(settings), IsEmpty());
  for (const std::int64_t age : {kLeastAgeNanoseconds, kMostAgeNanoseconds}) {
    settings.retention = {age, kMostPasses};
    EXPECT_THAT(FindProblems(settings), IsEmpty());
  }
  settings.retention = {kLeastAgeNanoseconds - 1, -1};
  EXPECT_THAT(
      FindProblems(settings),
      ElementsAre(Field(&SettingProblem::field, "retention.max_age"),
                  Field(&SettingProblem::field, "retention.max_passes")));
  settings.retention = {std::numeric_limits<std::int64_t>::max(),
                        kMostPasses + 1};
  EXPECT_EQ(FindProblems(settings).size(), 2u);
}

TEST(SettingsTest, AFilterSearchNeedsAFilterVehicle) {
  SearchOptions options;
  options.correlation_model = CorrelationModel::kFilter;
  DriveSettings vehicle;
  EXPECT_THAT(FindProblems(options, vehicle),
              ElementsAre(Field(&SettingProblem::field, "correlation_model")));
  vehicle.search.correlation_model = CorrelationModel::kFilter;
  EXPECT_THAT(FindProblems(options, vehicle), IsEmpty());
}

}  // namespace
}  // namespace revisit::core
