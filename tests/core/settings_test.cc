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
  EXPECT_THAT(FindProblems(EngineSettings{}), IsEmpty());
  EXPECT_THAT(FindProblems(SearchOptions{}, EngineSettings{}), IsEmpty());
}

TEST(SettingsTest, TellsAllProblemsWithWhatIsAllowed) {
  EngineSettings settings;
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
  EngineSettings settings;
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
  EngineSettings settings;
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

TEST(SettingsTest, AFilterSearchNeedsAFilterVehicle) {
  SearchOptions options;
  options.correlation_model = CorrelationModel::kFilter;
  EngineSettings vehicle;
  EXPECT_THAT(FindProblems(options, vehicle),
              ElementsAre(Field(&SettingProblem::field, "correlation_model")));
  vehicle.search.correlation_model = CorrelationModel::kFilter;
  EXPECT_THAT(FindProblems(options, vehicle), IsEmpty());
}

}  // namespace
}  // namespace revisit::core
