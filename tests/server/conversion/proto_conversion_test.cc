#include "server/conversion/proto_conversion.h"

#include <algorithm>
#include <array>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <functional>
#include <limits>
#include <random>
#include <string>
#include <tuple>
#include <vector>

#include "core/geometry/heading.h"
#include "gmock/gmock.h"
#include "google/protobuf/text_format.h"
#include "google/protobuf/util/message_differencer.h"
#include "google/rpc/error_details.pb.h"
#include "gtest/gtest.h"
#include "server/sessions/vehicle_uid.h"
#include "tests/random.h"
#include "tests/server/error_matchers.h"

namespace revisit::server {
namespace {

using namespace std::string_literals;

using absl::StatusCode;
using ::testing::DoubleNear;
using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::Optional;
using ::testing::SizeIs;
using ::testing::StartsWith;
using ::testing::UnorderedElementsAre;

constexpr double kNan = std::numeric_limits<double>::quiet_NaN();
constexpr int kMaxPoses = 100;

template <typename Message>
Message FromText(const std::string& text) {
  Message message;
  EXPECT_TRUE(google::protobuf::TextFormat::ParseFromString(text, &message))
      << text;
  return message;
}

VehicleRecord RecordOf(const std::string& payload) {
  VehicleRecord record;
  record.key = 1;
  record.id = "truck";
  record.payload = payload;
  return record;
}

std::vector<std::string> FieldsOf(const absl::Status& status) {
  google::rpc::BadRequest bad_request;
  const auto payload = status.GetPayload(kBadRequestUrl);
  if (payload) bad_request.ParseFromString(std::string(*payload));
  std::vector<std::string> fields;
  for (const auto& violation : bad_request.field_violations()) {
    EXPECT_NE(violation.description(), "");
    fields.push_back(violation.field());
  }
  return fields;
}

v1::Pose PlanarPose(std::uint64_t sequence, double x) {
  v1::Pose pose;
  pose.set_sequence(sequence);
  pose.mutable_local()->set_x_meters(x);
  pose.set_heading_radians(0.5);
  pose.mutable_covariance()->set_form(v1::COVARIANCE_FORM_PLANAR_6);
  for (const double value : {4.0, 0.1, 0.2, 5.0, 0.3, 0.06}) {
    pose.mutable_covariance()->add_values(value);
  }
  return pose;
}

v1::Pose GeodeticPose(std::uint64_t sequence, double latitude, double longitude,
                      double height) {
  v1::Pose pose = PlanarPose(sequence, 0);
  pose.mutable_geodetic()->set_latitude_degrees(latitude);
  pose.mutable_geodetic()->set_longitude_degrees(longitude);
  pose.mutable_geodetic()->set_height_meters(height);
  return pose;
}

VehicleConfig Planar() { return {}; }

VehicleConfig Spatial() {
  VehicleConfig config;
  config.engine.state_space = core::StateSpace::kSpatial;
  return config;
}

VehicleConfig Filter(VehicleConfig config) {
  config.engine.search.correlation_model = core::CorrelationModel::kFilter;
  return config;
}

VehicleConfig Geodetic(VehicleConfig config) {
  config.frame = CoordinateFrame::kGeodetic;
  return config;
}

absl::StatusOr<DecodedBatch> DecodeAll(const std::vector<v1::Pose>& poses,
                                       const VehicleConfig& config) {
  Poses batch;
  for (const v1::Pose& pose : poses) *batch.Add() = pose;
  return DecodeBatch(batch, kMaxPoses, config, FieldPath());
}

absl::StatusOr<core::PoseSample> DecodeOne(const v1::Pose& pose,
                                           const VehicleConfig& config) {
  absl::StatusOr<DecodedBatch> batch = DecodeAll({pose}, config);
  if (!batch.ok()) return batch.status();
  return batch->samples[0];
}

void SetCovariance(v1::CovarianceForm form, const std::vector<double>& values,
                   v1::Pose* pose) {
  pose->mutable_covariance()->set_form(form);
  pose->mutable_covariance()->mutable_values()->Assign(values.begin(),
                                                       values.end());
}

// ---- Names

TEST(NamesTest, TakesIdsOfThePattern) {
  for (const std::string& id :
       {"a"s, "0"s, "a-b"s, "0--9"s, "vehicle-1"s, std::string(63, 'z')}) {
    EXPECT_THAT(CheckId(id, FieldPath().Field("x")), IsOk()) << id;
    EXPECT_EQ(ParseVehicleName("vehicles/" + id, FieldPath()).value(), id);
  }
}

TEST(NamesTest, RefusesIdsOutsideThePattern) {
  for (const std::string& id :
       {std::string(""), std::string("-a"), std::string("a-"), std::string("-"),
        std::string("A"), std::string("a_b"), std::string("a/b"),
        std::string("\xc3\xa4"), std::string("a\0b", 3),
        std::string(64, 'a')}) {
    EXPECT_THAT(CheckId(id, FieldPath().Field("vehicle_id")),
                IsError(StatusCode::kInvalidArgument, "INVALID_RESOURCE_NAME",
                        StartsWith("vehicle_id: got \"")));
  }
}

TEST(NamesTest, RefusesNamesOfAnotherForm) {
  for (const std::string name : {"", "a", "vehicles/", "vehicles//a",
                                 "/vehicles/a", "vehicles/a/", "vehicle/a"}) {
    EXPECT_THAT(ParseVehicleName(name, FieldPath().Field("name")),
                IsError(StatusCode::kInvalidArgument, "INVALID_RESOURCE_NAME",
                        StartsWith("name: ")))
        << name;
  }
}

TEST(NamesTest, SplitsTheNameOfAPairOfPoses) {
  for (const auto& [kind, collection, form] :
       {std::tuple(PairKind::kLoopClosure, "loopClosures", "loop_closure"),
        std::tuple(PairKind::kRejectedCandidate, "rejectedCandidates",
                   "rejected_candidate")}) {
    const std::string middle = "/"s + collection + "/";
    const auto name =
        ParsePosePairName(kind, "vehicles/a" + middle + "9-3", FieldPath());
    ASSERT_THAT(name, IsOk());
    EXPECT_EQ(name->vehicle_id, "a");
    EXPECT_EQ(name->id, "9-3");
    for (const std::string& bad :
         {"vehicles/a"s, "vehicles/a" + middle, "vehicles/" + middle + "x",
          "vehicles/a" + middle + "x" + middle + "y",
          "vehicles/a/somethingElse/x"s}) {
      EXPECT_THAT(ParsePosePairName(kind, bad, FieldPath().Field("name")),
                  IsError(StatusCode::kInvalidArgument, "INVALID_RESOURCE_NAME",
                          StartsWith("name: ")))
          << bad;
    }
    EXPECT_THAT(ParsePosePairName(kind, "x", FieldPath().Field("name")),
                IsError(StatusCode::kInvalidArgument, "INVALID_RESOURCE_NAME",
                        HasSubstr("the form is vehicles/{vehicle}" + middle +
                                  "{" + form + "}")));
  }
}

TEST(NamesTest, NamesOfTwoKindsOfPairsAreNotTakenForEachOther) {
  EXPECT_FALSE(ParsePosePairName(PairKind::kRejectedCandidate,
                                 "vehicles/a/loopClosures/x", FieldPath())
                   .ok());
  EXPECT_FALSE(ParsePosePairName(PairKind::kLoopClosure,
                                 "vehicles/a/rejectedCandidates/x", FieldPath())
                   .ok());
}

// ---- Pairs of poses

// What decoding says of these sequences: the id, or the fields that are wrong.
template <typename Pair>
std::vector<std::string> Decoded(const std::string& text,
                                 const std::string& id) {
  const Pair pair = FromText<Pair>(text);
  const auto record = DecodePosePair(&pair, id);
  if (!record.ok()) return FieldsOf(record.status());
  EXPECT_EQ(record->query_sequence, pair.query_sequence());
  EXPECT_EQ(record->matched_sequence, pair.matched_sequence());
  return {record->id};
}

TEST(PosePairTest, TakesItsIdFromTheSequencesUnlessItIsGiven) {
  const std::string pair = "query_sequence: 9 matched_sequence: 3";
  EXPECT_THAT(Decoded<v1::LoopClosure>(pair, ""), ElementsAre("9-3"));
  EXPECT_THAT(Decoded<v1::RejectedCandidate>(pair, ""), ElementsAre("9-3"));
  EXPECT_THAT(Decoded<v1::RejectedCandidate>(pair, "mine"),
              ElementsAre("mine"));
}

TEST(PosePairTest, NamesTheFieldsThatAreWrong) {
  EXPECT_THAT(Decoded<v1::RejectedCandidate>("", ""),
              ElementsAre("rejected_candidate.query_sequence",
                          "rejected_candidate.matched_sequence"));
  EXPECT_THAT(Decoded<v1::RejectedCandidate>(
                  "query_sequence: 3 matched_sequence: 3", ""),
              ElementsAre("rejected_candidate.matched_sequence"));
  EXPECT_THAT(Decoded<v1::RejectedCandidate>(
                  "query_sequence: 3 matched_sequence: 2", "No"),
              ElementsAre("rejected_candidate_id"));
  EXPECT_THAT(
      Decoded<v1::LoopClosure>("query_sequence: 3 matched_sequence: 2", "No"),
      ElementsAre("loop_closure_id"));
  const v1::RejectedCandidate* const left_out = nullptr;
  EXPECT_THAT(FieldsOf(DecodePosePair(left_out, "").status()),
              ElementsAre("rejected_candidate"));
}

TEST(PosePairTest, AnswersWithNameAndTime) {
  const PosePairRecord record{"9-3", 9, 3, -1};
  v1::LoopClosure closure;
  EncodePosePair("a", record, &closure);
  EXPECT_EQ(closure.name(), "vehicles/a/loopClosures/9-3");
  v1::RejectedCandidate rejected;
  EncodePosePair("a", record, &rejected);
  EXPECT_TRUE(google::protobuf::util::MessageDifferencer::Equals(
      rejected, FromText<v1::RejectedCandidate>(R"pb(
        name: "vehicles/a/rejectedCandidates/9-3"
        query_sequence: 9
        matched_sequence: 3
        create_time { seconds: -1 nanos: 999999999 }
      )pb")))
      << rejected.DebugString();
}

// ---- Settings

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
  )pb");
  // Of these core has the say; the tests from outside know the numbers.
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

TEST(SettingsConversionTest, EverySettingSurvivesTheStore) {
  const auto settings = FromText<v1::VehicleSettings>(R"pb(
    state_space: STATE_SPACE_SPATIAL
    correlation_model: CORRELATION_MODEL_INDEPENDENT
    likelihood_form: LIKELIHOOD_FORM_AS_PRINTED
    coordinate_frame: COORDINATE_FRAME_GEODETIC
    geodetic_origin {
      latitude_degrees: -33.5
      longitude_degrees: 151.25
      height_meters: 7
    }
    node_spacing_meters: 3
    sequence_length_meters: 99
    check_interval_meters: 12
    max_step_meters: 50
    gate_probability: 0.5
    place_tolerance { position_meters: 0 heading_radians: 0.25 }
    candidate_separation_meters: 0
    max_candidates: 17
    alignment: ALIGNMENT_COMPOSITE
    acceptance_probability: 0.75
    road_spacing_meters: 80
    shape_tolerance { position_meters: 0.5 heading_radians: 0.03 }
    shape_correlation_meters: 25
    apply_inflation: true
    max_inflation: 4
  )pb");
  auto config = DecodeSettings(settings, FieldPath());
  ASSERT_THAT(config, IsOk());
  config->create_time_ns = -1234567890123456789;
  config->data_loss = true;
  const ProtoRecordCodec codec;
  const auto loaded =
      codec.DecodeVehicle(RecordOf(codec.EncodeVehicle(*config)));
  ASSERT_THAT(loaded, IsOk());
  EXPECT_EQ(loaded->create_time_ns, config->create_time_ns);
  EXPECT_TRUE(loaded->data_loss);
  v1::VehicleSettings again;
  EncodeSettings(*loaded, &again);
  EXPECT_TRUE(
      google::protobuf::util::MessageDifferencer::Equals(again, settings))
      << again.DebugString();
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
  // As in place_tolerance, a number that is left out is 0; which a shape may
  // not have.
  const auto place = DecodeSettings(
      FromText<v1::VehicleSettings>("place_tolerance { position_meters: 3 }"),
      FieldPath());
  ASSERT_THAT(place, IsOk());
  EXPECT_EQ(place->engine.search.place_tolerance.heading_radians, 0.0);
  const auto shape = DecodeSettings(
      FromText<v1::VehicleSettings>("shape_tolerance { position_meters: 3 }"),
      FieldPath());
  EXPECT_THAT(shape, IsError(StatusCode::kInvalidArgument, "INVALID_FIELD",
                             HasSubstr("got 0; allowed is [0.001, 3]")));
  EXPECT_THAT(FieldsOf(shape.status()),
              ElementsAre("shape_tolerance.heading_radians"));
}

TEST(SettingsConversionTest, RecordOfTheFirstReleaseTakesTodaysDefaults) {
  // Fields 1 to 13 were all there was.
  const auto vehicle = FromText<v1::Vehicle>(R"pb(
    settings {
      state_space: STATE_SPACE_PLANAR
      correlation_model: CORRELATION_MODEL_DEAD_RECKONING
      likelihood_form: LIKELIHOOD_FORM_GAUSSIAN
      coordinate_frame: COORDINATE_FRAME_LOCAL
      node_spacing_meters: 3
      sequence_length_meters: 150
      check_interval_meters: 50
      max_step_meters: 100
      gate_probability: 0.95
      place_tolerance { position_meters: 2 heading_radians: 0.1 }
      candidate_separation_meters: 10
      max_candidates: 5
    }
    state: VEHICLE_STATE_ACTIVE
    create_time { seconds: 1 }
  )pb");
  const auto config =
      ProtoRecordCodec().DecodeVehicle(RecordOf(vehicle.SerializeAsString()));
  ASSERT_THAT(config, IsOk());
  EXPECT_EQ(config->engine.node_spacing_meters, 3);
  EXPECT_EQ(config->engine.search.alignment, core::AlignmentKind::kRelative);
  EXPECT_EQ(config->engine.max_inflation, 10);
  EXPECT_FALSE(config->engine.apply_inflation);
}

TEST(SettingsConversionTest, VehicleStoredBeforeThereWereUidsHasAlwaysTheSame) {
  const ProtoRecordCodec codec;
  VehicleRecord record = RecordOf(
      FromText<v1::Vehicle>("create_time { seconds: 1 }").SerializeAsString());
  const auto uid = [&] { return codec.DecodeVehicle(record)->uid; };
  const std::string first = uid();
  EXPECT_EQ(first, "da5804d8-0180-8507-9a95-6c4d9a0ec1fe");
  // Also once it is written again.
  record.payload = codec.EncodeVehicle(*codec.DecodeVehicle(record));
  record.key = 9;
  EXPECT_EQ(uid(), first);
  // Another vehicle has another one.
  VehicleRecord other = RecordOf(
      FromText<v1::Vehicle>("create_time { seconds: 1 }").SerializeAsString());
  other.key = 2;
  EXPECT_NE(codec.DecodeVehicle(other)->uid, first);
}

TEST(SettingsConversionTest, ReasonIsThatOfTheFirstFault) {
  EXPECT_THAT(DecodeSettings(FromText<v1::VehicleSettings>(
                                 "gate_probability: nan max_candidates: 0"),
                             FieldPath()),
              IsError(StatusCode::kInvalidArgument, "NOT_FINITE",
                      HasSubstr("and 1 more")));
}

TEST(SettingsConversionTest, UnreadableRecordIsDataLoss) {
  const ProtoRecordCodec codec;
  for (const std::string& payload :
       {std::string("\xff\xff"), std::string(),
        // Without a creation time, and with a setting out of range.
        FromText<v1::Vehicle>("settings {}").SerializeAsString(),
        FromText<v1::Vehicle>(
            "settings { max_candidates: -1 } create_time { seconds: 1 }")
            .SerializeAsString()}) {
    EXPECT_THAT(
        codec.DecodeVehicle(RecordOf(payload)),
        IsError(StatusCode::kDataLoss, "STORE_CORRUPT", HasSubstr("vehicle")));
  }
}

// ---- Updates

absl::StatusOr<VehicleConfig> Update(const VehicleConfig& current,
                                     bool has_poses,
                                     const std::string& settings,
                                     const std::vector<std::string>& paths) {
  google::protobuf::FieldMask mask;
  for (const std::string& path : paths) mask.add_paths(path);
  return UpdateSettings(current, has_poses,
                        FromText<v1::VehicleSettings>(settings), mask);
}

TEST(UpdateSettingsTest, ChangesOnlyWhatIsNamed) {
  VehicleConfig current;
  current.engine.node_spacing_meters = 3;
  current.create_time_ns = 5;
  const auto updated =
      Update(current, true, "max_candidates: 7 node_spacing_meters: 1",
             {"settings.max_candidates", "settings.max_candidates"});
  ASSERT_THAT(updated, IsOk());
  EXPECT_EQ(updated->engine.search.max_candidates, 7);
  EXPECT_EQ(updated->engine.node_spacing_meters, 3);
  EXPECT_EQ(updated->create_time_ns, 5);
}

TEST(UpdateSettingsTest, NamedButLeftOutGoesBackToItsDefault) {
  VehicleConfig current;
  current.engine.search.max_candidates = 9;
  current.engine.search.place_tolerance.position_meters = 7;
  current.engine.max_step_meters = 12;
  const auto one = Update(current, true, "", {"settings.max_candidates"});
  ASSERT_THAT(one, IsOk());
  EXPECT_EQ(one->engine.search.max_candidates, 5);
  EXPECT_EQ(one->engine.search.place_tolerance.position_meters, 7);
  const auto all = Update(current, true, "", {"settings"});
  ASSERT_THAT(all, IsOk());
  EXPECT_EQ(all->engine.search.place_tolerance.position_meters, 2);
  EXPECT_EQ(all->engine.max_step_meters, 100);
}

TEST(UpdateSettingsTest, KnowsEverySettingByItsName) {
  VehicleConfig current;
  current.engine.search.shape.tolerance = {0.5, 0.03};
  const auto updated = Update(
      current, true,
      "alignment: ALIGNMENT_COMPOSITE acceptance_probability: 0.9 "
      "road_spacing_meters: 50 shape_correlation_meters: 20 "
      "apply_inflation: true max_inflation: 3",
      {"settings.alignment", "settings.acceptance_probability",
       "settings.road_spacing_meters", "settings.shape_correlation_meters",
       "settings.apply_inflation", "settings.max_inflation"});
  ASSERT_THAT(updated, IsOk());
  const core::EngineSettings& engine = updated->engine;
  EXPECT_EQ(engine.search.alignment, core::AlignmentKind::kComposite);
  EXPECT_EQ(engine.search.acceptance_probability, 0.9);
  EXPECT_EQ(engine.search.road_spacing_meters, 50);
  EXPECT_EQ(engine.search.shape.correlation_meters, 20);
  EXPECT_EQ(engine.search.shape.tolerance.position_meters, 0.5);
  EXPECT_TRUE(engine.apply_inflation);
  EXPECT_EQ(engine.max_inflation, 3);
  const auto back = Update(*updated, true, "",
                           {"settings.alignment", "settings.apply_inflation",
                            "settings.shape_tolerance"});
  ASSERT_THAT(back, IsOk());
  EXPECT_EQ(back->engine.search.alignment, core::AlignmentKind::kRelative);
  EXPECT_FALSE(back->engine.apply_inflation);
  EXPECT_EQ(back->engine.search.shape.tolerance.position_meters,
            core::ShapeModel().tolerance.position_meters);
  EXPECT_EQ(back->engine.max_inflation, 3);
}

TEST(UpdateSettingsTest, RefusesPathsThatAreNoSettings) {
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

TEST(UpdateSettingsTest, KeepsWhatIsFixedOnceThereArePoses) {
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
  // What is fixed of it is whether it is FILTER.
  EXPECT_THAT(
      Update(current, true, "correlation_model: CORRELATION_MODEL_FILTER",
             {"settings.correlation_model"}),
      IsError(StatusCode::kFailedPrecondition, "SETTING_FIXED",
              HasSubstr("settings.correlation_model cannot become FILTER")));
  // Neither of the two is FILTER.
  EXPECT_THAT(
      Update(current, true, "correlation_model: CORRELATION_MODEL_INDEPENDENT",
             {"settings.correlation_model"}),
      IsOk());
}

TEST(UpdateSettingsTest, OriginOfTheFirstPoseIsTheDefaultOneOnceItIsThere) {
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
  requested.engine.search.place_tolerance.heading_radians = 0.2;
  EXPECT_FALSE(SameSettings(existing, requested));
}

TEST(CandidateOptionsTest, ChangeWhatTheyNameAndLeaveTheRestToTheVehicle) {
  VehicleConfig config;
  config.engine.search.gate_probability = 0.9;
  config.engine.search.correlation_model = core::CorrelationModel::kIndependent;
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

TEST(CandidateOptionsTest, TakeTheAlignmentFromTheVehicleUnlessTold) {
  VehicleConfig config;
  config.engine.search.alignment = core::AlignmentKind::kComposite;
  config.engine.search.road_spacing_meters = 70;
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

// ---- Poses

TEST(PoseConversionTest, TakesSequenceStampPositionAndHeadingAsTheyCame) {
  v1::Pose pose = PlanarPose(42, 1.5);
  pose.mutable_local()->set_y_meters(-2.5);
  pose.mutable_local()->set_z_meters(3.5);
  pose.mutable_stamp()->set_seconds(-2);
  pose.mutable_stamp()->set_nanos(5);
  const auto sample = DecodeOne(pose, Planar());
  ASSERT_THAT(sample, IsOk());
  EXPECT_EQ(sample->sequence, 42u);
  EXPECT_THAT(sample->stamp_ns, Optional(-1999999995));
  EXPECT_EQ(sample->pose.x, 1.5);
  EXPECT_EQ(sample->pose.y, -2.5);
  EXPECT_EQ(sample->pose.z, 3.5);
  EXPECT_EQ(sample->pose.heading, 0.5);
  EXPECT_FALSE(sample->transition.has_value());
}

// The upper triangle over (x, y, z, heading), by rows.
std::array<double, 10> UpperOf(const absl::StatusOr<core::PoseSample>& sample) {
  EXPECT_THAT(sample, IsOk());
  return sample.ok() ? sample->covariance.upper : std::array<double, 10>{};
}

TEST(PoseConversionTest, PutsPlanarNumbersWhereTheyBelong) {
  EXPECT_THAT(UpperOf(DecodeOne(PlanarPose(1, 0), Planar())),
              ElementsAre(4, 0.1, 0, 0.2, 5, 0, 0.3, 0, 0, 0.06));
}

TEST(PoseConversionTest, PutsSpatialNumbersWhereTheyBelong) {
  v1::Pose pose = PlanarPose(1, 0);
  const std::vector<double> values = {4,   0.1, 0.7, 0.2, 5,
                                      0.8, 0.3, 6,   0.4, 0.9};
  SetCovariance(v1::COVARIANCE_FORM_SPATIAL_10, values, &pose);
  EXPECT_THAT(UpperOf(DecodeOne(pose, Spatial())),
              ::testing::ElementsAreArray(values));
  EXPECT_THAT(UpperOf(DecodeOne(pose, Planar())),
              ElementsAre(4, 0.1, 0, 0.2, 5, 0, 0.3, 0, 0, 0.9));
}

// A 6x6 of (x, y, z, rotX, rotY, rotZ) whose entry (r, c) is
// 0.01 * (10 * min + max), but for a diagonal that makes it positive definite.
std::vector<double> RosMatrix() {
  std::vector<double> values(36);
  for (int r = 0; r < 6; ++r) {
    for (int c = 0; c < 6; ++c) {
      values[static_cast<std::size_t>(6 * r + c)] =
          r == c ? 10.0 + r : 0.01 * (10 * std::min(r, c) + std::max(r, c));
    }
  }
  return values;
}

TEST(PoseConversionTest, ReducesRosToPositionAndRotationAboutZ) {
  v1::Pose pose = PlanarPose(1, 0);
  SetCovariance(v1::COVARIANCE_FORM_ROS_36, RosMatrix(), &pose);
  EXPECT_THAT(UpperOf(DecodeOne(pose, Spatial())),
              ElementsAre(10, 0.01, 0.02, 0.05, 11, 0.12, 0.15, 12, 0.25, 15));
  EXPECT_THAT(UpperOf(DecodeOne(pose, Planar())),
              ElementsAre(10, 0.01, 0, 0.05, 11, 0, 0.15, 0, 0, 15));
}

TEST(PoseConversionTest, LooksAtTheSymmetryOfTheReducedRosMatrixOnly) {
  v1::Pose pose = PlanarPose(1, 0);
  std::vector<double> values = RosMatrix();
  // x and rotation about x: not part of the state.
  values[6 * 0 + 3] += 1.0;
  // x and z: part of the state of a SPATIAL vehicle.
  values[6 * 0 + 2] += 1.0;
  SetCovariance(v1::COVARIANCE_FORM_ROS_36, values, &pose);
  EXPECT_THAT(DecodeOne(pose, Planar()), IsOk());
  EXPECT_THAT(
      DecodeOne(pose, Spatial()),
      IsError(StatusCode::kInvalidArgument, "COVARIANCE_NOT_SYMMETRIC",
              StartsWith("poses[0].covariance.values: reduced to the state")));
}

TEST(PoseConversionTest, HeadingOfAQuaternionIsThatOfTheForwardAxis) {
  std::mt19937_64 random = SeededRandom();
  for (int i = 0; i < 200; ++i) {
    // Yaw, then pitch, then roll, about moving axes: the forward axis then
    // points to yaw, whatever pitch (below a quarter turn) and roll.
    const double yaw = Uniform(random, -3.1, 3.1);
    const double pitch = Uniform(random, -1.5, 1.5);
    const double roll = Uniform(random, -3.1, 3.1);
    const double cy = std::cos(yaw / 2), sy = std::sin(yaw / 2);
    const double cp = std::cos(pitch / 2), sp = std::sin(pitch / 2);
    const double cr = std::cos(roll / 2), sr = std::sin(roll / 2);
    const double scale = Uniform(random, 0.9995, 1.0005) *
                         (UniformInt(random, 0, 1) == 0 ? 1 : -1);
    v1::Pose pose = PlanarPose(1, 0);
    pose.mutable_quaternion()->set_w(scale * (cr * cp * cy + sr * sp * sy));
    pose.mutable_quaternion()->set_x(scale * (sr * cp * cy - cr * sp * sy));
    pose.mutable_quaternion()->set_y(scale * (cr * sp * cy + sr * cp * sy));
    pose.mutable_quaternion()->set_z(scale * (cr * cp * sy - sr * sp * cy));
    const auto sample = DecodeOne(pose, Planar());
    ASSERT_THAT(sample, IsOk());
    EXPECT_NEAR(core::WrapHeading(sample->pose.heading - yaw), 0.0, 1e-12);
  }
}

TEST(PoseConversionTest, PutsTransitionsWhereTheyBelong) {
  v1::Pose planar = PlanarPose(2, 0);
  for (int i = 1; i <= 9; ++i) planar.add_error_transition(i);
  const auto nine = DecodeOne(planar, Filter(Planar()));
  ASSERT_THAT(nine, IsOk());
  ASSERT_TRUE(nine->transition.has_value());
  EXPECT_THAT(nine->transition->values,
              ElementsAre(1, 2, 0, 3, 4, 5, 0, 6, 0, 0, 1, 0, 7, 8, 0, 9));

  v1::Pose spatial = PlanarPose(2, 0);
  SetCovariance(v1::COVARIANCE_FORM_ROS_36, RosMatrix(), &spatial);
  for (int i = 1; i <= 16; ++i) spatial.add_error_transition(i);
  const auto sixteen = DecodeOne(spatial, Filter(Spatial()));
  ASSERT_THAT(sixteen, IsOk());
  EXPECT_THAT(
      sixteen->transition->values,
      ElementsAre(1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16));
}

TEST(PoseConversionTest, OnlyTheFirstPoseOfAFilterNeedsNoTransition) {
  EXPECT_THAT(DecodeOne(PlanarPose(1, 0), Filter(Planar())), IsOk());
  EXPECT_THAT(DecodeOne(PlanarPose(2, 0), Filter(Planar())),
              IsError(StatusCode::kInvalidArgument, "INVALID_FIELD",
                      StartsWith("poses[0].error_transition: got 0 numbers")));
}

TEST(PoseConversionTest, NamesAllFaultsOfABatchUnderTheReasonOfTheFirst) {
  v1::Pose first = PlanarPose(5, 2e8);
  first.mutable_covariance()->set_values(2, kNan);
  v1::Pose second = PlanarPose(7, 0);
  second.clear_local();
  second.clear_orientation();
  second.clear_covariance();
  second.mutable_stamp()->set_seconds(9214646400);
  const auto batch = DecodeAll({first, second}, Planar());
  EXPECT_THAT(batch, IsError(StatusCode::kInvalidArgument, "INVALID_FIELD",
                             StartsWith("poses[0].local.x_meters: got 2")));
  EXPECT_THAT(
      FieldsOf(batch.status()),
      ElementsAre("poses[0].local.x_meters", "poses[0].covariance.values[2]",
                  "poses[1].stamp.seconds", "poses[1].position",
                  "poses[1].orientation", "poses[1].covariance",
                  "poses[1].sequence"));
}

TEST(PoseConversionTest, CountsFaultsThatNoAnswerCouldHold) {
  std::vector<v1::Pose> poses;
  for (int i = 1; i <= kMaxPoses; ++i) {
    poses.push_back(PlanarPose(static_cast<std::uint64_t>(i), kNan));
  }
  EXPECT_THAT(DecodeAll(poses, Planar()),
              IsError(StatusCode::kInvalidArgument, "NOT_FINITE",
                      HasSubstr("(and 99 more)")));
}

TEST(PoseConversionTest, RefusesTheWrongNumberOfPosesBeforeLookingAtThem) {
  EXPECT_THAT(DecodeAll({}, Planar()),
              IsError(StatusCode::kInvalidArgument, "BATCH_SIZE",
                      "poses: got 0 poses; allowed is [1, 100]"));
  EXPECT_THAT(DecodeAll(std::vector<v1::Pose>(kMaxPoses + 1), Planar()),
              IsError(StatusCode::kInvalidArgument, "BATCH_SIZE",
                      "poses: got 101 poses; allowed is [1, 100]"));
}

TEST(PoseConversionTest, NamesFieldsBelowThePathItIsGiven) {
  Poses poses;
  *poses.Add() = PlanarPose(0, 0);
  EXPECT_THAT(
      DecodeBatch(poses, 1, Planar(), FieldPath().Field("batch")),
      IsError(StatusCode::kInvalidArgument, "INVALID_FIELD",
              StartsWith("batch.poses[0].sequence: got 0; allowed is [1, ")));
}

// ---- Geodetic poses, against formulas written anew

struct Vector3 {
  double x, y, z;
};
Vector3 operator-(const Vector3& a, const Vector3& b) {
  return {a.x - b.x, a.y - b.y, a.z - b.z};
}
double Dot(const Vector3& a, const Vector3& b) {
  return a.x * b.x + a.y * b.y + a.z * b.z;
}

struct Geo {
  double latitude, longitude, height;
};

Vector3 EarthCentred(const Geo& geo) {
  // WGS84: NIMA TR8350.2, table 3.1.
  const double a = 6378137.0;
  const double f = 1.0 / 298.257223563;
  const double e2 = f * (2.0 - f);
  const double lat = geo.latitude * core::kPi / 180.0;
  const double lon = geo.longitude * core::kPi / 180.0;
  const double n = a / std::sqrt(1.0 - e2 * std::sin(lat) * std::sin(lat));
  return {(n + geo.height) * std::cos(lat) * std::cos(lon),
          (n + geo.height) * std::cos(lat) * std::sin(lon),
          (n * (1.0 - e2) + geo.height) * std::sin(lat)};
}

// East, north and up as earth-centred unit vectors.
std::array<Vector3, 3> Axes(const Geo& geo) {
  const double lat = geo.latitude * core::kPi / 180.0;
  const double lon = geo.longitude * core::kPi / 180.0;
  return {Vector3{-std::sin(lon), std::cos(lon), 0.0},
          Vector3{-std::sin(lat) * std::cos(lon),
                  -std::sin(lat) * std::sin(lon), std::cos(lat)},
          Vector3{std::cos(lat) * std::cos(lon), std::cos(lat) * std::sin(lon),
                  std::sin(lat)}};
}

// State (x, y, z, heading) in the frame of the origin of what lies `offset`
// east, north and up of a place and faces `heading` there.
std::array<double, 4> LocalState(const Geo& origin, const Geo& place,
                                 const Vector3& offset, double heading) {
  const auto from = Axes(place);
  const auto to = Axes(origin);
  const auto rotated = [&](const Vector3& v) {
    return Vector3{from[0].x * v.x + from[1].x * v.y + from[2].x * v.z,
                   from[0].y * v.x + from[1].y * v.y + from[2].y * v.z,
                   from[0].z * v.x + from[1].z * v.y + from[2].z * v.z};
  };
  const Vector3 shift = rotated(offset);
  const Vector3 base = EarthCentred(place) - EarthCentred(origin);
  const Vector3 d{base.x + shift.x, base.y + shift.y, base.z + shift.z};
  const Vector3 f = rotated({std::cos(heading), std::sin(heading), 0.0});
  return {Dot(to[0], d), Dot(to[1], d), Dot(to[2], d),
          std::atan2(Dot(to[1], f), Dot(to[0], f))};
}

// Its derivative by (east, north, up, heading), by central differences.
std::array<std::array<double, 4>, 4> LocalJacobian(const Geo& origin,
                                                   const Geo& place,
                                                   double heading) {
  std::array<std::array<double, 4>, 4> jacobian{};
  for (std::size_t c = 0; c < 4; ++c) {
    const double step = c < 3 ? 1.0 : 1e-5;
    const auto at = [&](double by) {
      return LocalState(
          origin, place,
          {c == 0 ? by : 0.0, c == 1 ? by : 0.0, c == 2 ? by : 0.0},
          c == 3 ? heading + by : heading);
    };
    const auto plus = at(step);
    const auto minus = at(-step);
    for (std::size_t r = 0; r < 4; ++r) {
      const double change =
          r == 3 ? core::WrapHeading(plus[r] - minus[r]) : plus[r] - minus[r];
      jacobian[r][c] = change / (2.0 * step);
    }
  }
  return jacobian;
}

TEST(GeodeticTest, PutsPosesIntoTheFrameOfTheOrigin) {
  std::mt19937_64 random = SeededRandom();
  for (int i = 0; i < 50; ++i) {
    const Geo origin{Uniform(random, -85, 85), Uniform(random, -180, 180),
                     Uniform(random, -100, 3000)};
    const Geo place{
        origin.latitude + Uniform(random, -2, 2),
        std::remainder(origin.longitude + Uniform(random, -2, 2), 360.0),
        Uniform(random, -100, 3000)};
    const double heading = Uniform(random, -3, 3);
    VehicleConfig config = Geodetic(Spatial());
    config.origin =
        GeodeticOrigin{origin.latitude, origin.longitude, origin.height};
    v1::Pose pose =
        GeodeticPose(1, place.latitude, place.longitude, place.height);
    pose.set_heading_radians(heading);
    SetCovariance(v1::COVARIANCE_FORM_ROS_36, RosMatrix(), &pose);
    const auto sample = DecodeOne(pose, config);
    ASSERT_THAT(sample, IsOk());

    const auto expected = LocalState(origin, place, {0, 0, 0}, heading);
    EXPECT_NEAR(sample->pose.x, expected[0], 1e-6);
    EXPECT_NEAR(sample->pose.y, expected[1], 1e-6);
    EXPECT_NEAR(sample->pose.z, expected[2], 1e-6);
    EXPECT_NEAR(core::WrapHeading(sample->pose.heading - expected[3]), 0.0,
                1e-12);

    core::Covariance before;
    before.upper = UpperOf(DecodeOne(
        [&] {
          v1::Pose local = pose;
          local.mutable_local();
          return local;
        }(),
        Spatial()));
    const auto j = LocalJacobian(origin, place, heading);
    for (std::size_t r = 0; r < 4; ++r) {
      for (std::size_t c = r; c < 4; ++c) {
        double sum = 0.0;
        for (std::size_t k = 0; k < 4; ++k) {
          for (std::size_t l = 0; l < 4; ++l) {
            sum += j[r][k] * before(static_cast<int>(k), static_cast<int>(l)) *
                   j[c][l];
          }
        }
        EXPECT_NEAR(
            sample->covariance(static_cast<int>(r), static_cast<int>(c)), sum,
            1e-6);
      }
    }
  }
}

TEST(GeodeticTest, PlanarVehicleLeavesHeightOut) {
  VehicleConfig config = Geodetic(Planar());
  config.origin = GeodeticOrigin{60, 10, 0};
  const Geo origin{60, 10, 0};
  const Geo place{60.5, 11, 100};
  const auto sample = DecodeOne(
      GeodeticPose(1, place.latitude, place.longitude, place.height), config);
  ASSERT_THAT(sample, IsOk());
  const auto j = LocalJacobian(origin, place, 0.5);
  const std::size_t kept[] = {0, 1, 3};
  const double before[3][3] = {{4, 0.1, 0.2}, {0.1, 5, 0.3}, {0.2, 0.3, 0.06}};
  for (int r = 0; r < 3; ++r) {
    for (int c = r; c < 3; ++c) {
      double sum = 0.0;
      for (int k = 0; k < 3; ++k) {
        for (int l = 0; l < 3; ++l) {
          sum += j[kept[r]][kept[k]] * before[k][l] * j[kept[c]][kept[l]];
        }
      }
      EXPECT_NEAR(sample->covariance(static_cast<int>(kept[r]),
                                     static_cast<int>(kept[c])),
                  sum, 1e-6);
    }
  }
}

TEST(GeodeticTest, FirstPoseIsTheOriginWhereNoneIsGiven) {
  const auto batch = DecodeAll(
      {GeodeticPose(1, 43.8, -79.5, 150), GeodeticPose(2, 43.9, -79.5, 150)},
      Geodetic(Planar()));
  ASSERT_THAT(batch, IsOk());
  ASSERT_TRUE(batch->origin.has_value());
  EXPECT_EQ(batch->origin->latitude_degrees, 43.8);
  EXPECT_EQ(batch->origin->longitude_degrees, -79.5);
  EXPECT_EQ(batch->origin->height_meters, 150);
  EXPECT_NEAR(batch->samples[0].pose.x, 0.0, 1e-9);
  EXPECT_NEAR(batch->samples[0].pose.heading, 0.5, 1e-12);
  EXPECT_GT(batch->samples[1].pose.y, 10000.0);
}

// A pose sideways of the origin, where east has turned by the convergence of
// the meridians: an error that grows eastwards there grows along the turned
// axis here.
TEST(GeodeticTest, TransitionsTurnWithTheAxes) {
  VehicleConfig config = Filter(Geodetic(Planar()));
  config.origin = GeodeticOrigin{60, 0, 0};
  v1::Pose pose = GeodeticPose(2, 60, 3, 0);
  for (const double value : {2.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0}) {
    pose.add_error_transition(value);
  }
  const auto sample = DecodeOne(pose, config);
  ASSERT_THAT(sample, IsOk());
  const auto j = LocalJacobian({60, 0, 0}, {60, 3, 0}, 0.5);
  // Psi' J = J Psi, entry by entry over (x, y).
  const auto& psi = sample->transition->values;
  EXPECT_NEAR(psi[0] * j[0][0] + psi[1] * j[1][0], 2.0 * j[0][0], 1e-9);
  EXPECT_NEAR(psi[0] * j[0][1] + psi[1] * j[1][1], j[0][1], 1e-9);
  EXPECT_NEAR(psi[4] * j[0][0] + psi[5] * j[1][0], 2.0 * j[1][0], 1e-9);
  EXPECT_NEAR(psi[4] * j[0][1] + psi[5] * j[1][1], j[1][1], 1e-9);
  EXPECT_NEAR(psi[15], 1.0, 1e-12);
  EXPECT_GT(std::abs(psi[1]), 0.01);
}

TEST(GeodeticTest, RefusesAHeadingThatIsNoneInTheLocalFrame) {
  VehicleConfig config = Geodetic(Planar());
  config.origin = GeodeticOrigin{0, 0, 0};
  // A quarter of the way round the earth, facing east is facing straight down.
  v1::Pose pose = GeodeticPose(1, 0, 90, 0);
  pose.set_heading_radians(0);
  EXPECT_THAT(DecodeOne(pose, config),
              IsError(StatusCode::kInvalidArgument, "INVALID_FIELD",
                      StartsWith("poses[0].orientation: so far from")));
}

// ---- What is stored

v1::PoseBatch SomePoses() {
  v1::PoseBatch batch;
  for (std::uint64_t i = 1; i <= 5; ++i) {
    *batch.add_poses() = PlanarPose(i, static_cast<double>(i));
  }
  batch.mutable_poses(2)->mutable_stamp()->set_seconds(77);
  batch.mutable_poses(3)->mutable_local()->set_z_meters(-0.0);
  return batch;
}

TEST(StoredBatchTest, PayloadIsThePoseBatchAsItCame) {
  const v1::PoseBatch batch = SomePoses();
  const auto decoded =
      DecodeBatch(batch.poses(), kMaxPoses, Planar(), FieldPath());
  ASSERT_THAT(decoded, IsOk());
  EXPECT_EQ(decoded->payload, batch.SerializeAsString());
}

TEST(StoredBatchTest, FingerprintsAreTheSameOnceStored) {
  const v1::PoseBatch batch = SomePoses();
  const auto sent =
      DecodeBatch(batch.poses(), kMaxPoses, Planar(), FieldPath());
  ASSERT_THAT(sent, IsOk());
  const ProtoRecordCodec codec;
  const auto stored = codec.DecodeBatch(sent->payload, Planar());
  ASSERT_THAT(stored, IsOk());
  EXPECT_EQ(stored->fingerprints, sent->fingerprints);
  ASSERT_THAT(stored->samples, SizeIs(5));
  EXPECT_EQ(stored->samples[4].pose.x, 5.0);

  const auto slice = codec.SliceBatch(sent->payload, 1, 3);
  ASSERT_THAT(slice, IsOk());
  const auto part = codec.DecodeBatch(*slice, Planar());
  ASSERT_THAT(part, IsOk());
  EXPECT_THAT(part->fingerprints,
              ElementsAre(sent->fingerprints[1], sent->fingerprints[2],
                          sent->fingerprints[3]));
  EXPECT_THAT(codec.SliceBatch(sent->payload, 3, 3),
              IsError(StatusCode::kDataLoss, "STORE_CORRUPT",
                      HasSubstr("has 5 poses; asked for 3 from 3")));
}

TEST(StoredBatchTest, FingerprintTellsEveryFieldApart) {
  const v1::Pose pose = PlanarPose(1, 0);
  const std::vector<std::function<void(v1::Pose*)>> changes = {
      [](v1::Pose* p) { p->mutable_stamp(); },
      [](v1::Pose* p) { p->mutable_local()->set_x_meters(-0.0); },
      [](v1::Pose* p) { p->mutable_local()->set_z_meters(5e-324); },
      [](v1::Pose* p) { p->set_heading_radians(0.5 + 2 * core::kPi); },
      [](v1::Pose* p) { p->mutable_quaternion()->set_w(1); },
      [](v1::Pose* p) { p->mutable_covariance()->set_values(0, 4.5); }};
  const std::uint64_t original =
      DecodeAll({pose}, Planar()).value().fingerprints[0];
  for (std::size_t i = 0; i < changes.size(); ++i) {
    v1::Pose changed = pose;
    changes[i](&changed);
    const auto decoded = DecodeAll({changed}, Planar());
    ASSERT_THAT(decoded, IsOk());
    EXPECT_NE(decoded->fingerprints[0], original) << "change " << i;
  }
}

// Stores last for years: the bytes of a batch and their fingerprint never
// change.
TEST(StoredBatchTest, BytesAndFingerprintAreThoseOfTheFirstRelease) {
  const auto decoded = DecodeAll({PlanarPose(3, 1.5)}, Planar());
  ASSERT_THAT(decoded, IsOk());
  std::string hex;
  for (const char c : decoded->payload) {
    char text[3];
    std::snprintf(text, sizeof(text), "%02x", static_cast<unsigned char>(c));
    hex += text;
  }
  EXPECT_EQ(hex,
            "0a4c0803"                // sequence 3
            "1a0909000000000000f83f"  // local { x_meters: 1.5 }
            "29000000000000e03f"      // heading_radians: 0.5
            "3a340801"                // covariance { form: PLANAR_6
            "1230"                    // values, packed
            "0000000000001040"        // 4
            "9a9999999999b93f"        // 0.1
            "9a9999999999c93f"        // 0.2
            "0000000000001440"        // 5
            "333333333333d33f"        // 0.3
            "b81e85eb51b8ae3f");      // 0.06
  EXPECT_EQ(decoded->fingerprints[0], 17976514935543079048u);
}

TEST(StoredBatchTest, UnreadableRecordIsDataLoss) {
  const ProtoRecordCodec codec;
  v1::PoseBatch batch = SomePoses();
  batch.mutable_poses(1)->set_sequence(9);
  for (const std::string& payload :
       {std::string("\x0a\x7f"), batch.SerializeAsString()}) {
    EXPECT_THAT(
        codec.DecodeBatch(payload, Planar()),
        IsError(StatusCode::kDataLoss, "STORE_CORRUPT", HasSubstr("batch")));
  }
}

// ---- Revisions

BatchRecord Stored(const v1::PoseBatch& batch) {
  BatchRecord record;
  record.first_sequence = batch.poses(0).sequence();
  record.count = static_cast<std::uint32_t>(batch.poses_size());
  record.payload = batch.SerializeAsString();
  return record;
}

Poses PosesOf(const std::vector<v1::Pose>& poses) {
  return Poses(poses.begin(), poses.end());
}

v1::PoseBatch Revised(const v1::PoseBatch& stored, const v1::Pose& revised,
                      const VehicleConfig& config) {
  const auto record =
      ReviseBatch(Stored(stored), config, [&](std::uint64_t sequence) {
        return sequence == revised.sequence() ? &revised : nullptr;
      });
  v1::PoseBatch batch;
  EXPECT_THAT(record, IsOk());
  if (!record.ok() || !*record) return batch;
  EXPECT_EQ((*record)->first_sequence, stored.poses(0).sequence());
  EXPECT_EQ((*record)->count, static_cast<std::uint32_t>(stored.poses_size()));
  EXPECT_TRUE(batch.ParseFromString((*record)->payload));
  return batch;
}

TEST(ReviseBatchTest, ReplacesTheEstimateAndKeepsTheStamp) {
  const v1::PoseBatch stored = SomePoses();
  v1::Pose revision = PlanarPose(3, 33);
  revision.mutable_quaternion()->set_w(1);
  revision.mutable_covariance()->set_values(0, 9);
  revision.mutable_stamp()->set_seconds(1);
  const v1::PoseBatch after = Revised(stored, revision, Planar());
  v1::PoseBatch expected = stored;
  *expected.mutable_poses(2) = revision;
  expected.mutable_poses(2)->mutable_stamp()->set_seconds(77);
  EXPECT_EQ(after.DebugString(), expected.DebugString());
}

TEST(ReviseBatchTest, LeavesABatchAloneOfWhichNoPoseIsNamed) {
  const auto record = ReviseBatch(Stored(SomePoses()), Planar(),
                                  [](std::uint64_t) { return nullptr; });
  ASSERT_THAT(record, IsOk());
  EXPECT_FALSE(record->has_value());
}

TEST(ReviseBatchTest, KeepsTheTransitionWhereNoneIsGiven) {
  v1::PoseBatch stored;
  *stored.add_poses() = PlanarPose(2, 0);
  for (int i = 1; i <= 9; ++i) stored.mutable_poses(0)->add_error_transition(i);
  const VehicleConfig config = Filter(Planar());
  v1::Pose revision = PlanarPose(2, 5);
  ASSERT_THAT(CheckRevisedPoses(PosesOf({revision}), 0, config), IsOk());
  EXPECT_THAT(Revised(stored, revision, config).poses(0).error_transition(),
              ElementsAre(1, 2, 3, 4, 5, 6, 7, 8, 9));
  for (int i = 0; i < 9; ++i) revision.add_error_transition(0.5);
  EXPECT_THAT(Revised(stored, revision, config).poses(0).error_transition(),
              ::testing::Each(0.5));
}

// Otherwise it would be taken for one in the axes of the local frame.
TEST(ReviseBatchTest, TurnsTheTransitionOfAGeodeticPoseThatBecomesLocal) {
  VehicleConfig config = Filter(Geodetic(Planar()));
  config.origin = GeodeticOrigin{60, 0, 0};
  v1::PoseBatch stored;
  *stored.add_poses() = GeodeticPose(2, 60, 3, 0);
  for (const double value : {2.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0}) {
    stored.mutable_poses(0)->add_error_transition(value);
  }
  const ProtoRecordCodec codec;
  const auto before =
      codec.DecodeBatch(stored.SerializeAsString(), config).value();
  const v1::PoseBatch batch = Revised(stored, PlanarPose(2, 5), config);
  const auto after = codec.DecodeBatch(batch.SerializeAsString(), config);
  ASSERT_THAT(after, IsOk());
  EXPECT_EQ(after->samples[0].pose.x, 5);
  for (std::size_t i = 0; i < 16; ++i) {
    EXPECT_THAT(after->samples[0].transition->values[i],
                DoubleNear(before.samples[0].transition->values[i], 1e-12));
  }
}

TEST(ReviseBatchTest, ChecksRevisedPosesLikeAllOthersButForTheirFrame) {
  VehicleConfig config = Geodetic(Planar());
  config.origin = GeodeticOrigin{60, 0, 0};
  const v1::Pose local = PlanarPose(9, 0);
  const v1::Pose geodetic = GeodeticPose(4, 60, 0, 0);
  EXPECT_THAT(CheckRevisedPoses(PosesOf({local, geodetic}), 0, config), IsOk());
  EXPECT_THAT(CheckRevisedPoses(PosesOf({local, geodetic}), 7, Planar()),
              IsError(StatusCode::kInvalidArgument, "INVALID_FIELD",
                      StartsWith("poses[8].geodetic: ")));
  v1::Pose flat = PlanarPose(9, 0);
  flat.mutable_covariance()->set_values(0, 0);
  EXPECT_THAT(
      CheckRevisedPoses(PosesOf({flat}), 0, config),
      IsError(StatusCode::kInvalidArgument, "COVARIANCE_NOT_POSITIVE_DEFINITE",
              StartsWith("poses[0].covariance.values: ")));
}

// ---- Answers

// Two laps of a square of 60 m a side.
core::Engine TwoLaps(core::EngineSettings settings) {
  settings.search.sequence_length_meters = 40;
  // The whole sequence is aligned, and the gate at its end decides.
  settings.search.alignment = core::AlignmentKind::kComposite;
  core::Engine engine(settings);
  std::vector<core::PoseSample> samples;
  core::Pose pose;
  for (std::uint64_t i = 0; i <= 480; ++i) {
    core::PoseSample sample;
    sample.sequence = i + 1;
    sample.stamp_ns = static_cast<std::int64_t>(i) * 100000000;
    pose.heading = core::kPi / 2.0 * static_cast<double>(i / 60 % 4);
    pose.z = 0.5;
    sample.pose = pose;
    for (int d = 0; d < 4; ++d) sample.covariance(d, d) = d == 3 ? 1e-4 : 0.04;
    samples.push_back(sample);
    pose.x += std::cos(pose.heading);
    pose.y += std::sin(pose.heading);
  }
  engine.Append(samples, 7);
  return engine;
}

v1::CandidateSet Answer(const VehicleConfig& config, bool with_path) {
  const std::string id = "square";
  const core::Engine engine = TwoLaps(config.engine);
  const VehicleView view{id, config, engine, 1, 481, 7, 0};
  const auto found =
      engine.FindCandidates(engine.settings().search, [] { return false; });
  EXPECT_THAT(found, IsOk());
  v1::CandidateSet message;
  EncodeCandidateSet(view, *found, with_path,
                     std::chrono::nanoseconds(1000000002), &message);
  return message;
}

TEST(AnswerTest, CandidateSaysWhereAndHowSure) {
  const v1::CandidateSet set = Answer(Planar(), true);
  EXPECT_EQ(set.revision(), 7u);
  EXPECT_EQ(set.search_duration().seconds(), 1);
  EXPECT_EQ(set.search_duration().nanos(), 2);
  EXPECT_EQ(set.empty_reason(), v1::EMPTY_REASON_UNSPECIFIED);
  ASSERT_GT(set.candidates_size(), 0);
  const v1::Candidate& best = set.candidates(0);
  EXPECT_EQ(best.rank(), 1);
  EXPECT_EQ(best.query().DebugString(), set.query().DebugString());
  EXPECT_EQ(set.query().sequence(), 481u);
  EXPECT_EQ(set.query().stamp().seconds(), 48);
  EXPECT_NEAR(set.query().travelled_meters(), 480.0, 1e-9);
  // One lap before.
  EXPECT_NEAR(best.matched().travelled_meters(), 240.0, 2.0);
  EXPECT_EQ(best.gate().verdict(), v1::GATE_VERDICT_ACCEPTED);
  EXPECT_EQ(best.gate().degrees_of_freedom(), 3);
  EXPECT_EQ(best.gate().inflation(), 1.0);
  EXPECT_EQ(best.direction(), v1::DIRECTION_SAME);
  // What a composite alignment does not know is absent.
  EXPECT_FALSE(best.has_probability());
  EXPECT_FALSE(best.has_odds_to_runner_up());
  EXPECT_FALSE(best.has_path_gate());
  EXPECT_FALSE(best.has_shape());
  EXPECT_FALSE(set.has_new_place_probability());
  EXPECT_EQ(best.difference().covariance().form(),
            v1::COVARIANCE_FORM_PLANAR_6);
  EXPECT_EQ(best.difference().covariance().values_size(), 6);
  EXPECT_NEAR(best.difference().x_meters(),
              best.query().pose().x_meters() - best.matched().pose().x_meters(),
              1e-12);
  EXPECT_EQ(best.query().pose().z_meters(), 0.0);
  EXPECT_EQ(best.difference().z_meters(), 0.0);
  EXPECT_FALSE(best.query().has_covariance());
  ASSERT_EQ(best.aligned_path_size(), 20);
  EXPECT_EQ(best.aligned_path(19).query_index(), set.query().index());
  EXPECT_EQ(best.aligned_path(19).matched_index(), best.matched().index());
}

// An answer that says this of its one candidate.
v1::CandidateSet Encoded(const core::Candidate& candidate,
                         const core::CandidateSet& set) {
  const std::string id = "square";
  const VehicleConfig config = Planar();
  const core::Engine engine = TwoLaps(config.engine);
  core::CandidateSet whole = set;
  whole.query = 240;
  whole.candidates = {candidate};
  v1::CandidateSet message;
  EncodeCandidateSet({id, config, engine, 1, 481, 7, 0}, whole, false, {},
                     &message);
  return message;
}

TEST(AnswerTest, CandidateSaysAllThatARelativeAlignmentKnows) {
  core::Candidate candidate;
  candidate.rank = 1;
  candidate.score = 2.5;
  candidate.matched = 120;
  candidate.direction = core::Direction::kOpposite;
  candidate.verdict = core::Verdict::kAccepted;
  candidate.relative.emplace();
  candidate.relative->probability = 0.9;
  candidate.relative->odds_to_runner_up = 18.0;
  candidate.relative->path_gate = {12.5, 9.6, 18.3, 0.25,
                                   core::GateVerdict::kAccepted};
  candidate.relative->squared_end_difference = 3.5;
  candidate.relative->overlap_meters = 64.0;
  candidate.relative->log_likelihood_ratio = 31.0;
  core::CandidateSet set;
  set.new_place_probability = 0.05;
  set.inflation = 1.75;
  const v1::CandidateSet message = Encoded(candidate, set);
  EXPECT_TRUE(message.has_new_place_probability());
  EXPECT_EQ(message.new_place_probability(), 0.05);
  ASSERT_EQ(message.candidates_size(), 1);
  const v1::Candidate& only = message.candidates(0);
  EXPECT_EQ(only.verdict(), v1::VERDICT_ACCEPTED);
  EXPECT_EQ(only.direction(), v1::DIRECTION_OPPOSITE);
  EXPECT_EQ(only.probability(), 0.9);
  EXPECT_EQ(only.odds_to_runner_up(), 18.0);
  EXPECT_EQ(only.gate().inflation(), 1.75);
  EXPECT_TRUE(google::protobuf::util::MessageDifferencer::Equals(
      only.path_gate(), FromText<v1::PathGate>(R"pb(
        squared_mahalanobis_distance: 12.5
        degrees_of_freedom: 9.6
        threshold: 18.3
        p_value: 0.25
        verdict: GATE_VERDICT_ACCEPTED
        end_squared_mahalanobis_distance: 3.5
      )pb")))
      << only.path_gate().DebugString();
  EXPECT_TRUE(google::protobuf::util::MessageDifferencer::Equals(
      only.shape(), FromText<v1::ShapeEvidence>(
                        "overlap_meters: 64 log_likelihood_ratio: 31")))
      << only.shape().DebugString();
}

TEST(AnswerTest, ProbabilityOfZeroIsThereAndOddsWithoutRunnerUpAreNot) {
  core::Candidate candidate;
  candidate.matched = 120;
  candidate.relative.emplace();
  core::CandidateSet set;
  set.new_place_probability = 0.0;
  const v1::CandidateSet message = Encoded(candidate, set);
  EXPECT_TRUE(message.has_new_place_probability());
  EXPECT_TRUE(message.candidates(0).has_probability());
  EXPECT_FALSE(message.candidates(0).has_odds_to_runner_up());
  EXPECT_TRUE(message.candidates(0).has_shape());
}

TEST(AnswerTest, EveryVerdictHasItsName) {
  const std::vector<std::pair<core::Verdict, v1::Verdict>> verdicts = {
      {core::Verdict::kAccepted, v1::VERDICT_ACCEPTED},
      {core::Verdict::kRejectedByGate, v1::VERDICT_REJECTED_BY_GATE},
      {core::Verdict::kRejectedByShape, v1::VERDICT_REJECTED_BY_SHAPE},
      {core::Verdict::kAmbiguous, v1::VERDICT_AMBIGUOUS},
      {core::Verdict::kUninformative, v1::VERDICT_UNINFORMATIVE},
      {core::Verdict::kIllConditioned, v1::VERDICT_ILL_CONDITIONED}};
  for (const auto& [verdict, name] : verdicts) {
    core::Candidate candidate;
    candidate.matched = 120;
    candidate.verdict = verdict;
    EXPECT_EQ(Encoded(candidate, {}).candidates(0).verdict(), name);
  }
}

TEST(AnswerTest, SpatialVehicleAnswersWithHeight) {
  const v1::CandidateSet set = Answer(Spatial(), false);
  ASSERT_GT(set.candidates_size(), 0);
  const v1::Candidate& best = set.candidates(0);
  EXPECT_EQ(best.gate().degrees_of_freedom(), 4);
  EXPECT_EQ(best.query().pose().z_meters(), 0.5);
  EXPECT_EQ(best.difference().covariance().form(),
            v1::COVARIANCE_FORM_SPATIAL_10);
  EXPECT_EQ(best.difference().covariance().values_size(), 10);
  EXPECT_EQ(best.aligned_path_size(), 0);
}

TEST(AnswerTest, VehicleWithoutNodesHasNoQuery) {
  const std::string id = "empty";
  const VehicleConfig config;
  const core::Engine engine(config.engine);
  const VehicleView view{id, config, engine, 1, 0, 1, 0};
  const auto found =
      engine.FindCandidates(config.engine.search, [] { return false; });
  ASSERT_THAT(found, IsOk());
  v1::CandidateSet set;
  EncodeCandidateSet(view, *found, false, {}, &set);
  EXPECT_FALSE(set.has_query());
  EXPECT_EQ(set.empty_reason(), v1::EMPTY_REASON_PATH_TOO_SHORT);
}

TEST(AnswerTest, ExportedNodeHasItsCovarianceInTheFormOfTheVehicle) {
  const core::Engine engine = TwoLaps(Planar().engine);
  v1::Node node;
  EncodeNode(engine.graph(), 3, core::StateSpace::kPlanar, true, &node);
  const core::Covariance& covariance = engine.graph().node(3).covariance;
  EXPECT_EQ(node.covariance().form(), v1::COVARIANCE_FORM_PLANAR_6);
  EXPECT_THAT(
      node.covariance().values(),
      ElementsAre(covariance(0, 0), covariance(0, 1), covariance(0, 3),
                  covariance(1, 1), covariance(1, 3), covariance(3, 3)));
}

TEST(AnswerTest, VehicleIsToldTheSameFromMemoryAndFromTheStore) {
  VehicleConfig config;
  config.create_time_ns = -1;
  config.uid = NewVehicleUid();
  const std::string id = "a";
  const core::Engine engine(config.engine);
  v1::Vehicle loaded;
  EncodeVehicle(VehicleView{id, config, engine, 1, 5, 9, 2}, &loaded);
  VehicleRecord record;
  record.id = id;
  record.payload = ProtoRecordCodec().EncodeVehicle(config);
  record.durable_sequence = 5;
  record.revision = 9;
  record.loop_closure_count = 2;
  v1::Vehicle stored;
  EncodeVehicle(record, &stored);
  // Only who has the vehicle in memory knows how consistent it is.
  EXPECT_FALSE(stored.has_consistency());
  EXPECT_TRUE(loaded.has_consistency());
  loaded.clear_consistency();
  EXPECT_EQ(loaded.DebugString(), stored.DebugString());
  EXPECT_EQ(loaded.name(), "vehicles/a");
  EXPECT_EQ(loaded.create_time().seconds(), -1);
  EXPECT_EQ(loaded.create_time().nanos(), 999999999);
}

TEST(AnswerTest, DamagedVehicleTellsWhatIsSound) {
  VehicleRecord record = RecordOf("");
  record.damage = absl::DataLossError("damaged");
  record.durable_sequence = 5;
  v1::Vehicle vehicle;
  EncodeVehicle(record, &vehicle);
  EXPECT_EQ(vehicle.DebugString(), FromText<v1::Vehicle>(R"pb(
                                     name: "vehicles/truck"
                                     state: VEHICLE_STATE_DAMAGED
                                   )pb")
                                       .DebugString());
  record.payload = ProtoRecordCodec().EncodeVehicle(Planar());
  EncodeVehicle(record, &vehicle);
  EXPECT_EQ(vehicle.state(), v1::VEHICLE_STATE_DAMAGED);
  EXPECT_TRUE(vehicle.has_settings());
  record.id =
      "tr\xff"
      "ck";
  EncodeVehicle(record, &vehicle);
  EXPECT_EQ(vehicle.name(), "vehicles/tr?ck");
  // What damaged rows claim is nothing to rely on.
  EXPECT_EQ(vehicle.durable_sequence(), 0u);
}

TEST(AnswerTest, VehicleSaysHowConsistentItIs) {
  VehicleConfig config = Planar();
  config.engine.apply_inflation = true;
  const std::string id = "a";
  core::Engine engine = TwoLaps(config.engine);
  const auto consistency = [&] {
    v1::Vehicle vehicle;
    EncodeVehicle(VehicleView{id, config, engine, 1, 481, 9, 0}, &vehicle);
    return vehicle.consistency();
  };
  const v1::Consistency before = consistency();
  EXPECT_EQ(before.confirmed_count(), 0);
  EXPECT_EQ(before.rejected_count(), 0);
  EXPECT_FALSE(before.has_mean_normalized_innovation_squared());
  EXPECT_EQ(before.degrees_of_freedom(), 3);
  EXPECT_GT(before.inflation(), 1.0);
  EXPECT_EQ(before.inflation(), engine.consistency().inflation);
  EXPECT_TRUE(before.applied());
  engine.AddRejection(400, 100, 8);
  EXPECT_EQ(consistency().rejected_count(), 1);
}

}  // namespace
}  // namespace revisit::server
