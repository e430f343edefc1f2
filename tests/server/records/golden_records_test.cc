// Stores last for years: every later server must read these bytes as the same
// vehicles and poses. The first ones were written by servers that stored the
// messages of the API themselves.
//
// A server also writes them again to the bit. A new setting is the exception,
// for the settings of a vehicle are all written, each time. Then EverySetting()
// moves it off its default, the present rows of GoldenVehicles() are marked as
// no longer written and get the default back, and the bytes that the new server
// writes come beside them as new rows. A new field of poses changes no row: it
// is not written where it was not sent. It gets a row of its own.
#include <algorithm>
#include <cstdint>
#include <cstdio>
#include <string>
#include <vector>

#include "core/drive/dropped_stretch.h"
#include "core/settings.h"
#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "revisit/v1/geometry.pb.h"
#include "server/conversion/pose_pairs.h"
#include "server/conversion/vehicle_settings.h"
#include "server/fields/pose_fields.h"
#include "server/records/batch_records.h"
#include "server/records/check_records.h"
#include "server/records/group_content.h"
#include "server/records/pair_content.h"
#include "server/records/proto_record_codec.h"
#include "tests/server/conversion/conversion_testing.h"
#include "tests/server/error_matchers.h"

namespace revisit::server {
namespace {

using ::testing::ElementsAreArray;
using ::testing::HasSubstr;

std::string Hex(const std::string& bytes) {
  std::string hex;
  for (const char c : bytes) {
    char text[3];
    std::snprintf(text, sizeof(text), "%02x", static_cast<unsigned char>(c));
    hex += text;
  }
  return hex;
}

std::string Bytes(const std::string& hex) {
  std::string bytes;
  for (std::size_t i = 0; i < hex.size(); i += 2) {
    bytes += static_cast<char>(std::stoi(hex.substr(i, 2), nullptr, 16));
  }
  return bytes;
}

// A vehicle whose settings all differ from their defaults.
VehicleConfig EverySetting() {
  VehicleConfig config;
  config.uid = "0f0e0d0c-0b0a-4908-8706-050403020100";
  config.frame = CoordinateFrame::kGeodetic;
  config.origin = GeodeticOrigin{-33.5, 151.25, 7.0};
  config.create_time_ns = -1234567890123456789;
  config.data_loss = true;
  core::DriveSettings& drive = config.drive;
  drive.state_space = core::StateSpace::kSpatial;
  drive.node_spacing_meters = 3.0;
  drive.check_interval_meters = 12.0;
  drive.max_step_meters = 50.0;
  drive.apply_inflation = true;
  drive.max_inflation = 4.0;
  core::SearchOptions& search = drive.search;
  search.correlation_model = core::CorrelationModel::kIndependent;
  search.likelihood_form = core::LikelihoodForm::kAsPrinted;
  search.sequence_length_meters = 99.0;
  search.gate_probability = 0.5;
  search.place_tolerance = {0.0, 0.25};
  search.candidate_separation_meters = 0.0;
  search.max_candidates = 17;
  search.alignment = core::AlignmentKind::kComposite;
  search.acceptance_probability = 0.75;
  search.road_spacing_meters = 80.0;
  search.shape.tolerance = {0.5, 0.03};
  search.shape.correlation_meters = 25.0;
  search.use_belief = false;
  search.fix_correlation_meters = 40.0;
  config.checks = ChecksKept::kStored;
  config.keep_probability = 0.25;
  return config;
}

// A vehicle whose switches and enums differ from those of EverySetting().
VehicleConfig OtherSettings() {
  VehicleConfig config = EverySetting();
  config.frame = CoordinateFrame::kLocal;
  config.origin.reset();
  config.create_time_ns = 1700000000000000001;
  config.data_loss = false;
  config.checks = ChecksKept::kOnRequest;
  config.drive.state_space = core::StateSpace::kPlanar;
  config.drive.apply_inflation = false;
  core::SearchOptions& search = config.drive.search;
  search.correlation_model = core::CorrelationModel::kFilter;
  search.likelihood_form = core::LikelihoodForm::kGaussian;
  search.alignment = core::AlignmentKind::kRelative;
  search.use_belief = true;
  return config;
}

// As it is read where the record has no stored checks.
VehicleConfig BeforeChecks(VehicleConfig config) {
  config.checks = VehicleConfig().checks;
  config.keep_probability = VehicleConfig().keep_probability;
  return config;
}

// As it is read where the record has neither beliefs nor correlated fixes.
VehicleConfig BeforeBeliefs(VehicleConfig config) {
  config = BeforeChecks(std::move(config));
  const core::SearchOptions defaults;
  config.drive.search.use_belief = defaults.use_belief;
  config.drive.search.fix_correlation_meters = defaults.fix_correlation_meters;
  return config;
}

VehicleConfig Labelled(VehicleConfig config) {
  config.display_name = "Truck 7";
  config.labels = {{"session.a", "1-2068"}, {"fleet", "north"}};
  return config;
}

v1::Pose Stamped(v1::Pose pose, std::int64_t seconds, std::int32_t nanos) {
  pose.mutable_stamp()->set_seconds(seconds);
  pose.mutable_stamp()->set_nanos(nanos);
  return pose;
}

v1::Pose Turned(v1::Pose pose) {
  pose.mutable_quaternion()->set_x(-0.0);
  pose.mutable_quaternion()->set_z(0.6);
  pose.mutable_quaternion()->set_w(0.8);
  return pose;
}

struct GoldenBatch {
  const char* name;
  VehicleConfig config;
  std::vector<v1::Pose> poses;
  std::string hex;
  std::vector<std::uint64_t> fingerprints;
};

struct GoldenVehicle {
  VehicleConfig config;
  std::string hex;
  // False for bytes that only earlier servers wrote.
  bool is_written = true;
};

std::vector<GoldenVehicle> GoldenVehicles() {
  return {{EverySetting(),
           "12c30108021002180220022a1b090000000000c040c0110000000000e8624019"
           "0000000000001c40310000000000000840390000000000c05840410000000000"
           "00284049000000000000494051000000000000e03f5a0911000000000000d03f"
           "6100000000000000006811700279000000000000e83f81010000000000005440"
           "8a011209000000000000e03f11b81e85eb51b89e3f9101000000000000394098"
           "0101a1010000000000001040a80100b1010000000000004440c00102c9010000"
           "00000000d03f1802221108adfaa7b3fbffffffff0110ebf9fba1035a24306630"
           "65306430632d306230612d343930382d383730362d3035303430333032303130"
           "30"},
          {OtherSettings(),
           "12a6010801100318012001310000000000000840390000000000c05840410000"
           "00000000284049000000000000494051000000000000e03f5a09110000000000"
           "00d03f6100000000000000006811700179000000000000e83f81010000000000"
           "0054408a011209000000000000e03f11b81e85eb51b89e3f9101000000000000"
           "3940980100a1010000000000001040a80101b1010000000000004440c00101c9"
           "01000000000000d03f180122080880e2cfaa0610015a2430663065306430632d"
           "306230612d343930382d383730362d303530343033303230313030"},
          {Labelled(OtherSettings()),
           "12a6010801100318012001310000000000000840390000000000c05840410000"
           "00000000284049000000000000494051000000000000e03f5a09110000000000"
           "00d03f6100000000000000006811700179000000000000e83f81010000000000"
           "0054408a011209000000000000e03f11b81e85eb51b89e3f9101000000000000"
           "3940980100a1010000000000001040a80101b1010000000000004440c00101c9"
           "01000000000000d03f180122080880e2cfaa0610015a2430663065306430632d"
           "306230612d343930382d383730362d3035303430333032303130306207547275"
           "636b20376a0e0a05666c65657412056e6f7274686a130a0973657373696f6e2e"
           "611206312d32303638"},
          // From before checks were stored.
          {BeforeChecks(EverySetting()),
           "12b60108021002180220022a1b090000000000c040c0110000000000e8624019"
           "0000000000001c40310000000000000840390000000000c05840410000000000"
           "00284049000000000000494051000000000000e03f5a0911000000000000d03f"
           "6100000000000000006811700279000000000000e83f81010000000000005440"
           "8a011209000000000000e03f11b81e85eb51b89e3f9101000000000000394098"
           "0101a1010000000000001040a80100b10100000000000044401802221108adfa"
           "a7b3fbffffffff0110ebf9fba1035a2430663065306430632d306230612d3439"
           "30382d383730362d303530343033303230313030",
           /*is_written=*/false},
          {BeforeChecks(OtherSettings()),
           "1299010801100318012001310000000000000840390000000000c05840410000"
           "00000000284049000000000000494051000000000000e03f5a09110000000000"
           "00d03f6100000000000000006811700179000000000000e83f81010000000000"
           "0054408a011209000000000000e03f11b81e85eb51b89e3f9101000000000000"
           "3940980100a1010000000000001040a80101b101000000000000444018012208"
           "0880e2cfaa0610015a2430663065306430632d306230612d343930382d383730"
           "362d303530343033303230313030",
           /*is_written=*/false},
          {BeforeChecks(Labelled(OtherSettings())),
           "1299010801100318012001310000000000000840390000000000c05840410000"
           "00000000284049000000000000494051000000000000e03f5a09110000000000"
           "00d03f6100000000000000006811700179000000000000e83f81010000000000"
           "0054408a011209000000000000e03f11b81e85eb51b89e3f9101000000000000"
           "3940980100a1010000000000001040a80101b101000000000000444018012208"
           "0880e2cfaa0610015a2430663065306430632d306230612d343930382d383730"
           "362d3035303430333032303130306207547275636b20376a0e0a05666c656574"
           "12056e6f7274686a130a0973657373696f6e2e611206312d32303638",
           /*is_written=*/false},
          // From before there were beliefs.
          {BeforeBeliefs(EverySetting()),
           "12a90108021002180220022a1b090000000000c040c0110000000000e8624019"
           "0000000000001c40310000000000000840390000000000c05840410000000000"
           "00284049000000000000494051000000000000e03f5a0911000000000000d03f"
           "6100000000000000006811700279000000000000e83f81010000000000005440"
           "8a011209000000000000e03f11b81e85eb51b89e3f9101000000000000394098"
           "0101a10100000000000010401802221108adfaa7b3fbffffffff0110ebf9fba1"
           "035a2430663065306430632d306230612d343930382d383730362d3035303430"
           "33303230313030",
           /*is_written=*/false},
          {BeforeBeliefs(OtherSettings()),
           "128c010801100318012001310000000000000840390000000000c05840410000"
           "00000000284049000000000000494051000000000000e03f5a09110000000000"
           "00d03f6100000000000000006811700179000000000000e83f81010000000000"
           "0054408a011209000000000000e03f11b81e85eb51b89e3f9101000000000000"
           "3940980100a1010000000000001040180122080880e2cfaa0610015a24306630"
           "65306430632d306230612d343930382d383730362d3035303430333032303130"
           "30",
           /*is_written=*/false},
          {BeforeBeliefs(Labelled(OtherSettings())),
           "128c010801100318012001310000000000000840390000000000c05840410000"
           "00000000284049000000000000494051000000000000e03f5a09110000000000"
           "00d03f6100000000000000006811700179000000000000e83f81010000000000"
           "0054408a011209000000000000e03f11b81e85eb51b89e3f9101000000000000"
           "3940980100a1010000000000001040180122080880e2cfaa0610015a24306630"
           "65306430632d306230612d343930382d383730362d3035303430333032303130"
           "306207547275636b20376a0e0a05666c65657412056e6f7274686a130a097365"
           "7373696f6e2e611206312d32303638",
           /*is_written=*/false}};
}

std::vector<GoldenBatch> GoldenBatches() {
  v1::Pose spatial = Turned(PlanarPose(7, 1e-300));
  spatial.mutable_local()->set_y_meters(-2.5);
  spatial.mutable_local()->set_z_meters(-0.0);
  SetCovariance(v1::COVARIANCE_FORM_SPATIAL_10,
                {4.0, 0.1, 0.7, 0.2, 5.0, 0.8, 0.3, 6.0, 0.4, 0.9}, &spatial);
  v1::Pose ros = PlanarPose(8, 0.0);
  SetCovariance(v1::COVARIANCE_FORM_ROS_36, RosMatrix(), &ros);
  v1::Pose filtered = PlanarPose(std::uint64_t{1} << 40, 3.0);
  for (int i = 1; i <= 9; ++i) filtered.add_error_transition(0.125 * i);
  const v1::Pose geodetic = GeodeticPose(1, 43.8, -79.5, 150.0);
  v1::Pose empty_stamp = GeodeticPose(2, 0.0, 0.0, 0.0);
  empty_stamp.mutable_stamp();
  v1::Pose first = PlanarPose(1, 0.5);
  *first.mutable_recording_start() = FromText<v1::RecordingStart>(R"pb(
    label: "monday.csv"
    datum {
      datum_id: "site"
      pose { x_meters: 10 y_meters: -20 heading_radians: 0.5 }
      covariance {
        form: COVARIANCE_FORM_PLANAR_6
        values: [ 4, 0, 0, 4, 0, 0.01 ]
      }
    }
  )pb");
  v1::Pose after = PlanarPose(2, 1.5);
  *after.mutable_recording_start() = FromText<v1::RecordingStart>(R"pb(
    after {
      form: COVARIANCE_FORM_SPATIAL_10
      values: [ 1, 0, 0, 0, 1, 0, 0, 1, 0, 0.25 ]
    }
  )pb");
  v1::Pose usual = PlanarPose(3, 2.5);
  usual.mutable_recording_start();
  v1::Pose unknown = PlanarPose(4, 3.5);
  unknown.mutable_recording_start()->set_unknown(true);
  return {{"PLANAR_6",
           Planar(),
           {Stamped(PlanarPose(3, 1.5), -2, 5), PlanarPose(4, -1.5)},
           "0a5b0803120d08feffffffffffffffff0110051a0909000000000000f83f2900"
           "0000000000e03f3a340801123000000000000010409a9999999999b93f9a9999"
           "999999c93f0000000000001440333333333333d33fb81e85eb51b8ae3f0a4c08"
           "041a0909000000000000f8bf29000000000000e03f3a34080112300000000000"
           "0010409a9999999999b93f9a9999999999c93f00000000000014403333333333"
           "33d33fb81e85eb51b8ae3f",
           {10703998378078127957u, 7538222111093217260u}},
          {"SPATIAL_10",
           Spatial(),
           {Stamped(spatial, 77, 0), ros},
           "0a960108071202084d1a1b0959f3f8c21f6ea5011100000000000004c0190000"
           "000000000080321b09000000000000008019333333333333e33f219a99999999"
           "99e93f3a540802125000000000000010409a9999999999b93f666666666666e6"
           "3f9a9999999999c93f00000000000014409a9999999999e93f333333333333d3"
           "3f00000000000018409a9999999999d93fcdccccccccccec3f0ab50208081a00"
           "29000000000000e03f3aa502080312a00200000000000024407b14ae47e17a84"
           "3f7b14ae47e17a943fb81e85eb51b89e3f7b14ae47e17aa43f9a9999999999a9"
           "3f7b14ae47e17a843f0000000000002640b81e85eb51b8be3fa4703d0ad7a3c0"
           "3fec51b81e85ebc13f333333333333c33f7b14ae47e17a943fb81e85eb51b8be"
           "3f0000000000002840713d0ad7a370cd3fb81e85eb51b8ce3f000000000000d0"
           "3fb81e85eb51b89e3fa4703d0ad7a3c03f713d0ad7a370cd3f0000000000002a"
           "40c3f5285c8fc2d53f676666666666d63f7b14ae47e17aa43fec51b81e85ebc1"
           "3fb81e85eb51b8ce3fc3f5285c8fc2d53f0000000000002c40cdccccccccccdc"
           "3f9a9999999999a93f333333333333c33f000000000000d03f676666666666d6"
           "3fcdccccccccccdc3f0000000000002e40",
           {6056432767137845136u, 5775154367399520157u}},
          {"ROS_36",
           Planar(),
           {ros},
           "0ab50208081a0029000000000000e03f3aa502080312a0020000000000002440"
           "7b14ae47e17a843f7b14ae47e17a943fb81e85eb51b89e3f7b14ae47e17aa43f"
           "9a9999999999a93f7b14ae47e17a843f0000000000002640b81e85eb51b8be3f"
           "a4703d0ad7a3c03fec51b81e85ebc13f333333333333c33f7b14ae47e17a943f"
           "b81e85eb51b8be3f0000000000002840713d0ad7a370cd3fb81e85eb51b8ce3f"
           "000000000000d03fb81e85eb51b89e3fa4703d0ad7a3c03f713d0ad7a370cd3f"
           "0000000000002a40c3f5285c8fc2d53f676666666666d63f7b14ae47e17aa43f"
           "ec51b81e85ebc13fb81e85eb51b8ce3fc3f5285c8fc2d53f0000000000002c40"
           "cdccccccccccdc3f9a9999999999a93f333333333333c33f000000000000d03f"
           "676666666666d63fcdccccccccccdc3f0000000000002e40",
           {5775154367399520157u}},
          {"FILTER",
           Filter(Planar()),
           {filtered},
           "0a9b01088080808080201a0909000000000000084029000000000000e03f3a34"
           "0801123000000000000010409a9999999999b93f9a9999999999c93f00000000"
           "00001440333333333333d33fb81e85eb51b8ae3f4248000000000000c03f0000"
           "00000000d03f000000000000d83f000000000000e03f000000000000e43f0000"
           "00000000e83f000000000000ec3f000000000000f03f000000000000f23f",
           {3098824795691395320u}},
          {"GEODETIC",
           Geodetic(Planar()),
           {geodetic, empty_stamp},
           "0a5e0801221b096666666666e64540110000000000e053c0190000000000c062"
           "4029000000000000e03f3a340801123000000000000010409a9999999999b93f"
           "9a9999999999c93f0000000000001440333333333333d33fb81e85eb51b8ae3f"
           "0a4508021200220029000000000000e03f3a340801123000000000000010409a"
           "9999999999b93f9a9999999999c93f0000000000001440333333333333d33fb8"
           "1e85eb51b8ae3f",
           {3055343456991013697u, 17912858905553800939u}},
          {"RECORDING_START",
           Planar(),
           {first, after, usual, unknown},
           "0ab50108011a0909000000000000e03f29000000000000e03f3a340801123000"
           "000000000010409a9999999999b93f9a9999999999c93f000000000000144033"
           "3333333333d33fb81e85eb51b8ae3f4a670a0a6d6f6e6461792e6373761a590a"
           "0473697465121b0900000000000024401100000000000034c021000000000000"
           "e03f1a3408011230000000000000104000000000000000000000000000000000"
           "000000000000104000000000000000007b14ae47e17a843f0aa40108021a0909"
           "000000000000f83f29000000000000e03f3a340801123000000000000010409a"
           "9999999999b93f9a9999999999c93f0000000000001440333333333333d33fb8"
           "1e85eb51b8ae3f4a56125408021250000000000000f03f000000000000000000"
           "000000000000000000000000000000000000000000f03f000000000000000000"
           "00000000000000000000000000f03f0000000000000000000000000000d03f0a"
           "4e08031a0909000000000000044029000000000000e03f3a3408011230000000"
           "00000010409a9999999999b93f9a9999999999c93f0000000000001440333333"
           "333333d33fb81e85eb51b8ae3f4a000a5008041a09090000000000000c402900"
           "0000000000e03f3a340801123000000000000010409a9999999999b93f9a9999"
           "999999c93f0000000000001440333333333333d33fb81e85eb51b8ae3f4a0220"
           "01",
           {4938006121568384767u, 988293178199026290u, 3068766054998282922u,
            12518580020342867793u}}};
}

TEST(GoldenRecordTest, VehiclesAreWrittenAsEver) {
  int written = 0;
  for (const GoldenVehicle& golden : GoldenVehicles()) {
    if (!golden.is_written) continue;
    ++written;
    EXPECT_EQ(Hex(ProtoRecordCodec().EncodeVehicle(golden.config)), golden.hex);
  }
  EXPECT_GE(written, 2);
}

TEST(GoldenRecordTest, VehiclesAreReadAsEver) {
  const ProtoRecordCodec codec;
  for (const GoldenVehicle& golden : GoldenVehicles()) {
    const auto config = codec.DecodeVehicle(RecordOf(Bytes(golden.hex)));
    ASSERT_THAT(config, IsOk());
    EXPECT_TRUE(SameSettings(*config, golden.config));
    EXPECT_EQ(config->uid, golden.config.uid);
    EXPECT_EQ(config->create_time_ns, golden.config.create_time_ns);
    EXPECT_EQ(config->data_loss, golden.config.data_loss);
    EXPECT_EQ(config->display_name, golden.config.display_name);
    EXPECT_EQ(config->labels, golden.config.labels);
  }
}

// A check and events with every field.
StoredCheck GoldenCheck() {
  StoredCheck check;
  check.vehicle_uid = "uid";
  check.found = "found";
  StoredCandidate& confirmed = check.candidates.emplace_back();
  confirmed.number = 1;
  confirmed.rank = 2;
  confirmed.matched_sequence = 3;
  confirmed.state = CandidateState::kConfirmed;
  confirmed.cause = CandidateCause::kLoopClosure;
  confirmed.actor = "token:bob";
  confirmed.update_time_ns = -1234567890123456789;
  confirmed.decision = "link";
  confirmed.event_number = 4;
  StoredCandidate& withdrawn = check.candidates.emplace_back();
  withdrawn.number = 2;
  withdrawn.rank = 3;
  withdrawn.matched_sequence = 4;
  withdrawn.state = CandidateState::kWithdrawn;
  withdrawn.cause = CandidateCause::kRetention;
  withdrawn.update_time_ns = 5;
  withdrawn.event_number = 6;
  return check;
}

// A check that was searched again, which has what others have not.
StoredCheck GoldenSecondCheck() {
  StoredCheck check;
  check.vehicle_uid = "uid";
  check.found = "found";
  check.latest = "latest";
  check.basis = 0x1122334455667788;
  check.stale = true;
  StoredCandidate& late = check.candidates.emplace_back();
  late.number = 1;
  late.latest_rank = 2;
  late.matched_sequence = 3;
  late.cause = CandidateCause::kContradiction;
  late.update_time_ns = 5;
  late.event_number = 6;
  late.probability = 0.75;
  late.value = 2.5;
  late.contradicted = "link";
  return check;
}

constexpr char kGoldenCheck[] =
    "0a05666f756e641230080110021803200228023209746f6b656e3a626f623a11"
    "08adfaa7b3fbffffffff0110ebf9fba10342046c696e6b480412100802100318"
    "04200428053a02100548061a03756964";
constexpr char kGoldenSecondCheck[] =
    "0a05666f756e64122808011803200128073a0210054806500259000000000000"
    "e83f6100000000000004406a046c696e6b1a0375696422066c61746573742988"
    "776655443322113001";
// The same of a place in the history of another vehicle.
constexpr char kGoldenGroupCheck[] =
    "0a05666f756e64123d08011803200128073a0210054806500259000000000000"
    "e83f6100000000000004406a046c696e6b720376616e7a017580010288010492"
    "0104736974651a0375696422066c61746573742988776655443322113001";
constexpr char kGoldenEvent[] =
    "0a05747275636b12037569641a4008071230080110021803200228023209746f"
    "6b656e3a626f623a1108adfaa7b3fbffffffff0110ebf9fba10342046c696e6b"
    "48041a0865766964656e63652008";
constexpr char kGoldenGroupEvent[] =
    "0a05747275636b12037569641a4d0807123d08011803200128073a0210054806"
    "500259000000000000e83f6100000000000004406a046c696e6b720376616e7a"
    "0175800102880104920104736974651a0865766964656e63652008";
constexpr char kGoldenFarewell[] = "0a05747275636b12037569642200";

TEST(GoldenRecordTest, ChecksAndEventsAreWrittenAsEver) {
  EXPECT_EQ(Hex(EncodeCheckRecord(GoldenCheck())), kGoldenCheck);
  EXPECT_EQ(Hex(EncodeCheckRecord(GoldenSecondCheck())), kGoldenSecondCheck);
  StoredEvent event{"truck", "uid", GoldenCheck().candidates[0],
                    7,       8,     "evidence"};
  EXPECT_EQ(Hex(EncodeEventRecord(event)), kGoldenEvent);
  event.candidate.reset();
  EXPECT_EQ(Hex(EncodeEventRecord(event)), kGoldenFarewell);
}

TEST(GoldenRecordTest, PlacesInOtherVehiclesAreWrittenAndReadAsEver) {
  StoredCheck check = GoldenSecondCheck();
  check.candidates[0].matched_vehicle = "van";
  check.candidates[0].matched_uid = "u";
  check.candidates[0].place_first = 2;
  check.candidates[0].place_last = 4;
  check.candidates[0].group = "site";
  EXPECT_EQ(Hex(EncodeCheckRecord(check)), kGoldenGroupCheck);
  const StoredEvent event{"truck", "uid", check.candidates[0],
                          7,       8,     "evidence"};
  EXPECT_EQ(Hex(EncodeEventRecord(event)), kGoldenGroupEvent);
  const auto told = DecodeEventRecord(Bytes(kGoldenGroupEvent));
  ASSERT_THAT(told, IsOk());
  EXPECT_EQ(told->candidate->group, "site");
  const auto read = DecodeCheckRecord(Bytes(kGoldenGroupCheck));
  ASSERT_THAT(read, IsOk());
  EXPECT_EQ(read->candidates.at(0).matched_vehicle, "van");
  EXPECT_EQ(read->candidates.at(0).matched_uid, "u");
  EXPECT_EQ(read->candidates.at(0).place_first, 2u);
  EXPECT_EQ(read->candidates.at(0).place_last, 4u);
  EXPECT_EQ(read->candidates.at(0).group, "site");
  EXPECT_FALSE(read->candidates.at(0).is_own());
  EXPECT_TRUE(
      DecodeCheckRecord(Bytes(kGoldenCheck))->candidates.at(0).is_own());
}

TEST(GoldenRecordTest, ChecksThatWereSearchedAgainAreReadAsEver) {
  const auto check = DecodeCheckRecord(Bytes(kGoldenSecondCheck));
  ASSERT_THAT(check, IsOk());
  EXPECT_EQ(check->latest, "latest");
  EXPECT_EQ(check->basis, 0x1122334455667788u);
  EXPECT_TRUE(check->stale);
  ASSERT_EQ(check->candidates.size(), 1u);
  const StoredCandidate& candidate = check->candidates[0];
  EXPECT_EQ(candidate.rank, 0);
  EXPECT_EQ(candidate.latest_rank, 2);
  EXPECT_EQ(candidate.cause, CandidateCause::kContradiction);
  EXPECT_EQ(candidate.probability, 0.75);
  EXPECT_EQ(candidate.value, 2.5);
  EXPECT_EQ(candidate.contradicted, "link");
  // One from before there were second searches.
  const auto first = DecodeCheckRecord(Bytes(kGoldenCheck));
  ASSERT_THAT(first, IsOk());
  EXPECT_EQ(first->latest, "");
  EXPECT_EQ(first->basis, 0u);
  EXPECT_FALSE(first->stale);
}

TEST(GoldenRecordTest, ChecksAndEventsAreReadAsEver) {
  const auto check = DecodeCheckRecord(Bytes(kGoldenCheck));
  ASSERT_THAT(check, IsOk());
  EXPECT_EQ(check->vehicle_uid, "uid");
  EXPECT_EQ(check->found, "found");
  ASSERT_EQ(check->candidates.size(), 2u);
  const StoredCandidate& candidate = check->candidates[0];
  EXPECT_EQ(candidate.number, 1u);
  EXPECT_EQ(candidate.rank, 2);
  EXPECT_EQ(candidate.matched_sequence, 3u);
  EXPECT_EQ(candidate.state, CandidateState::kConfirmed);
  EXPECT_EQ(candidate.cause, CandidateCause::kLoopClosure);
  EXPECT_EQ(candidate.actor, "token:bob");
  EXPECT_EQ(candidate.update_time_ns, -1234567890123456789);
  EXPECT_EQ(candidate.decision, "link");
  EXPECT_EQ(candidate.event_number, 4u);
  EXPECT_EQ(check->candidates[1].state, CandidateState::kWithdrawn);
  const auto event = DecodeEventRecord(Bytes(kGoldenEvent));
  ASSERT_THAT(event, IsOk());
  EXPECT_EQ(event->vehicle_id, "truck");
  EXPECT_EQ(event->vehicle_uid, "uid");
  ASSERT_TRUE(event->candidate.has_value());
  EXPECT_EQ(event->candidate->decision, "link");
  EXPECT_EQ(event->check_sequence, 7u);
  EXPECT_EQ(event->revision, 8u);
  EXPECT_EQ(event->evidence, "evidence");
  const auto farewell = DecodeEventRecord(Bytes(kGoldenFarewell));
  ASSERT_THAT(farewell, IsOk());
  EXPECT_EQ(farewell->vehicle_uid, "uid");
  EXPECT_FALSE(farewell->candidate.has_value());
}

TEST(GoldenRecordTest, WhatIsNoCheckOrEventIsDamage) {
  for (const std::string& payload :
       {std::string("\xff"), Bytes("120220"), Bytes("12022063")}) {
    EXPECT_THAT(
        DecodeCheckRecord(payload),
        IsError(absl::StatusCode::kDataLoss, "STORE_CORRUPT", ::testing::_))
        << Hex(payload);
  }
  for (const std::string& payload : {std::string("\xff"), std::string()}) {
    EXPECT_THAT(
        DecodeEventRecord(payload),
        IsError(absl::StatusCode::kDataLoss, "STORE_CORRUPT", ::testing::_));
  }
}

TEST(GoldenRecordTest, BatchesAreWrittenAsEver) {
  for (const GoldenBatch& golden : GoldenBatches()) {
    const auto batch = DecodeAll(golden.poses, golden.config);
    ASSERT_THAT(batch, IsOk()) << golden.name;
    EXPECT_EQ(Hex(batch->payload), golden.hex) << golden.name;
  }
}

TEST(GoldenRecordTest, BatchesAreReadAsEver) {
  const ProtoRecordCodec codec;
  for (const GoldenBatch& golden : GoldenBatches()) {
    BatchRecord record;
    record.payload = Bytes(golden.hex);
    const auto batch = codec.DecodePoses(record.payload, golden.config);
    ASSERT_THAT(batch, IsOk()) << golden.name;
    EXPECT_EQ(batch->samples.size(), golden.poses.size()) << golden.name;
    const auto fingerprints = codec.Fingerprints(record.payload);
    ASSERT_THAT(fingerprints, IsOk()) << golden.name;
    EXPECT_THAT(*fingerprints, ElementsAreArray(golden.fingerprints))
        << golden.name;
    std::vector<std::string> visited;
    ASSERT_THAT(VisitPoses(record,
                           [&](const PoseFields& fields) {
                             v1::Pose pose;
                             SetPose(fields, &pose);
                             visited.push_back(pose.SerializeAsString());
                             return true;
                           }),
                IsOk());
    std::vector<std::string> sent;
    for (const v1::Pose& pose : golden.poses) {
      sent.push_back(pose.SerializeAsString());
    }
    EXPECT_EQ(visited, sent) << golden.name;
    const auto slice = codec.SliceBatch(record.payload, 0, golden.poses.size());
    ASSERT_THAT(slice, IsOk()) << golden.name;
    EXPECT_EQ(Hex(*slice), golden.hex) << golden.name;
  }
}

// A batch of columns, and the vehicle that it is of.
struct GoldenColumns {
  const char* name;
  VehicleConfig config;
  v1::PoseColumns columns;
  std::string hex;
};

std::vector<GoldenColumns> AllGoldenColumns() {
  return {
      {"planar", Planar(), FromText<v1::PoseColumns>(R"pb(
         first_sequence: 3
         pose_count: 2
         first_stamp { seconds: -1 nanos: 999999999 }
         stamp_step_nanos: [ -5 ]
         x_meters: [ 1.5, 0 ]
         y_meters: [ 0, -2.5 ]
         z_meters: [ -0.0, 1 ]
         heading_radians: [ 0.5, -0.5 ]
         covariance_form: COVARIANCE_FORM_PLANAR_6
         covariances: [ 4, 0.1, 0.2, 5, 0.3, 0.06 ]
         recording_start { label: "again" unknown: true }
       )pb"),
       "1aa201080310021a1108ffffffffffffffffff0110ff93ebdc032201092a1000"
       "0000000000f83f00000000000000003210000000000000000000000000000004"
       "c03a100000000000000080000000000000f03f5a10000000000000e03f000000"
       "000000e0bf6801723000000000000010409a9999999999b93f9a9999999999c9"
       "3f0000000000001440333333333333d33fb81e85eb51b8ae3f8a01090a056167"
       "61696e2001"},
      {"spatial filter", Filter(Spatial()), FromText<v1::PoseColumns>(R"pb(
         first_sequence: 1
         pose_count: 2
         x_meters: [ 1, 2 ]
         y_meters: [ 0, 0 ]
         quaternions: [ 0, 0, 0.6, 0.8, 0, 0, 0, 1 ]
         covariance_form: COVARIANCE_FORM_SPATIAL_10
         covariance_diagonals: [ 4, 5, 6, 0.5, 4.5, 5.5, 6.5, 0.75 ]
         error_transitions: [ 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1 ]
       )pb"),
       "1ab202080110022a10000000000000f03f000000000000004032100000000000"
       "0000000000000000000000624000000000000000000000000000000000333333"
       "333333e33f9a9999999999e93f00000000000000000000000000000000000000"
       "0000000000000000000000f03f68027a40000000000000104000000000000014"
       "400000000000001840000000000000e03f000000000000124000000000000016"
       "400000000000001a40000000000000e83f82018001000000000000f03f000000"
       "0000000000000000000000000000000000000000000000000000000000000000"
       "000000f03f000000000000000000000000000000000000000000000000000000"
       "0000000000000000000000f03f00000000000000000000000000000000000000"
       "00000000000000000000000000000000000000f03f"},
      {"geodetic", Geodetic(Planar()), FromText<v1::PoseColumns>(R"pb(
         first_sequence: 1
         pose_count: 1
         latitude_degrees: [ 43.8 ]
         longitude_degrees: [ -79.5 ]
         height_meters: [ 150 ]
         heading_radians: [ 0.5 ]
         covariance_form: COVARIANCE_FORM_PLANAR_6
         covariance_diagonals: [ 4, 5, 0.5 ]
       )pb"),
       "1a480801100142086666666666e645404a080000000000e053c0520800000000"
       "00c062405a08000000000000e03f68017a180000000000001040000000000000"
       "1440000000000000e03f"},
  };
}

TEST(GoldenRecordTest, ColumnsAreWrittenAndReadAsEver) {
  const ProtoRecordCodec codec;
  for (const GoldenColumns& golden : AllGoldenColumns()) {
    const Poses none;
    const auto sent = DecodeBatch({&none, &golden.columns}, kMaxPoses,
                                  golden.config, FieldPath());
    ASSERT_THAT(sent, IsOk()) << golden.name;
    EXPECT_EQ(Hex(sent->payload), golden.hex) << golden.name;
    const auto read = codec.DecodePoses(Bytes(golden.hex), golden.config);
    ASSERT_THAT(read, IsOk()) << golden.name;
    ASSERT_EQ(read->samples.size(), sent->samples.size()) << golden.name;
    for (std::size_t i = 0; i < read->samples.size(); ++i) {
      const core::PoseSample& was = sent->samples[i];
      const core::PoseSample& is = read->samples[i];
      EXPECT_EQ(is.sequence, was.sequence);
      EXPECT_EQ(is.stamp_ns, was.stamp_ns);
      EXPECT_EQ(is.pose.x, was.pose.x);
      EXPECT_EQ(is.pose.heading, was.pose.heading);
      EXPECT_EQ(is.covariance.upper, was.covariance.upper);
      EXPECT_EQ(is.transition.has_value(), was.transition.has_value());
    }
    const auto whole =
        codec.SliceBatch(Bytes(golden.hex), 0, read->samples.size());
    ASSERT_THAT(whole, IsOk()) << golden.name;
    EXPECT_EQ(Hex(*whole), golden.hex) << golden.name;
  }
}

TEST(GoldenRecordTest, DroppedPosesAreWrittenAndReadAsEver) {
  const ProtoRecordCodec codec;
  const core::DroppedStretch stretch{5, 104, 321.5, std::nullopt};
  const std::string hex = "120d08051068190000000000187440";
  EXPECT_EQ(Hex(codec.EncodeDropped(stretch)), hex);
  const auto read = codec.DecodePoses(Bytes(hex), VehicleConfig());
  ASSERT_THAT(read, IsOk());
  ASSERT_TRUE(read->dropped);
  EXPECT_EQ(read->dropped->first_sequence, 5u);
  EXPECT_EQ(read->dropped->last_sequence, 104u);
  EXPECT_EQ(read->dropped->travelled_meters, 321.5);
}

TEST(GoldenRecordTest, WhatAVehicleKeepsIsWrittenAndReadAsEver) {
  const ProtoRecordCodec codec;
  VehicleConfig config = EverySetting();
  config.drive.retention = {77'000'000'005, 3};
  const std::string payload = codec.EncodeVehicle(config);
  EXPECT_THAT(Hex(payload), HasSubstr("ba01080a04084d10051003"));
  const auto read = codec.DecodeVehicle(RecordOf(payload));
  ASSERT_THAT(read, IsOk());
  EXPECT_EQ(read->drive.retention.max_age_ns, 77'000'000'005);
  EXPECT_EQ(read->drive.retention.max_passes, 3);
}

TEST(GoldenRecordTest, LoopClosuresAreWrittenAndReadAsEver) {
  const auto closure = FromText<v1::LoopClosure>(R"pb(
    query_sequence: 9
    matched_sequence: 3
    measurement {
      x_meters: 1.5
      y_meters: -2
      z_meters: 0.25
      heading_radians: 3
      covariance {
        form: COVARIANCE_FORM_PLANAR_6
        values: [ 4, 0.1, 0.2, 5, 0.3, 0.06 ]
      }
    }
    note: "icp\n412"
    score: -0.5
  )pb");
  const auto record = DecodePosePair(&closure, "", "");
  ASSERT_THAT(record.status(), IsOk());
  EXPECT_EQ(
      Hex(record->payload),
      "0a5a09000000000000f83f1100000000000000c019000000000000d03f2100000000"
      "000008402a340801123000000000000010409a9999999999b93f9a9999999999c93f"
      "0000000000001440333333333333d33fb81e85eb51b8ae3f12076963700a34313219"
      "000000000000e0bf");
  v1::LoopClosure answer;
  EncodePosePair("v", *record, &answer);
  answer.clear_name();
  answer.clear_create_time();
  EXPECT_EQ(answer.SerializeAsString(), closure.SerializeAsString());
}

TEST(GoldenRecordTest, RejectedCandidatesAreWrittenAndReadAsEver) {
  const auto rejection = FromText<v1::RejectedCandidate>(
      R"pb(query_sequence: 9 matched_sequence: 3 note: "bridge")pb");
  const auto record = DecodePosePair(&rejection, "", "");
  ASSERT_THAT(record.status(), IsOk());
  EXPECT_EQ(Hex(record->payload), "1206627269646765");
  v1::RejectedCandidate answer;
  EncodePosePair("v", *record, &answer);
  EXPECT_EQ(answer.note(), "bridge");
  EXPECT_EQ(answer.decided_by(), "");
  const auto decided = DecodePosePair(&rejection, "", "token:eva");
  ASSERT_THAT(decided.status(), IsOk());
  EXPECT_EQ(Hex(decided->payload),
            "1206627269646765"
            "2209746f6b656e3a657661");
  EncodePosePair("v", *decided, &answer);
  EXPECT_EQ(answer.decided_by(), "token:eva");
  EXPECT_EQ(Hex(PairContentWithDeleter(decided->payload, "token:tom")),
            "1206627269646765"
            "2209746f6b656e3a657661"
            "2a09746f6b656e3a746f6d");
  // Records from before there were notes have no payload.
  EncodePosePair("v", {"9-3", 9, 3, 0, ""}, &answer);
  EXPECT_EQ(answer.note(), "");
}

constexpr char kGoldenGroup[] =
    "0a054e6967687412260a1b090000000000c040c0110000000000e86240190000000000"
    "001c4011000000000000f83f1a080880e2cfaa061001";
constexpr char kGoldenMember[] =
    "0a590a0473697465121b0900000000000024401100000000000034c021000000000000"
    "e03f1a3408011230000000000000f03f00000000000000000000000000000000000000"
    "000000f03f0000000000000000000000000000d03f";
constexpr char kGoldenLink[] =
    "0a19120369637019000000000000e0bf2209746f6b656e3a65766112080880e2cfaa06"
    "1001";

TEST(GoldenRecordTest, GroupsAreWrittenAndReadAsEver) {
  GroupContent content;
  content.display_name = "Night";
  content.settings = {GeodeticOrigin{-33.5, 151.25, 7.0}, 1.5};
  content.create_time_ns = 1700000000000000001;
  EXPECT_EQ(Hex(EncodeGroupContent(content)), kGoldenGroup);
  const auto read = DecodeGroupContent(Bytes(kGoldenGroup));
  ASSERT_THAT(read, IsOk());
  EXPECT_EQ(read->display_name, content.display_name);
  EXPECT_EQ(read->settings, content.settings);
  EXPECT_EQ(read->create_time_ns, content.create_time_ns);
}

TEST(GoldenRecordTest, MembersOfGroupsAreWrittenAndReadAsEver) {
  const auto datum = FromText<v1::Datum>(R"pb(
    datum_id: "site"
    pose { x_meters: 10 y_meters: -20 heading_radians: 0.5 }
    covariance {
      form: COVARIANCE_FORM_PLANAR_6
      values: [ 1, 0, 0, 1, 0, 0.25 ]
    }
  )pb");
  const RecordingStartFields fields = DatumFieldsOf(datum);
  EXPECT_EQ(Hex(EncodeMemberContent(&fields)), kGoldenMember);
  v1::Datum read;
  EXPECT_THAT(ReadMemberContent(Bytes(kGoldenMember),
                                [&](const RecordingStartFields* stored) {
                                  ASSERT_NE(stored, nullptr);
                                  SetDatum(*stored, &read);
                                }),
              IsOk());
  EXPECT_EQ(read.SerializeAsString(), datum.SerializeAsString());
}

TEST(GoldenRecordTest, LinksOfGroupsAreWrittenAndReadAsEver) {
  LinkContent link;
  link.content.note = "icp";
  link.content.score = -0.5;
  link.content.decided_by = "token:eva";
  link.create_time_ns = 1700000000000000001;
  EXPECT_EQ(Hex(EncodeLinkContent(link)), kGoldenLink);
  EXPECT_THAT(ReadLinkContent(Bytes(kGoldenLink),
                              [&](const LinkContent& read) {
                                EXPECT_EQ(read.content.note, "icp");
                                EXPECT_EQ(read.content.score, -0.5);
                                EXPECT_EQ(read.content.decided_by, "token:eva");
                                EXPECT_EQ(read.create_time_ns,
                                          link.create_time_ns);
                              }),
              IsOk());
}

}  // namespace
}  // namespace revisit::server
