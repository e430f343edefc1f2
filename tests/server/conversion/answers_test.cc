#include "server/conversion/answers.h"

#include <chrono>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "core/drive/findings.h"
#include "core/drive/frame_relations.h"
#include "core/drive/pose_graph.h"
#include "core/drive/recordings.h"
#include "core/geometry/heading.h"
#include "core/geometry/pose.h"
#include "core/geometry/recording_start.h"
#include "core/search/search.h"
#include "core/settings.h"
#include "gmock/gmock.h"
#include "google/protobuf/util/message_differencer.h"
#include "gtest/gtest.h"
#include "server/conversion/findings.h"
#include "server/fleet/group_scope.h"
#include "server/records/proto_record_codec.h"
#include "server/sessions/vehicle_uid.h"
#include "tests/server/conversion/conversion_testing.h"
#include "tests/server/error_matchers.h"

namespace revisit::server {
namespace {

using ::testing::AllOf;
using ::testing::ElementsAre;
using ::testing::HasSubstr;

// Two laps of a square of 60 m a side.
core::Drive TwoLaps(core::DriveSettings settings) {
  settings.search.sequence_length_meters = 40;
  // A composite alignment aligns the whole sequence, and the gate at its end
  // decides.
  settings.search.alignment = core::AlignmentKind::kComposite;
  core::Drive drive(settings);
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
  drive.Append(samples, 7);
  return drive;
}

v1::CandidateSet Answer(const VehicleConfig& config, bool with_path) {
  const std::string id = "square";
  const core::Drive drive = TwoLaps(config.drive);
  const VehicleView view{id, config, drive, 1, 481, 7, 0};
  const auto found =
      core::Search(&drive).AtEnd(drive.settings().search, [] { return false; });
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
  // The best match lies one lap before.
  EXPECT_NEAR(best.matched().travelled_meters(), 240.0, 2.0);
  EXPECT_EQ(best.gate().verdict(), v1::GATE_VERDICT_ACCEPTED);
  EXPECT_EQ(best.gate().degrees_of_freedom(), 3);
  EXPECT_EQ(best.gate().inflation(), 1.0);
  EXPECT_EQ(best.direction(), v1::DIRECTION_SAME);
  EXPECT_EQ(best.recording_of_match(), "vehicles/square/recordings/1");
  EXPECT_EQ(best.frame_state(), v1::FRAME_STATE_SAME);
  // Fields that a composite alignment does not know are absent.
  EXPECT_FALSE(best.has_probability());
  EXPECT_FALSE(best.has_odds_to_runner_up());
  EXPECT_FALSE(best.has_path_gate());
  EXPECT_FALSE(best.has_shape());
  EXPECT_FALSE(best.has_place_interval());
  EXPECT_FALSE(set.has_scale_estimate());
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

// An answer with this one candidate.
v1::CandidateSet Encoded(const core::Candidate& candidate,
                         const core::CandidateSet& set) {
  const std::string id = "square";
  const VehicleConfig config = Planar();
  const core::Drive drive = TwoLaps(config.drive);
  core::CandidateSet whole = set;
  whole.query = 240;
  whole.candidates = {candidate};
  v1::CandidateSet message;
  EncodeCandidateSet({id, config, drive, 1, 481, 7, 0}, whole, false, {},
                     &message);
  return message;
}

std::shared_ptr<const KnownHistory> HistoryOf(const std::string& id) {
  VehicleConfig config = Planar();
  config.uid = "uid-of-" + id;
  const core::Drive drive = TwoLaps(config.drive);
  return std::make_shared<const KnownHistory>(
      KnownHistory{id, 1, config, 7, 481, "series", HistoryView(drive)});
}

TEST(AnswerTest, AnswerInAGroupNamesTheVehicles) {
  StoredGroup group;
  group.version.revision = 12;
  GroupScope scope;
  scope.joined = std::make_shared<const JoinedGroup>(JoinedGroup{
      std::make_shared<const StoredGroup>(group),
      {HistoryOf("a"), HistoryOf("c"), HistoryOf("d"), HistoryOf("square")},
      nullptr});
  scope.scope.asking = 3;
  scope.scope.searched = {true, true, false, true};
  scope.as_of.assign(4, std::chrono::steady_clock::now());
  scope.absent = {{"b", Absence::kMemory}, {"e", Absence::kDamaged}};
  const std::string id = "square";
  const VehicleConfig config = Planar();
  const core::Drive drive = TwoLaps(config.drive);
  core::CandidateSet set;
  set.query = 240;
  set.candidates.resize(2);
  set.candidates[0].drive = 1;
  set.candidates[0].matched = 30;
  set.candidates[1].matched = 40;
  set.unsearched = {{0, core::UnsearchedReason::kNodeSpacing}};
  v1::CandidateSet message;
  EncodeCandidateSet({id, config, drive, 1, 481, 7, 0}, set, false, {},
                     &message, &scope);
  EXPECT_EQ(message.group_revision(), 12u);
  const v1::Candidate& other = message.candidates(0);
  EXPECT_EQ(other.matched_vehicle(), "vehicles/c");
  EXPECT_EQ(other.matched_vehicle_uid(), "uid-of-c");
  EXPECT_EQ(other.recording_of_match(), "vehicles/c/recordings/1");
  EXPECT_EQ(other.matched().index(), 30);
  EXPECT_EQ(message.candidates(1).matched_vehicle(), "");
  EXPECT_EQ(message.candidates(1).recording_of_match(),
            "vehicles/square/recordings/1");
  ASSERT_EQ(message.searched_size(), 1);
  EXPECT_EQ(message.searched(0).vehicle(), "vehicles/c");
  EXPECT_EQ(message.searched(0).node_count(), 241);
  EXPECT_EQ(message.searched(0).last_sequence(), 481u);
  EXPECT_GE(message.searched(0).lag().nanos(), 0);
  std::vector<std::pair<std::string, v1::UnsearchedReason>> unsearched;
  for (const v1::UnsearchedVehicle& vehicle : message.unsearched()) {
    unsearched.emplace_back(vehicle.vehicle(), vehicle.reason());
  }
  EXPECT_THAT(
      unsearched,
      ElementsAre(std::pair("vehicles/a", v1::UNSEARCHED_REASON_NODE_SPACING),
                  std::pair("vehicles/b", v1::UNSEARCHED_REASON_MEMORY),
                  std::pair("vehicles/e", v1::UNSEARCHED_REASON_DAMAGED)));
}

TEST(AnswerTest, CandidateSaysAllThatARelativeAlignmentKnows) {
  core::Candidate candidate;
  candidate.rank = 1;
  candidate.score = 2.5;
  candidate.matched = 120;
  candidate.direction = core::Direction::kOpposite;
  candidate.verdict = core::Verdict::kAccepted;
  candidate.relative.emplace();
  candidate.difference.emplace();
  candidate.inflation = 1.75;
  candidate.relative->probability = 0.9;
  candidate.relative->meters_before = 12.0;
  candidate.relative->meters_after = 0.0;
  candidate.relative->odds_to_runner_up = 18.0;
  candidate.relative->path_gate = {12.5, 9.6, 18.3, 0.25,
                                   core::GateVerdict::kAccepted};
  candidate.relative->squared_end_difference = 3.5;
  candidate.relative->overlap_meters = 64.0;
  candidate.relative->log_likelihood_ratio = 31.0;
  core::CandidateSet set;
  set.new_place_probability = 0.05;
  set.scale = core::ScaleEstimate{1.5, 0.75, 3.0};
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
  EXPECT_TRUE(only.has_place_interval());
  EXPECT_EQ(only.place_interval().meters_before(), 12.0);
  EXPECT_EQ(only.place_interval().meters_after(), 0.0);
  EXPECT_TRUE(google::protobuf::util::MessageDifferencer::Equals(
      message.scale_estimate(),
      FromText<v1::ScaleEstimate>("scale: 1.5 low: 0.75 high: 3")))
      << message.scale_estimate().DebugString();
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

// Poses along +x, one a metre.
std::vector<core::PoseSample> Straight(std::uint64_t first,
                                       std::uint64_t count) {
  std::vector<core::PoseSample> samples;
  for (std::uint64_t i = 0; i < count; ++i) {
    core::PoseSample& sample = samples.emplace_back();
    sample.sequence = first + i;
    sample.pose.x = static_cast<double>(i);
    for (int d : {0, 1, 3}) {
      sample.covariance(d, d) = 1e-4 * static_cast<double>(i + 1);
    }
  }
  return samples;
}

// Three recordings of 11 poses each, the last of which has a node; of the
// second, nothing is known, and the third begins after it.
core::Drive ThreeRecordings() {
  core::Drive drive(Planar().drive);
  drive.Append(Straight(1, 11), 1);
  core::RecordingStart start;
  start.relation = core::RecordingRelation::kUnknown;
  start.label = "second";
  std::vector<core::PoseSample> samples = Straight(12, 11);
  samples[0].recording_start =
      std::make_shared<const core::RecordingStart>(start);
  drive.Append(samples, 2);
  start.relation = core::RecordingRelation::kAfter;
  start.label = "third";
  for (int d : {0, 1, 3}) start.covariance(d, d) = 0.25;
  samples = Straight(23, 11);
  samples[0].recording_start =
      std::make_shared<const core::RecordingStart>(start);
  drive.Append(samples, 3);
  return drive;
}

TEST(AnswerTest, CandidateNamesTheRecordingOfItsMatch) {
  const std::string id = "car";
  const VehicleConfig config = Planar();
  const core::Drive drive = ThreeRecordings();
  const core::NodeIndex match = drive.recordings()[1].first_node;
  core::CandidateSet set;
  set.query = drive.graph().size() - 1;
  set.candidates.resize(1);
  set.candidates[0].matched = match;
  for (const auto& [state, name] :
       {std::pair(core::FrameState::kAfter, v1::FRAME_STATE_AFTER),
        std::pair(core::FrameState::kDatum, v1::FRAME_STATE_DATUM),
        std::pair(core::FrameState::kProvisional, v1::FRAME_STATE_PROVISIONAL),
        std::pair(core::FrameState::kKnown, v1::FRAME_STATE_KNOWN)}) {
    set.candidates[0].frame_state = state;
    set.candidates[0].difference.emplace();
    v1::CandidateSet message;
    EncodeCandidateSet({id, config, drive, 1, 33, 3, 0}, set, false, {},
                       &message);
    EXPECT_EQ(message.candidates(0).frame_state(), name);
    EXPECT_EQ(message.candidates(0).recording_of_match(),
              "vehicles/car/recordings/12");
    EXPECT_TRUE(message.candidates(0).has_difference());
    EXPECT_TRUE(message.candidates(0).has_gate());
  }
}

TEST(AnswerTest, CandidateInAFrameThatNothingTiesHasNoDifference) {
  core::Candidate candidate;
  candidate.matched = 120;
  candidate.frame_state = core::FrameState::kNone;
  candidate.relative.emplace();
  const v1::CandidateSet message = Encoded(candidate, {});
  EXPECT_EQ(message.candidates(0).frame_state(), v1::FRAME_STATE_NONE);
  EXPECT_FALSE(message.candidates(0).has_difference());
  EXPECT_FALSE(message.candidates(0).has_gate());
  EXPECT_TRUE(message.candidates(0).has_shape());
}

v1::Recording RecordingOf(const core::Drive& drive, std::size_t k) {
  const std::string id = "car";
  const VehicleConfig config = Planar();
  const core::FrameRelations relations =
      drive.RelationsAt(drive.graph().size() - 1);
  v1::Recording message;
  EncodeRecording({id, config, drive, 1, drive.last_sequence(), 3, 0}, k,
                  relations.From(relations.size() - 1)[k], &message);
  return message;
}

TEST(AnswerTest, RecordingSaysWhatBeganItAndHowItsFrameIsTied) {
  const core::Drive drive = ThreeRecordings();
  const v1::Recording first = RecordingOf(drive, 0);
  EXPECT_EQ(first.DebugString(), FromText<v1::Recording>(R"pb(
                                   name: "vehicles/car/recordings/1"
                                   first_sequence: 1
                                   last_sequence: 11
                                   frame_state: FRAME_STATE_NONE
                                 )pb")
                                     .DebugString());
  const v1::Recording second = RecordingOf(drive, 1);
  EXPECT_EQ(second.name(), "vehicles/car/recordings/12");
  EXPECT_EQ(second.label(), "second");
  EXPECT_EQ(second.start().DebugString(),
            FromText<v1::RecordingStart>("label: 'second' unknown: true")
                .DebugString());
  EXPECT_EQ(second.last_sequence(), 22u);
  EXPECT_EQ(second.frame_state(), v1::FRAME_STATE_AFTER);
  // The third one's origin is where the second one ended.
  EXPECT_NEAR(second.frame_pose().x_meters(), -10.0, 1e-12);
  EXPECT_EQ(second.frame_covariance().form(), v1::COVARIANCE_FORM_PLANAR_6);
  EXPECT_EQ(second.frame_covariance().values_size(), 6);
  EXPECT_TRUE(second.has_frame_reference());
  const v1::Recording third = RecordingOf(drive, 2);
  EXPECT_EQ(third.DebugString(), FromText<v1::Recording>(R"pb(
                                   name: "vehicles/car/recordings/23"
                                   label: "third"
                                   first_sequence: 23
                                   last_sequence: 33
                                   start {
                                     label: "third"
                                     after {
                                       form: COVARIANCE_FORM_PLANAR_6
                                       values: [ 0.25, 0, 0, 0.25, 0, 0.25 ]
                                     }
                                   }
                                   frame_state: FRAME_STATE_SAME
                                   frame_pose {}
                                 )pb")
                                     .DebugString());
}

TEST(AnswerTest, RecordingTellsItsDatum) {
  core::Drive drive(Planar().drive);
  core::RecordingStart start;
  start.relation = core::RecordingRelation::kDatum;
  start.datum = {10.0, -20.0, 3.0, 0.5};
  start.datum_id = "site";
  for (int d : {0, 1, 3}) start.covariance(d, d) = 4.0;
  std::vector<core::PoseSample> samples = Straight(1, 10);
  samples[0].recording_start =
      std::make_shared<const core::RecordingStart>(start);
  drive.Append(samples, 1);
  EXPECT_EQ(RecordingOf(drive, 0).start().DebugString(),
            FromText<v1::RecordingStart>(R"pb(
              datum {
                datum_id: "site"
                pose { x_meters: 10 y_meters: -20 heading_radians: 0.5 }
                covariance {
                  form: COVARIANCE_FORM_PLANAR_6
                  values: [ 4, 0, 0, 4, 0, 4 ]
                }
              }
            )pb")
                .DebugString());
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
  const core::Drive drive(config.drive);
  const VehicleView view{id, config, drive, 1, 0, 1, 0};
  const auto found =
      core::Search(&drive).AtEnd(config.drive.search, [] { return false; });
  ASSERT_THAT(found, IsOk());
  v1::CandidateSet set;
  EncodeCandidateSet(view, *found, false, {}, &set);
  EXPECT_FALSE(set.has_query());
  EXPECT_EQ(set.empty_reason(), v1::EMPTY_REASON_PATH_TOO_SHORT);
}

TEST(AnswerTest, ExportedNodeHasItsCovarianceInTheFormOfTheVehicle) {
  const core::Drive drive = TwoLaps(Planar().drive);
  v1::Node node;
  EncodeNode(drive.graph(), 3, core::StateSpace::kPlanar, true, &node);
  const core::Covariance& covariance = drive.graph().node(3).covariance;
  EXPECT_EQ(node.covariance().form(), v1::COVARIANCE_FORM_PLANAR_6);
  EXPECT_THAT(
      node.covariance().values(),
      ElementsAre(covariance(0, 0), covariance(0, 1), covariance(0, 3),
                  covariance(1, 1), covariance(1, 3), covariance(3, 3)));
}

TEST(AnswerTest, VehicleIsToldTheSameFromMemoryAndFromTheStore) {
  VehicleConfig config;
  config.create_time_ns = -1;
  config.uid = NewUuid();
  const std::string id = "a";
  const core::Drive drive(config.drive);
  v1::Vehicle loaded;
  EncodeVehicle(VehicleView{id, config, drive, 1, 5, 9, 2}, &loaded);
  VehicleRecord record;
  record.id = id;
  record.payload = ProtoRecordCodec().EncodeVehicle(config);
  record.durable_sequence = 5;
  record.revision = 9;
  record.loop_closure_count = 2;
  v1::Vehicle stored;
  EncodeVehicle(record, &stored);
  // Consistency is known only of vehicles in memory.
  EXPECT_FALSE(stored.has_consistency());
  EXPECT_TRUE(loaded.has_consistency());
  loaded.clear_consistency();
  loaded.clear_first_kept_sequence();
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
  // The sequence that a damaged row claims is not reliable.
  EXPECT_EQ(vehicle.durable_sequence(), 0u);
}

TEST(AnswerTest, VehicleSaysHowConsistentItIs) {
  VehicleConfig config = Planar();
  config.drive.apply_inflation = true;
  config.drive.search.use_belief = false;
  const std::string id = "a";
  core::Drive drive = TwoLaps(config.drive);
  const auto consistency = [&] {
    v1::Vehicle vehicle;
    EncodeVehicle(VehicleView{id, config, drive, 1, 481, 9, 0}, &vehicle);
    return vehicle.consistency();
  };
  const v1::Consistency before = consistency();
  EXPECT_EQ(before.confirmed_count(), 0);
  EXPECT_EQ(before.rejected_count(), 0);
  EXPECT_FALSE(before.has_mean_normalized_innovation_squared());
  EXPECT_EQ(before.degrees_of_freedom(), 3);
  EXPECT_GT(before.inflation(), 1.0);
  EXPECT_EQ(before.inflation(), drive.consistency().inflation);
  EXPECT_TRUE(before.applied());
  // A belief has the scale of the claims from elsewhere.
  config.drive.search.use_belief = true;
  EXPECT_FALSE(consistency().applied());
  config.drive.search.correlation_model = core::CorrelationModel::kIndependent;
  EXPECT_TRUE(consistency().applied());
  drive.AddRejection(400, 100, 8);
  EXPECT_EQ(consistency().rejected_count(), 1);
}

core::Finding FindingOf(core::FindingCode code, double growing,
                        std::optional<double> smoother) {
  core::Finding finding;
  finding.code = code;
  finding.growing = growing;
  finding.smoother = smoother;
  return finding;
}

std::string MessageOf(const core::Finding& finding) {
  v1::Finding message;
  EncodeFinding(finding, &message);
  return message.message();
}

TEST(AnswerTest, FindingNamesWhatWasSeenAndTheSettingThatMendsIt) {
  using core::FindingCode;
  EXPECT_THAT(
      MessageOf(FindingOf(FindingCode::kCovariancesDoNotGrow, 0.126, 1.2)),
      AllOf(HasSubstr("over 13 of 100 stretches"),
            HasSubstr("set correlation_model to INDEPENDENT")));
  for (const std::optional<double> smoother :
       {std::optional<double>(7.0), std::optional<double>()}) {
    EXPECT_THAT(
        MessageOf(FindingOf(FindingCode::kCovariancesDoNotGrow, 0.0, smoother)),
        AllOf(HasSubstr("over 0 of 100 stretches"),
              HasSubstr("set correlation_model to CORRELATED_FIXES"),
              HasSubstr("covariances that add up")));
  }
  EXPECT_THAT(MessageOf(FindingOf(FindingCode::kCovariancesGrow, 1.0, 7.0)),
              AllOf(HasSubstr("over 100 of 100 stretches"),
                    HasSubstr("set correlation_model to DEAD_RECKONING")));
  EXPECT_THAT(MessageOf(FindingOf(FindingCode::kErrorsCorrelated, 0.0, 6.54)),
              AllOf(HasSubstr("6.5 times less"),
                    HasSubstr("set correlation_model to CORRELATED_FIXES")));
}

TEST(AnswerTest, NewFrameIsMendedByTheStartOfARecording) {
  core::Finding finding;
  finding.code = core::FindingCode::kNewFrame;
  finding.frame.emplace();
  finding.frame->sequence = 401;
  finding.frame->meters = 583.2;
  EXPECT_THAT(MessageOf(finding),
              AllOf(HasSubstr("sequence 401 looks like the start of a new "
                              "recording, in a frame of its own"),
                    HasSubstr("583 m"),
                    HasSubstr("with recording_start (revisit: --recording)")));
}

TEST(AnswerTest, ClaimsThatAreNoneOfReckoningAreSaidToBeCarriedOn) {
  EXPECT_THAT(MessageOf(FindingOf(core::FindingCode::kCovariancesWithoutLever,
                                  1.0, {})),
              AllOf(HasSubstr("with their cross terms"),
                    HasSubstr("revisit: --uncertainty model")));
  core::Finding finding;
  finding.code = core::FindingCode::kCovariancesReset;
  finding.reset = core::ClaimsReset{501, {31.4, 0.052}, {0.1, 0.01}};
  EXPECT_THAT(
      MessageOf(finding),
      AllOf(HasSubstr("begun anew at sequence 501, but the pose went on"),
            HasSubstr("within 0.1 m and 0.01 rad after 31 m and 0.052 rad"),
            HasSubstr("revisit: --recording")));
  v1::Warning warning;
  EncodeFindingWarning(finding, 640, &warning);
  EXPECT_EQ(warning.metadata().at("finding"), "FINDING_CODE_COVARIANCES_RESET");
  EXPECT_EQ(warning.metadata().at("sequence"), "501");
  EXPECT_EQ(warning.metadata().at("before_meters"), "31.4");
  EXPECT_EQ(warning.metadata().at("after_radians"), "0.01");
}

TEST(AnswerTest, AcknowledgementWarnsOfAFinding) {
  Acknowledgement acknowledgement;
  acknowledgement.durable_sequence = 640;
  v1::Ack ack;
  EncodeAck(acknowledgement, &ack);
  EXPECT_EQ(ack.warnings_size(), 0);
  acknowledgement.findings = {
      FindingOf(core::FindingCode::kErrorsCorrelated, 0.0, 6.5)};
  EncodeAck(acknowledgement, &ack);
  ASSERT_EQ(ack.warnings_size(), 1);
  EXPECT_EQ(ack.warnings(0).reason(), v1::WARNING_REASON_FINDING);
  EXPECT_EQ(ack.warnings(0).message(), MessageOf(acknowledgement.findings[0]));
  EXPECT_EQ(ack.warnings(0).metadata().at("finding"),
            "FINDING_CODE_ERRORS_CORRELATED");
  EXPECT_EQ(ack.warnings(0).metadata().at("sequence"), "640");
}

TEST(AnswerTest, AcknowledgementTellsHowFarStampsAreOffAndWhere) {
  constexpr std::int64_t kSecond = 1'000'000'000;
  Acknowledgement acknowledgement;
  acknowledgement.durable_sequence = 640;
  EXPECT_FALSE(acknowledgement.has_warnings());
  core::Finding leap = FindingOf(core::FindingCode::kStampsLeap, 0.0, 1.0);
  leap.leap = core::StampLeap{630, 400 * 24 * 3600 * kSecond};
  acknowledgement.findings = {leap};
  EXPECT_TRUE(acknowledgement.has_warnings());
  acknowledgement.stamp_ahead = StampAhead{635, 301 * kSecond};
  v1::Ack ack;
  EncodeAck(acknowledgement, &ack);
  ASSERT_EQ(ack.warnings_size(), 2);
  EXPECT_EQ(ack.warnings(0).reason(), v1::WARNING_REASON_FINDING);
  EXPECT_THAT(ack.warnings(0).message(),
              HasSubstr("go forward by 400 days to sequence 630"));
  EXPECT_EQ(ack.warnings(0).metadata().at("finding"),
            "FINDING_CODE_STAMPS_LEAP");
  EXPECT_EQ(ack.warnings(0).metadata().at("sequence"), "630");
  EXPECT_EQ(ack.warnings(0).metadata().at("seconds"), "34560000");
  EXPECT_EQ(ack.warnings(1).reason(), v1::WARNING_REASON_STAMPS_AHEAD);
  EXPECT_THAT(ack.warnings(1).message(),
              HasSubstr("sequence 635 is 301 s ahead of the server's clock"));
  EXPECT_EQ(ack.warnings(1).metadata().at("sequence"), "635");
  EXPECT_EQ(ack.warnings(1).metadata().at("seconds"), "301");
}

}  // namespace
}  // namespace revisit::server
