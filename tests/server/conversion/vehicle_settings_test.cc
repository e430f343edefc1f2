#include "server/conversion/vehicle_settings.h"

#include <string>
#include <utility>
#include <vector>

#include "core/settings.h"
#include "gmock/gmock.h"
#include "google/protobuf/util/message_differencer.h"
#include "gtest/gtest.h"
#include "server/sessions/vehicle_config.h"
#include "tests/server/conversion/conversion_testing.h"
#include "tests/server/error_matchers.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::StartsWith;
using ::testing::UnorderedElementsAre;

TEST(SettingsConversionTest, LeftOutMeansDefault) {
  const auto config = DecodeSettings(v1::VehicleSettings(), FieldPath());
  ASSERT_THAT(config, IsOk());
  v1::VehicleSettings settings;
  EncodeSettings(*config, &settings);
  auto expected = FromText<v1::VehicleSettings>(R"pb(
    state_space: STATE_SPACE_PLANAR
    correlation_model: CORRELATION_MODEL_DEAD_RECKONING
    likelihood_form: LIKELIHOOD_FORM_GAUSSIAN
    coordinate_frame: COORDINATE_FRAME_LOCAL
    node_spacing_meters: 2
    sequence_length_meters: 150
    check_interval_meters: 50
    max_step_meters: 100
    gate_probability: 0.95
    place_tolerance { position_meters: 2 heading_radians: 0.1 }
    candidate_separation_meters: 10
    max_candidates: 5
    alignment: ALIGNMENT_RELATIVE
    apply_inflation: false
    max_inflation: 10
    use_belief: true
    fix_correlation_meters: 300
    checks: STORED_CHECKS_ON_REQUEST
    keep_probability: 0.05
  )pb");
  // Core defines these defaults; the integration tests check their numbers.
  const core::SearchOptions defaults;
  expected.set_acceptance_probability(defaults.acceptance_probability);
  expected.set_road_spacing_meters(defaults.road_spacing_meters);
  expected.mutable_shape_tolerance()->set_position_meters(
      defaults.shape.tolerance.position_meters);
  expected.mutable_shape_tolerance()->set_heading_radians(
      defaults.shape.tolerance.heading_radians);
  expected.set_shape_correlation_meters(defaults.shape.correlation_meters);
  EXPECT_TRUE(
      google::protobuf::util::MessageDifferencer::Equals(settings, expected))
      << settings.DebugString();
}

TEST(SettingsConversionTest, AGroupOfChecksIsNamedAndKnownByItsId) {
  v1::VehicleSettings settings;
  settings.set_check_group("groups/site");
  const auto config = DecodeSettings(settings, FieldPath());
  ASSERT_THAT(config, IsOk());
  EXPECT_EQ(config->check_group, "site");
  v1::VehicleSettings again;
  EncodeSettings(*config, &again);
  EXPECT_EQ(again.check_group(), "groups/site");
  for (const char* name : {"site", "groups/", "vehicles/site", "groups/A"}) {
    settings.set_check_group(name);
    EXPECT_THAT(DecodeSettings(settings, FieldPath()),
                IsError(StatusCode::kInvalidArgument, "INVALID_RESOURCE_NAME",
                        HasSubstr("check_group")));
  }
  settings.set_check_group("");
  EncodeSettings(*DecodeSettings(settings, FieldPath()), &again);
  EXPECT_FALSE(again.has_check_group());
}

TEST(SettingsConversionTest, NamesEverySettingThatIsWrong) {
  const auto settings = FromText<v1::VehicleSettings>(R"pb(
    state_space: 9
    geodetic_origin { latitude_degrees: 91 }
    gate_probability: nan
    place_tolerance { position_meters: -1 }
    max_candidates: 0
  )pb");
  const FieldPath vehicle = FieldPath().Field("vehicle");
  const auto config = DecodeSettings(settings, vehicle.Field("settings"));
  EXPECT_THAT(config, IsError(StatusCode::kInvalidArgument, "INVALID_FIELD",
                              HasSubstr("and 5 more")));
  EXPECT_THAT(FieldsOf(config.status()),
              ElementsAre("vehicle.settings.state_space",
                          "vehicle.settings.geodetic_origin.latitude_degrees",
                          "vehicle.settings.geodetic_origin",
                          "vehicle.settings.gate_probability",
                          "vehicle.settings.place_tolerance.position_meters",
                          "vehicle.settings.max_candidates"));
}

TEST(SettingsConversionTest, NamesTheFieldsOfTheMessageNotThoseOfCore) {
  const auto settings = FromText<v1::VehicleSettings>(R"pb(
    alignment: 3
    acceptance_probability: 1
    road_spacing_meters: 0.5
    shape_tolerance { position_meters: 0.001 heading_radians: 4 }
    shape_correlation_meters: 0
    max_inflation: 0.5
  )pb");
  const auto config = DecodeSettings(settings, FieldPath().Field("settings"));
  EXPECT_THAT(config,
              IsError(StatusCode::kInvalidArgument, "INVALID_FIELD",
                      HasSubstr("got 3, which is no value of this enum")));
  EXPECT_THAT(FieldsOf(config.status()),
              UnorderedElementsAre("settings.alignment",
                                   "settings.acceptance_probability",
                                   "settings.road_spacing_meters",
                                   "settings.shape_tolerance.position_meters",
                                   "settings.shape_tolerance.heading_radians",
                                   "settings.shape_correlation_meters",
                                   "settings.max_inflation"));
}

TEST(SettingsConversionTest, RefusesNumbersThatAreNotFinite) {
  const auto settings = FromText<v1::VehicleSettings>(R"pb(
    acceptance_probability: nan
    road_spacing_meters: inf
    shape_tolerance { position_meters: -inf heading_radians: nan }
    shape_correlation_meters: nan
    max_inflation: inf
  )pb");
  const auto config = DecodeSettings(settings, FieldPath());
  EXPECT_THAT(config, IsError(StatusCode::kInvalidArgument, "NOT_FINITE",
                              HasSubstr("and 5 more")));
  EXPECT_THAT(
      FieldsOf(config.status()),
      UnorderedElementsAre("acceptance_probability", "road_spacing_meters",
                           "shape_tolerance.position_meters",
                           "shape_tolerance.heading_radians",
                           "shape_correlation_meters", "max_inflation"));
}

TEST(SettingsConversionTest, ToleranceThatIsGivenIsGivenWhole) {
  // As in place_tolerance, a number that is left out is 0, which is out of
  // range for a shape.
  const auto place = DecodeSettings(
      FromText<v1::VehicleSettings>("place_tolerance { position_meters: 3 }"),
      FieldPath());
  ASSERT_THAT(place, IsOk());
  EXPECT_EQ(place->drive.search.place_tolerance.heading_radians, 0.0);
  const auto shape = DecodeSettings(
      FromText<v1::VehicleSettings>("shape_tolerance { position_meters: 3 }"),
      FieldPath());
  EXPECT_THAT(shape, IsError(StatusCode::kInvalidArgument, "INVALID_FIELD",
                             HasSubstr("got 0; allowed is [0.001, 3]")));
  EXPECT_THAT(FieldsOf(shape.status()),
              ElementsAre("shape_tolerance.heading_radians"));
}

TEST(SettingsConversionTest, ReasonIsThatOfTheFirstFault) {
  EXPECT_THAT(DecodeSettings(FromText<v1::VehicleSettings>(
                                 "gate_probability: nan max_candidates: 0"),
                             FieldPath()),
              IsError(StatusCode::kInvalidArgument, "NOT_FINITE",
                      HasSubstr("and 1 more")));
}

// ---- Updates

absl::StatusOr<VehicleConfig> Update(const VehicleConfig& current,
                                     bool has_poses,
                                     const std::string& settings,
                                     const std::vector<std::string>& paths) {
  google::protobuf::FieldMask mask;
  for (const std::string& path : paths) mask.add_paths(path);
  v1::Vehicle vehicle;
  *vehicle.mutable_settings() = FromText<v1::VehicleSettings>(settings);
  return UpdateConfig(current, has_poses, vehicle, mask);
}

TEST(UpdateConfigTest, ChangesOnlyWhatIsNamed) {
  VehicleConfig current;
  current.drive.node_spacing_meters = 3;
  current.create_time_ns = 5;
  const auto updated =
      Update(current, true, "max_candidates: 7 node_spacing_meters: 1",
             {"settings.max_candidates", "settings.max_candidates"});
  ASSERT_THAT(updated, IsOk());
  EXPECT_EQ(updated->drive.search.max_candidates, 7);
  EXPECT_EQ(updated->drive.node_spacing_meters, 3);
  EXPECT_EQ(updated->create_time_ns, 5);
}

TEST(UpdateConfigTest, NamedButLeftOutGoesBackToItsDefault) {
  VehicleConfig current;
  current.drive.search.max_candidates = 9;
  current.drive.search.place_tolerance.position_meters = 7;
  current.drive.max_step_meters = 12;
  const auto one = Update(current, true, "", {"settings.max_candidates"});
  ASSERT_THAT(one, IsOk());
  EXPECT_EQ(one->drive.search.max_candidates, 5);
  EXPECT_EQ(one->drive.search.place_tolerance.position_meters, 7);
  const auto all = Update(current, true, "", {"settings"});
  ASSERT_THAT(all, IsOk());
  EXPECT_EQ(all->drive.search.place_tolerance.position_meters, 2);
  EXPECT_EQ(all->drive.max_step_meters, 100);
}

TEST(UpdateConfigTest, KnowsEverySettingByItsName) {
  VehicleConfig current;
  current.drive.search.shape.tolerance = {0.5, 0.03};
  const auto updated =
      Update(current, true,
             "alignment: ALIGNMENT_COMPOSITE acceptance_probability: 0.9 "
             "road_spacing_meters: 50 shape_correlation_meters: 20 "
             "apply_inflation: true max_inflation: 3 use_belief: false "
             "correlation_model: CORRELATION_MODEL_CORRELATED_FIXES "
             "fix_correlation_meters: 75",
             {"settings.alignment", "settings.acceptance_probability",
              "settings.road_spacing_meters",
              "settings.shape_correlation_meters", "settings.apply_inflation",
              "settings.max_inflation", "settings.correlation_model",
              "settings.fix_correlation_meters", "settings.use_belief"});
  ASSERT_THAT(updated, IsOk());
  const core::DriveSettings& drive = updated->drive;
  EXPECT_EQ(drive.search.alignment, core::AlignmentKind::kComposite);
  EXPECT_EQ(drive.search.correlation_model,
            core::CorrelationModel::kCorrelatedFixes);
  EXPECT_EQ(drive.search.fix_correlation_meters, 75);
  EXPECT_EQ(drive.search.acceptance_probability, 0.9);
  EXPECT_EQ(drive.search.road_spacing_meters, 50);
  EXPECT_EQ(drive.search.shape.correlation_meters, 20);
  EXPECT_EQ(drive.search.shape.tolerance.position_meters, 0.5);
  EXPECT_TRUE(drive.apply_inflation);
  EXPECT_EQ(drive.max_inflation, 3);
  EXPECT_FALSE(drive.search.use_belief);
  const auto back = Update(*updated, true, "",
                           {"settings.alignment", "settings.apply_inflation",
                            "settings.shape_tolerance", "settings.use_belief"});
  ASSERT_THAT(back, IsOk());
  EXPECT_EQ(back->drive.search.alignment, core::AlignmentKind::kRelative);
  EXPECT_FALSE(back->drive.apply_inflation);
  EXPECT_TRUE(back->drive.search.use_belief);
  EXPECT_EQ(back->drive.search.shape.tolerance.position_meters,
            core::ShapeModel().tolerance.position_meters);
  EXPECT_EQ(back->drive.max_inflation, 3);
}

TEST(UpdateConfigTest, ReplacesWhatIsKeptAsAWhole) {
  const auto limited = Update({}, true,
                              "retention { max_passes: 4 "
                              "max_age { seconds: 3600 nanos: 500 } }",
                              {"settings.retention"});
  ASSERT_THAT(limited, IsOk());
  EXPECT_EQ(limited->drive.retention.max_passes, 4);
  EXPECT_EQ(limited->drive.retention.max_age_ns, 3'600'000'000'500);
  v1::VehicleSettings told;
  EncodeSettings(*limited, &told);
  EXPECT_EQ(told.retention().ShortDebugString(),
            "max_age { seconds: 3600 nanos: 500 } max_passes: 4");
  const auto younger =
      Update(*limited, true, "retention { max_age { seconds: 60 } }",
             {"settings.retention"});
  ASSERT_THAT(younger, IsOk());
  EXPECT_EQ(younger->drive.retention.max_passes, 0);
  const auto all = Update(*younger, true, "", {"settings.retention"});
  ASSERT_THAT(all, IsOk());
  EXPECT_FALSE(all->drive.retention.max_age_ns);
  EncodeSettings(*all, &told);
  EXPECT_FALSE(told.has_retention());
  EXPECT_FALSE(SameSettings(*limited, *all));
  for (const std::string wrong :
       {"max_age {}", "max_age { seconds: 1 nanos: -1 }", "max_passes: 21",
        "max_age { seconds: 9000000000000000000 }", "max_passes: -1"}) {
    EXPECT_THAT(
        Update({}, true, "retention { " + wrong + " }", {"settings.retention"}),
        IsError(StatusCode::kInvalidArgument, "INVALID_FIELD",
                HasSubstr("retention.max_")))
        << wrong;
  }
}

TEST(UpdateConfigTest, RefusesPathsThatAreNoSettings) {
  for (const std::string path :
       {"", "*", "name", "max_candidates", "settings.", "settings.nothing",
        "settings.place_tolerance.position_meters"}) {
    const auto updated =
        Update({}, false, "", {"settings.max_candidates", path});
    EXPECT_THAT(updated, IsError(StatusCode::kInvalidArgument, "INVALID_FIELD",
                                 StartsWith("update_mask.paths[1]: ")))
        << path;
  }
  EXPECT_THAT(Update({}, false, "", {}),
              IsError(StatusCode::kInvalidArgument, "INVALID_FIELD",
                      StartsWith("update_mask: required")));
}

TEST(UpdateConfigTest, KeepsWhatIsFixedOnceThereArePoses) {
  const VehicleConfig current = Geodetic({});
  const std::vector<std::pair<std::string, std::string>> cases = {
      {"state_space", "state_space: STATE_SPACE_SPATIAL"},
      {"correlation_model", "correlation_model: CORRELATION_MODEL_FILTER"},
      {"coordinate_frame", "coordinate_frame: COORDINATE_FRAME_LOCAL"},
      {"geodetic_origin", "geodetic_origin { latitude_degrees: 1 }"}};
  for (const auto& [field, settings] : cases) {
    EXPECT_THAT(Update(current, false, settings, {"settings." + field}),
                IsOk());
    EXPECT_THAT(Update(current, true, settings, {"settings." + field}),
                IsError(StatusCode::kFailedPrecondition, "SETTING_FIXED",
                        HasSubstr("settings." + field)));
  }
  // Whether the correlation model is FILTER is all of it that is fixed.
  EXPECT_THAT(
      Update(current, true, "correlation_model: CORRELATION_MODEL_FILTER",
             {"settings.correlation_model"}),
      IsError(StatusCode::kFailedPrecondition, "SETTING_FIXED",
              HasSubstr("settings.correlation_model cannot become FILTER")));
  // A change between two models other than FILTER is allowed.
  EXPECT_THAT(
      Update(current, true, "correlation_model: CORRELATION_MODEL_INDEPENDENT",
             {"settings.correlation_model"}),
      IsOk());
}

TEST(UpdateConfigTest, OriginOfTheFirstPoseIsTheDefaultOneOnceItIsThere) {
  VehicleConfig current = Geodetic({});
  current.origin = GeodeticOrigin{10, 20, 30};
  const auto updated =
      Update(current, true, "coordinate_frame: COORDINATE_FRAME_GEODETIC",
             {"settings"});
  ASSERT_THAT(updated, IsOk());
  ASSERT_TRUE(updated->origin.has_value());
  EXPECT_EQ(updated->origin->latitude_degrees, 10);
}

TEST(SameSettingsTest, TellsSettingsApartButNotAnOriginThatWasLeftOpen) {
  VehicleConfig existing = Geodetic({});
  existing.origin = GeodeticOrigin{10, 20, 30};
  VehicleConfig requested = Geodetic({});
  requested.create_time_ns = 1;
  EXPECT_TRUE(SameSettings(existing, requested));
  requested.origin = existing.origin;
  EXPECT_TRUE(SameSettings(existing, requested));
  requested.origin->height_meters = 31;
  EXPECT_FALSE(SameSettings(existing, requested));
  requested.origin = existing.origin;
  requested.drive.search.place_tolerance.heading_radians = 0.2;
  EXPECT_FALSE(SameSettings(existing, requested));
}

TEST(CandidateOptionsTest, ChangeWhatTheyNameAndLeaveTheRestToTheVehicle) {
  VehicleConfig config;
  config.drive.search.gate_probability = 0.9;
  config.drive.search.correlation_model = core::CorrelationModel::kIndependent;
  const auto search = DecodeCandidateOptions(
      FromText<v1::CandidateOptions>(
          "max_candidates: 3 likelihood_form: LIKELIHOOD_FORM_AS_PRINTED"),
      config, FieldPath());
  ASSERT_THAT(search, IsOk());
  EXPECT_EQ(search->max_candidates, 3);
  EXPECT_EQ(search->likelihood_form, core::LikelihoodForm::kAsPrinted);
  EXPECT_EQ(search->gate_probability, 0.9);
  EXPECT_EQ(search->correlation_model, core::CorrelationModel::kIndependent);
}

TEST(CandidateOptionsTest, SayWhetherTheSearchBeginsWithABelief) {
  VehicleConfig config;
  const auto own = DecodeCandidateOptions({}, config, FieldPath());
  ASSERT_THAT(own, IsOk());
  EXPECT_TRUE(own->use_belief);
  const auto none = DecodeCandidateOptions(
      FromText<v1::CandidateOptions>("use_belief: false"), config, FieldPath());
  ASSERT_THAT(none, IsOk());
  EXPECT_FALSE(none->use_belief);
}

TEST(CandidateOptionsTest, TakeTheAlignmentFromTheVehicleUnlessTold) {
  VehicleConfig config;
  config.drive.search.alignment = core::AlignmentKind::kComposite;
  config.drive.search.road_spacing_meters = 70;
  const auto plain = DecodeCandidateOptions({}, config, FieldPath());
  ASSERT_THAT(plain, IsOk());
  EXPECT_EQ(plain->alignment, core::AlignmentKind::kComposite);
  EXPECT_EQ(plain->direction, core::SearchDirection::kSame);
  EXPECT_EQ(plain->road_spacing_meters, 70);
  const auto search = DecodeCandidateOptions(
      FromText<v1::CandidateOptions>(R"pb(
        alignment: ALIGNMENT_RELATIVE
        direction: DIRECTION_EITHER
        acceptance_probability: 0.8
        shape_tolerance { position_meters: 2 heading_radians: 0.1 }
        shape_correlation_meters: 30
      )pb"),
      config, FieldPath());
  ASSERT_THAT(search, IsOk());
  EXPECT_EQ(search->alignment, core::AlignmentKind::kRelative);
  EXPECT_EQ(search->direction, core::SearchDirection::kEither);
  EXPECT_EQ(search->acceptance_probability, 0.8);
  EXPECT_EQ(search->shape.tolerance.position_meters, 2);
  EXPECT_EQ(search->shape.tolerance.heading_radians, 0.1);
  EXPECT_EQ(search->shape.correlation_meters, 30);
  EXPECT_EQ(search->road_spacing_meters, 70);
}

TEST(CandidateOptionsTest, NameEveryOptionThatIsWrong) {
  const auto search =
      DecodeCandidateOptions(FromText<v1::CandidateOptions>(R"pb(
                               alignment: 9
                               direction: 4
                               acceptance_probability: 0
                               road_spacing_meters: 2e6
                               shape_tolerance { position_meters: 2 }
                               shape_correlation_meters: 2e6
                             )pb"),
                             Planar(), FieldPath().Field("options"));
  EXPECT_THAT(search, IsError(StatusCode::kInvalidArgument, "INVALID_FIELD",
                              HasSubstr("and 5 more")));
  EXPECT_THAT(FieldsOf(search.status()),
              UnorderedElementsAre("options.alignment", "options.direction",
                                   "options.acceptance_probability",
                                   "options.road_spacing_meters",
                                   "options.shape_tolerance.heading_radians",
                                   "options.shape_correlation_meters"));
}

TEST(CandidateOptionsTest, RefuseFilterWhereTheVehicleHasNone) {
  const auto search =
      DecodeCandidateOptions(FromText<v1::CandidateOptions>(
                                 "correlation_model: CORRELATION_MODEL_FILTER"),
                             Planar(), FieldPath().Field("options"));
  EXPECT_THAT(search, IsError(StatusCode::kInvalidArgument, "INVALID_FIELD",
                              StartsWith("options.correlation_model: ")));
}

}  // namespace
}  // namespace revisit::server
