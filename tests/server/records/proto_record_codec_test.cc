#include "server/records/proto_record_codec.h"

#include <cstdint>
#include <cstdio>
#include <functional>
#include <limits>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "core/drive/dropped_stretch.h"
#include "core/geometry/heading.h"
#include "gmock/gmock.h"
#include "google/protobuf/util/message_differencer.h"
#include "gtest/gtest.h"
#include "revisit/v1/pose_graph_service.pb.h"
#include "server/conversion/vehicle_settings.h"
#include "server/fields/pose_fields.h"
#include "server/records/batch_records.h"
#include "server/records/stored_records.pb.h"
#include "tests/server/conversion/conversion_testing.h"
#include "tests/server/error_matchers.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using ::testing::_;
using ::testing::DoubleNear;
using ::testing::ElementsAre;
using ::testing::ElementsAreArray;
using ::testing::HasSubstr;
using ::testing::SizeIs;
using ::testing::StartsWith;

// ---- Vehicles

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
    use_belief: false
    fix_correlation_meters: 75
    retention {
      max_age { seconds: 77 nanos: 5 }
      max_passes: 3
    }
    checks: STORED_CHECKS_STORED
    keep_probability: 0.25
    check_group: "groups/site"
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

TEST(SettingsConversionTest, RecordOfTheFirstReleaseTakesTodaysDefaults) {
  // The first release had fields 1 to 13.
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
  EXPECT_EQ(config->drive.node_spacing_meters, 3);
  EXPECT_EQ(config->drive.search.alignment, core::AlignmentKind::kRelative);
  EXPECT_EQ(config->drive.max_inflation, 10);
  EXPECT_FALSE(config->drive.apply_inflation);
  EXPECT_TRUE(config->drive.search.use_belief);
}

TEST(SettingsConversionTest, VehicleStoredBeforeThereWereUidsHasAlwaysTheSame) {
  const ProtoRecordCodec codec;
  VehicleRecord record = RecordOf(
      FromText<v1::Vehicle>("create_time { seconds: 1 }").SerializeAsString());
  const auto uid = [&] { return codec.DecodeVehicle(record)->uid; };
  const std::string first = uid();
  EXPECT_EQ(first, "da5804d8-0180-8507-9a95-6c4d9a0ec1fe");
  // The uid is the same once the record is written again.
  record.payload = codec.EncodeVehicle(*codec.DecodeVehicle(record));
  record.key = 9;
  EXPECT_EQ(uid(), first);
  // Another vehicle has another uid.
  VehicleRecord other = RecordOf(
      FromText<v1::Vehicle>("create_time { seconds: 1 }").SerializeAsString());
  other.key = 2;
  EXPECT_NE(codec.DecodeVehicle(other)->uid, first);
}

TEST(SettingsConversionTest, UnreadableRecordIsDataLoss) {
  const ProtoRecordCodec codec;
  for (const std::string& payload :
       {std::string("\xff\xff"), std::string(),
        // These two lack a creation time and have a setting out of range.
        FromText<v1::Vehicle>("settings {}").SerializeAsString(),
        FromText<v1::Vehicle>(
            "settings { max_candidates: -1 } create_time { seconds: 1 }")
            .SerializeAsString()}) {
    EXPECT_THAT(
        codec.DecodeVehicle(RecordOf(payload)),
        IsError(StatusCode::kDataLoss, "STORE_CORRUPT", HasSubstr("vehicle")));
  }
}

// ---- Batches

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
      DecodeBatch(SentPosesOf(batch), kMaxPoses, Planar(), FieldPath());
  ASSERT_THAT(decoded, IsOk());
  EXPECT_EQ(decoded->payload, batch.SerializeAsString());
}

std::vector<std::uint64_t> FingerprintsOf(const std::string& payload) {
  const auto fingerprints = ProtoRecordCodec().Fingerprints(payload);
  EXPECT_THAT(fingerprints, IsOk());
  return fingerprints.value_or(std::vector<std::uint64_t>());
}

// SomePoses() without stamps, since columns have them of all poses or of none.
v1::PoseBatch SomeMessages() {
  v1::PoseBatch batch = SomePoses();
  for (v1::Pose& pose : *batch.mutable_poses()) pose.clear_stamp();
  return batch;
}

// The same as columns.
v1::PoseBatch SomeColumns() {
  const v1::PoseBatch messages = SomeMessages();
  v1::PoseBatch batch;
  v1::PoseColumns& columns = *batch.mutable_columns();
  columns.set_first_sequence(1);
  columns.set_pose_count(5);
  for (const v1::Pose& pose : messages.poses()) {
    columns.add_x_meters(pose.local().x_meters());
    columns.add_y_meters(pose.local().y_meters());
    columns.add_z_meters(pose.local().z_meters());
    columns.add_heading_radians(pose.heading_radians());
    columns.mutable_covariances()->MergeFrom(pose.covariance().values());
  }
  columns.set_covariance_form(v1::COVARIANCE_FORM_PLANAR_6);
  return batch;
}

// The stored payloads of five poses, in both forms.
std::vector<std::string> BothForms() {
  std::vector<std::string> payloads;
  for (const v1::PoseBatch& batch : {SomeMessages(), SomeColumns()}) {
    const auto sent =
        DecodeBatch(SentPosesOf(batch), kMaxPoses, Planar(), FieldPath());
    EXPECT_THAT(sent, IsOk());
    payloads.push_back(sent.value_or(DecodedBatch()).payload);
  }
  return payloads;
}

TEST(StoredBatchTest, PartsHaveThePosesAndFingerprintsOfTheWhole) {
  const ProtoRecordCodec codec;
  for (const std::string& payload : BothForms()) {
    const auto stored = codec.DecodePoses(payload, Planar());
    ASSERT_THAT(stored, IsOk());
    ASSERT_THAT(stored->samples, SizeIs(5));
    EXPECT_EQ(stored->samples[4].pose.x, 5.0);
    const std::vector<std::uint64_t> all = FingerprintsOf(payload);

    const auto slice = codec.SliceBatch(payload, 1, 3);
    ASSERT_THAT(slice, IsOk());
    const auto part = codec.DecodePoses(*slice, Planar());
    ASSERT_THAT(part, IsOk());
    ASSERT_THAT(part->samples, SizeIs(3));
    EXPECT_EQ(part->samples[0].sequence, 2u);
    EXPECT_THAT(FingerprintsOf(*slice), ElementsAre(all[1], all[2], all[3]));
    EXPECT_THAT(codec.SliceBatch(payload, 2, 0), IsOk());
    EXPECT_THAT(codec.SliceBatch(payload, 3, 3),
                IsError(StatusCode::kDataLoss, "STORE_CORRUPT",
                        HasSubstr("has 5 poses; asked for 3 from 3")));
  }
}

TEST(StoredBatchTest, IsDividedIntoBatchesOfPosesUpToSomeBytes) {
  const ProtoRecordCodec codec;
  for (const std::string& payload : BothForms()) {
    for (const std::size_t most : {std::size_t{1}, payload.size() / 2,
                                   payload.size() - 1, payload.size()}) {
      const auto parts = codec.DivideBatch(payload, 5, most);
      std::vector<std::uint64_t> fingerprints;
      for (const BatchPart& part : parts) {
        EXPECT_TRUE(part.count == 1 || part.payload.size() <= most);
        const auto decoded = codec.DecodePoses(part.payload, Planar());
        ASSERT_THAT(decoded, IsOk());
        EXPECT_EQ(decoded->samples.size(), part.count);
        const auto of_part = FingerprintsOf(part.payload);
        fingerprints.insert(fingerprints.end(), of_part.begin(), of_part.end());
      }
      EXPECT_EQ(fingerprints, FingerprintsOf(payload));
      EXPECT_EQ(parts.size() == 1, most == payload.size());
      EXPECT_EQ(parts.size() == 5, most == 1);
    }
  }
  // What is none stays as it is.
  const auto none = codec.DivideBatch("no batch", 3, 2);
  ASSERT_THAT(none, SizeIs(1));
  EXPECT_EQ(none[0].count, 3u);
  EXPECT_EQ(none[0].payload, "no batch");
}

TEST(StoredBatchTest, ColumnsAreStoredAsTheyCame) {
  v1::PoseBatch batch = SomeColumns();
  // The messages are alike.
  stored::PoseBatch stored;
  ASSERT_TRUE(stored.ParseFromString(BothForms()[1]));
  ASSERT_EQ(stored.columns_size(), 1);
  EXPECT_EQ(stored.columns(0).SerializeAsString(),
            batch.columns().SerializeAsString());
  // Fields that this version does not know reach no record.
  batch.mutable_columns()
      ->GetReflection()
      ->MutableUnknownFields(batch.mutable_columns())
      ->AddVarint(1000, 1);
  const auto sent =
      DecodeBatch(SentPosesOf(batch), kMaxPoses, Planar(), FieldPath());
  ASSERT_THAT(sent, IsOk());
  EXPECT_EQ(sent->payload, BothForms()[1]);
}

TEST(StoredBatchTest, ColumnsBecomeTheMessagesThatSayTheSame) {
  const ProtoRecordCodec codec;
  const std::vector<std::string> payloads = BothForms();
  for (const std::string& payload : payloads) {
    const auto messages = codec.AsMessages(payload);
    ASSERT_THAT(messages, IsOk());
    EXPECT_EQ(*messages, payloads[0]);
  }
  EXPECT_EQ(FingerprintsOf(payloads[1]), FingerprintsOf(payloads[0]));
}

// Storages join the batches that share a row by their bytes.
TEST(StoredBatchTest, JoinedPayloadsOfBothFormsHaveAllPosesInOrder) {
  const ProtoRecordCodec codec;
  std::string row;
  std::string messages;
  for (const int kind : {0, 1, 1, 0, 0, 1}) {
    const auto so_far = codec.DecodePoses(row, Planar());
    ASSERT_THAT(so_far, IsOk());
    const std::uint64_t before = so_far->samples.size();
    v1::PoseBatch moved = SomeMessages();
    for (v1::Pose& pose : *moved.mutable_poses()) {
      pose.set_sequence(pose.sequence() + before);
    }
    messages += moved.SerializeAsString();
    if (kind == 1) {
      moved = SomeColumns();
      moved.mutable_columns()->set_first_sequence(1 + before);
    }
    const auto sent =
        DecodeBatch(SentPosesOf(moved), kMaxPoses, Planar(), FieldPath());
    ASSERT_THAT(sent, IsOk());
    row += sent->payload;
  }
  const auto decoded = codec.DecodePoses(row, Planar());
  ASSERT_THAT(decoded, IsOk());
  ASSERT_THAT(decoded->samples, SizeIs(30));
  for (std::size_t i = 0; i < 30; ++i) {
    EXPECT_EQ(decoded->samples[i].sequence, i + 1);
  }
  const auto as_messages = codec.AsMessages(row);
  ASSERT_THAT(as_messages, IsOk());
  EXPECT_EQ(*as_messages, messages);
  const std::vector<std::uint64_t> all = FingerprintsOf(row);
  EXPECT_EQ(all, FingerprintsOf(messages));
  for (std::size_t first = 0; first < 30; first += 3) {
    for (std::size_t count = 1; count <= 30 - first; count += 4) {
      const auto slice = codec.SliceBatch(row, first, count);
      ASSERT_THAT(slice, IsOk());
      EXPECT_THAT(FingerprintsOf(*slice),
                  ElementsAreArray(all.data() + first, count));
    }
  }
  // In another order, or with a gap, they are none.
  const std::string columns = BothForms()[1];
  EXPECT_THAT(codec.DecodePoses(columns + columns, Planar()),
              IsError(StatusCode::kDataLoss, "STORE_CORRUPT", _));
}

TEST(StoredBatchTest, ColumnsThatAreNoneAreDataLoss) {
  const ProtoRecordCodec codec;
  stored::PoseBatch sound;
  ASSERT_TRUE(sound.ParseFromString(BothForms()[1]));
  const std::vector<std::function<void(stored::PoseBatch*)>> changes = {
      [](auto* b) { b->mutable_columns(0)->clear_x_meters(); },
      [](auto* b) { b->mutable_columns(0)->set_pose_count(0); },
      [](auto* b) { b->mutable_columns(0)->set_pose_count(-1); },
      [](auto* b) { b->mutable_columns(0)->set_pose_count(2147483647); },
      [](auto* b) { b->mutable_columns(0)->clear_covariance_form(); },
      [](auto* b) { b->mutable_columns(0)->add_stamp_step_nanos(1); },
      [](auto* b) { b->mutable_columns(0)->add_error_transitions(1); },
      [](auto* b) { b->mutable_dropped()->set_first_sequence(1); }};
  for (std::size_t i = 0; i < changes.size(); ++i) {
    stored::PoseBatch damaged = sound;
    changes[i](&damaged);
    BatchRecord record;
    record.payload = damaged.SerializeAsString();
    const auto is_loss = IsError(StatusCode::kDataLoss, "STORE_CORRUPT", _);
    EXPECT_THAT(codec.DecodePoses(record.payload, Planar()), is_loss) << i;
    EXPECT_THAT(codec.Fingerprints(record.payload), is_loss) << i;
    EXPECT_THAT(codec.AsMessages(record.payload), is_loss) << i;
    EXPECT_THAT(codec.SliceBatch(record.payload, 0, 1), is_loss) << i;
    EXPECT_THAT(VisitPoses(record, [](const PoseFields&) { return true; }),
                is_loss)
        << i;
    EXPECT_THAT(
        ReviseBatch(record, Planar(), RevisedStarts::kStay,
                    [](std::uint64_t) { return std::optional<PoseFields>(); }),
        is_loss)
        << i;
  }
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
      FingerprintsOf(DecodeAll({pose}, Planar()).value().payload)[0];
  for (std::size_t i = 0; i < changes.size(); ++i) {
    v1::Pose changed = pose;
    changes[i](&changed);
    const auto decoded = DecodeAll({changed}, Planar());
    ASSERT_THAT(decoded, IsOk());
    EXPECT_NE(FingerprintsOf(decoded->payload)[0], original) << "change " << i;
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
  EXPECT_EQ(FingerprintsOf(decoded->payload)[0], 17976514935543079048u);
}

TEST(StoredBatchTest, UnreadableRecordIsDataLoss) {
  const ProtoRecordCodec codec;
  v1::PoseBatch batch = SomePoses();
  batch.mutable_poses(1)->set_sequence(9);
  for (const std::string& payload :
       {std::string("\x0a\x7f"), batch.SerializeAsString()}) {
    EXPECT_THAT(
        codec.DecodePoses(payload, Planar()),
        IsError(StatusCode::kDataLoss, "STORE_CORRUPT", HasSubstr("batch")));
  }
}

// ---- Dropped poses

TEST(StoredBatchTest, KeepsWhatIsLeftOfDroppedPoses) {
  const ProtoRecordCodec codec;
  core::DroppedStretch stretch{5, 104, 321.5, std::nullopt};
  BatchRecord record;
  record.payload = codec.EncodeDropped(stretch);
  const auto plain = codec.DecodePoses(record.payload, Planar());
  ASSERT_THAT(plain, IsOk());
  ASSERT_TRUE(plain->dropped);
  EXPECT_TRUE(plain->samples.empty());
  EXPECT_EQ(plain->dropped->first_sequence, 5u);
  EXPECT_EQ(plain->dropped->last_sequence, 104u);
  EXPECT_EQ(plain->dropped->travelled_meters, 321.5);
  EXPECT_FALSE(plain->dropped->transition);
  EXPECT_THAT(VisitPoses(record,
                         [](const PoseFields&) {
                           ADD_FAILURE() << "there is none";
                           return true;
                         }),
              IsOk());
  EXPECT_THAT(
      codec.SliceBatch(record.payload, 0, 1),
      IsError(StatusCode::kDataLoss, "STORE_CORRUPT", HasSubstr("batch")));

  VehicleConfig filter = Planar();
  filter.drive.search.correlation_model = core::CorrelationModel::kFilter;
  // What a filter needs is missing.
  EXPECT_THAT(
      codec.DecodePoses(record.payload, filter),
      IsError(StatusCode::kDataLoss, "STORE_CORRUPT", HasSubstr("batch")));
  stretch.transition.emplace().values[3] = -17.25;
  const auto carried = codec.DecodePoses(codec.EncodeDropped(stretch), filter);
  ASSERT_THAT(carried, IsOk());
  EXPECT_EQ(carried->dropped->transition->values, stretch.transition->values);
}

TEST(StoredBatchTest, DroppedPosesThatCannotHaveBeenAreDataLoss) {
  const ProtoRecordCodec codec;
  const double nan = std::numeric_limits<double>::quiet_NaN();
  for (const core::DroppedStretch& wrong :
       {core::DroppedStretch{0, 4, 1.0, std::nullopt},
        core::DroppedStretch{5, 4, 1.0, std::nullopt},
        core::DroppedStretch{1, 4, -1.0, std::nullopt},
        core::DroppedStretch{1, 4, nan, std::nullopt}}) {
    EXPECT_THAT(
        codec.DecodePoses(codec.EncodeDropped(wrong), Planar()),
        IsError(StatusCode::kDataLoss, "STORE_CORRUPT", HasSubstr("batch")));
  }
  // Beside poses, as where two rows were taken for one.
  EXPECT_THAT(
      codec.DecodePoses(SomePoses().SerializeAsString() +
                            codec.EncodeDropped({1, 4, 1.0, std::nullopt}),
                        Planar()),
      IsError(StatusCode::kDataLoss, "STORE_CORRUPT", HasSubstr("batch")));
}

// ---- Revisions

BatchRecord Stored(const v1::PoseBatch& batch) {
  BatchRecord record;
  record.first_sequence = batch.poses(0).sequence();
  record.count = static_cast<std::uint32_t>(batch.poses_size());
  record.payload = batch.SerializeAsString();
  return record;
}

v1::PoseBatch Revised(const v1::PoseBatch& stored, const v1::Pose& revised,
                      const VehicleConfig& config,
                      RevisedStarts starts = RevisedStarts::kStay) {
  const auto record =
      ReviseBatch(Stored(stored), config, starts, [&](std::uint64_t sequence) {
        return sequence == revised.sequence()
                   ? std::make_optional(PoseFieldsOf(revised))
                   : std::nullopt;
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
  const auto record =
      ReviseBatch(Stored(SomePoses()), Planar(), RevisedStarts::kStay,
                  [](std::uint64_t) { return std::nullopt; });
  ASSERT_THAT(record, IsOk());
  EXPECT_FALSE(record->has_value());
}

// A pose that begins a recording, with this label.
v1::Pose Beginning(std::uint64_t sequence, const std::string& label) {
  v1::Pose pose = PlanarPose(sequence, 0);
  pose.mutable_recording_start()->set_label(label);
  return pose;
}

TEST(ReviseBatchTest, KeepsTheStartsOfRecordings) {
  v1::PoseBatch stored;
  *stored.add_poses() = Beginning(7, "stored");
  *stored.add_poses() = PlanarPose(8, 0);
  EXPECT_EQ(Revised(stored, Beginning(7, "other"), Planar())
                .poses(0)
                .recording_start()
                .label(),
            "stored");
  EXPECT_FALSE(Revised(stored, Beginning(8, "other"), Planar())
                   .poses(1)
                   .has_recording_start());
}

TEST(ReviseBatchTest, LeavesTheFirstStartAloneInACommonFrame) {
  v1::PoseBatch stored;
  for (std::uint64_t i = 1; i <= 2; ++i) {
    *stored.add_poses() = Beginning(i, "stored");
  }
  const auto first =
      Revised(stored, PlanarPose(1, 3), Planar(), RevisedStarts::kFirst);
  EXPECT_EQ(first.poses(0).recording_start().label(), "stored");
  const auto second =
      Revised(stored, PlanarPose(2, 3), Planar(), RevisedStarts::kFirst);
  EXPECT_FALSE(second.poses(1).has_recording_start());
  EXPECT_EQ(second.poses(1).local().x_meters(), 3);
}

TEST(ReviseBatchTest, ErrorsOfAFormerStartStayIndependentInACommonFrame) {
  const VehicleConfig config = Filter(Planar());
  v1::PoseBatch stored;
  *stored.add_poses() = Beginning(2, "stored");
  v1::Pose revision = PlanarPose(2, 3);
  const auto without = Revised(stored, revision, config, RevisedStarts::kFirst);
  EXPECT_FALSE(without.poses(0).has_recording_start());
  const auto read =
      ProtoRecordCodec().DecodePoses(without.SerializeAsString(), config);
  ASSERT_THAT(read, IsOk());
  EXPECT_THAT(without.poses(0).error_transition(), SizeIs(9));
  EXPECT_THAT(without.poses(0).error_transition(), ::testing::Each(0.0));
  for (int i = 0; i < 9; ++i) revision.add_error_transition(0.5);
  EXPECT_THAT(Revised(stored, revision, config, RevisedStarts::kFirst)
                  .poses(0)
                  .error_transition(),
              ::testing::Each(0.5));
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

// Unturned, the transition would be taken for one in the axes of the local
// frame.
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
      codec.DecodePoses(stored.SerializeAsString(), config).value();
  const v1::PoseBatch batch = Revised(stored, PlanarPose(2, 5), config);
  const auto after = codec.DecodePoses(batch.SerializeAsString(), config);
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

// ---- The API and the store

// Puts a field that this version does not know into the message and all that it
// holds.
void AddUnknownFields(google::protobuf::Message* message) {
  const google::protobuf::Reflection& reflection = *message->GetReflection();
  reflection.MutableUnknownFields(message)->AddLengthDelimited(900, "new");
  std::vector<const google::protobuf::FieldDescriptor*> fields;
  reflection.ListFields(*message, &fields);
  for (const auto* field : fields) {
    if (field->message_type() == nullptr || field->is_repeated()) continue;
    AddUnknownFields(reflection.MutableMessage(message, field));
  }
}

TEST(RecordIndependenceTest, StoredMessagesUseNoneOfTheApi) {
  const auto* const file = stored::Vehicle::descriptor()->file();
  for (int i = 0; i < file->dependency_count(); ++i) {
    EXPECT_THAT(std::string(file->dependency(i)->name()),
                StartsWith("google/protobuf/"));
  }
}

TEST(RecordIndependenceTest, NewFieldsOfPosesDoNotReachTheRecord) {
  v1::Pose local = PlanarPose(2, 1.5);
  local.mutable_stamp()->set_seconds(7);
  local.mutable_quaternion()->set_w(1.0);
  *local.mutable_recording_start() = FromText<v1::RecordingStart>(R"pb(
    datum {
      pose { x_meters: 1 }
      covariance {
        form: COVARIANCE_FORM_PLANAR_6
        values: [ 1, 0, 0, 1, 0, 1 ]
      }
    }
  )pb");
  v1::Pose geodetic = GeodeticPose(1, 43.8, -79.5, 150.0);
  for (const auto& [pose, config] :
       {std::pair(local, Planar()), std::pair(geodetic, Geodetic(Planar()))}) {
    v1::Pose extended = pose;
    AddUnknownFields(&extended);
    ASSERT_NE(extended.SerializeAsString(), pose.SerializeAsString());
    const auto plain = DecodeAll({pose}, config);
    const auto batch = DecodeAll({extended}, config);
    ASSERT_THAT(plain, IsOk());
    ASSERT_THAT(batch, IsOk());
    EXPECT_EQ(batch->payload, plain->payload);
  }
}

TEST(RecordIndependenceTest, NewFieldsOfRevisedPosesDoNotReachTheRecord) {
  v1::Pose revision = PlanarPose(3, 33);
  const std::string plain =
      Revised(SomePoses(), revision, Planar()).SerializeAsString();
  AddUnknownFields(&revision);
  EXPECT_EQ(Revised(SomePoses(), revision, Planar()).SerializeAsString(),
            plain);
}

// A setting that is not stored would be lost on the next start.
TEST(RecordIndependenceTest, EverySettingOfTheApiIsStored) {
  const auto* const settings = v1::VehicleSettings::descriptor();
  for (int i = 0; i < settings->field_count(); ++i) {
    const auto* const field = settings->field(i);
    const auto* const stored =
        stored::VehicleSettings::descriptor()->FindFieldByName(field->name());
    ASSERT_NE(stored, nullptr) << field->name();
    EXPECT_EQ(stored->type(), field->type()) << field->name();
  }
}

// A column that is not stored would be lost without a word.
TEST(RecordIndependenceTest, EveryColumnOfTheApiIsStored) {
  const auto* const columns = v1::PoseColumns::descriptor();
  ASSERT_EQ(stored::PoseColumns::descriptor()->field_count(),
            columns->field_count());
  for (int i = 0; i < columns->field_count(); ++i) {
    const auto* const field = columns->field(i);
    const auto* const stored =
        stored::PoseColumns::descriptor()->FindFieldByName(field->name());
    ASSERT_NE(stored, nullptr) << field->name();
    EXPECT_EQ(stored->number(), field->number()) << field->name();
    EXPECT_EQ(stored->type(), field->type()) << field->name();
  }
}

// The table of settings has one name for both messages, and stores that were
// written by its numbers have to read the same.
TEST(RecordIndependenceTest, EnumsOfSettingsHaveTheNumbersOfTheApi) {
  const auto* const settings = stored::VehicleSettings::descriptor();
  for (int i = 0; i < settings->field_count(); ++i) {
    const auto* const stored = settings->field(i)->enum_type();
    if (stored == nullptr) continue;
    const auto* const api = v1::VehicleSettings::descriptor()
                                ->FindFieldByName(settings->field(i)->name())
                                ->enum_type();
    ASSERT_EQ(stored->value_count(), api->value_count()) << stored->name();
    for (int v = 0; v < stored->value_count(); ++v) {
      const auto* const value = api->FindValueByName(stored->value(v)->name());
      ASSERT_NE(value, nullptr) << stored->value(v)->name();
      EXPECT_EQ(value->number(), stored->value(v)->number());
    }
  }
}

}  // namespace
}  // namespace revisit::server
