#include "server/fleet/joined_group.h"

#include <cstdint>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "core/drive/drive.h"
#include "core/drive/dropped_stretch.h"
#include "core/drive/pose_graph.h"
#include "core/settings.h"
#include "google/protobuf/repeated_field.h"
#include "gtest/gtest.h"
#include "server/records/group_content.h"

namespace revisit::server {
namespace {

using core::FrameState;

std::string DatumAt(double x) {
  const std::string empty;
  google::protobuf::RepeatedField<double> values;
  for (const double value : {9.0, 0.0, 0.0, 9.0, 0.0, 0.01}) values.Add(value);
  RecordingStartFields fields;
  fields.label = &empty;
  fields.relation = RecordingStartFields::Relation::kDatum;
  fields.covariance = CovarianceFields{CovarianceForm::kPlanar6, values};
  fields.datum_id = &empty;
  fields.datum_pose = {x, 0.0, 0.0, 0.0};
  return EncodeMemberContent(&fields);
}

// A group of vehicles 1, 2, ... which have driven 100 m straight on.
class JoinGroupTest : public ::testing::Test {
 protected:
  // With fixes, if it has a latitude.
  void Add(const std::string& datum,
           std::optional<double> latitude = std::nullopt) {
    const auto key = static_cast<VehicleKey>(histories_.size() + 1);
    VehicleConfig config;
    if (latitude) {
      config.frame = CoordinateFrame::kGeodetic;
      config.origin = GeodeticOrigin{*latitude, 7.0, 0.0};
      config.drive.search.correlation_model =
          core::CorrelationModel::kIndependent;
    }
    if (all_reckoned_) {
      config.drive.search.correlation_model =
          core::CorrelationModel::kDeadReckoning;
    }
    core::Drive drive(config.drive);
    std::vector<core::PoseSample> samples;
    for (std::uint64_t i = 1; i <= 101; ++i) {
      core::PoseSample sample;
      sample.sequence = i;
      sample.pose.x = static_cast<double>(i);
      for (int k = 0; k < 4; ++k) sample.covariance(k, k) = 0.01;
      samples.push_back(sample);
    }
    if (gap_) {
      const auto before = samples.begin() +
                          static_cast<std::ptrdiff_t>(gap_->first_sequence) - 1;
      const auto behind =
          samples.begin() + static_cast<std::ptrdiff_t>(gap_->last_sequence);
      drive.Append({samples.begin(), before}, 1);
      drive.Skip(*gap_, 2);
      samples.erase(samples.begin(), behind);
    }
    drive.Append(samples, 3);
    const std::string id(1, static_cast<char>('a' + key - 1));
    histories_.push_back(std::make_shared<const KnownHistory>(
        KnownHistory{id, key, config, 1, 101, "series", HistoryView(drive)}));
    GroupMemberRecord member;
    member.vehicle = key;
    member.vehicle_id = id;
    member.payload = datum;
    group_.members.push_back(member);
  }

  void Link(VehicleKey query, VehicleKey matched, std::uint64_t sequence,
            const std::string& payload = EncodeLinkContent({})) {
    StoredLink link;
    link.record.query = {query, sequence};
    link.record.matched = {matched, sequence};
    link.record.payload = payload;
    group_.links.push_back(link);
  }

  // How the first vehicle's frame is tied to another one's.
  core::FrameRelation TieTo(std::size_t drive) {
    const auto joined = JoinGroup(
        std::make_shared<const StoredGroup>(group_), histories_,
        [this](const KnownHistory& history, std::uint64_t sequence) {
          read_.emplace_back(history.key, sequence);
          return std::optional<core::PoseEstimate>();
        },
        nullptr);
    const core::DriveView& asking = joined->drives->view(0);
    const core::SeenFrames seen = joined->drives->SeenFrom(
        asking.nodes(), asking.recordings, asking.graph.size() - 1, {}, 0);
    return seen.relations.From(
        seen.own)[*joined->drives->FrameOf(drive, asking.nodes())];
  }

  bool all_reckoned_ = false;
  // Poses that vehicles lack which are added from then on.
  std::optional<core::DroppedStretch> gap_;
  StoredGroup group_;
  std::vector<std::shared_ptr<const KnownHistory>> histories_;
  std::vector<std::pair<VehicleKey, std::uint64_t>> read_;
};

TEST_F(JoinGroupTest, DatumsPlaceFrames) {
  Add(DatumAt(5.0));
  Add(DatumAt(25.0));
  Add("");
  EXPECT_EQ(TieTo(1).state, FrameState::kDatum);
  EXPECT_NEAR(TieTo(1).transform.x, 20.0, 1e-9);
  EXPECT_EQ(TieTo(2).state, FrameState::kNone);
}

TEST_F(JoinGroupTest, RejectedCandidatesTieNothingAndAreNotSought) {
  Add("");
  Add("");
  GroupLinkRecord record;
  record.query = {2, 50};
  record.matched = {1, 20};
  group_.rejected.push_back(record);
  // Nobody has such a pose.
  record.matched.sequence = 500;
  group_.rejected.push_back(record);
  EXPECT_EQ(TieTo(1).state, FrameState::kNone);
  const auto joined = JoinGroup(
      std::make_shared<const StoredGroup>(group_), histories_,
      [](const KnownHistory&, std::uint64_t) {
        return std::optional<core::PoseEstimate>();
      },
      /*before=*/nullptr);
  const core::DriveView& asking = joined->drives->view(0);
  const auto at = [&](std::uint64_t sequence) {
    return joined->drives->NotSought(
        1, 0, asking.graph, asking.recordings,
        *core::NodeOf(asking.graph, asking.dropped, sequence), 1.0);
  };
  ASSERT_EQ(at(20).size(), 1u);
  const auto& graph = joined->drives->view(1).graph;
  EXPECT_NEAR(graph.pose(at(20)[0].first).x, 40.0, 2.5);
  EXPECT_NEAR(graph.pose(at(20)[0].last - 1).x, 60.0, 2.5);
  EXPECT_EQ(at(28).size(), 1u);
  EXPECT_TRUE(at(35).empty());
}

TEST_F(JoinGroupTest, FixesTieFramesWithoutAnyDatum) {
  Add("", 45.0);
  Add("", 45.01);
  EXPECT_EQ(TieTo(1).state, FrameState::kDatum);
  EXPECT_NEAR(TieTo(1).transform.y, 1111.0, 2.0);
}

TEST_F(JoinGroupTest, FixesAndDatumsNeedAnOriginToMeet) {
  all_reckoned_ = true;
  Add(DatumAt(5.0));
  Add("", 45.0);
  Add("", 45.01);
  EXPECT_EQ(TieTo(1).state, FrameState::kNone);
  group_.settings.geodetic_origin = GeodeticOrigin{45.0, 7.0, 0.0};
  EXPECT_EQ(TieTo(1).state, FrameState::kDatum);
  EXPECT_NEAR(TieTo(1).transform.x, -5.0, 1e-6);
  EXPECT_NEAR(TieTo(2).transform.y, 1111.0, 2.0);
}

TEST_F(JoinGroupTest, LinksTieFrames) {
  Add("");
  Add("");
  EXPECT_EQ(TieTo(1).state, FrameState::kNone);
  Link(1, 2, 50);
  EXPECT_EQ(TieTo(1).state, FrameState::kProvisional);
  EXPECT_NEAR(TieTo(1).transform.x, 0.0, 1e-9);
}

TEST_F(JoinGroupTest, LinksOfPosesThatAreNotThereTieNothing) {
  Add("");
  Add("");
  Link(1, 2, 102);
  Link(1, 3, 50);
  EXPECT_EQ(TieTo(1).state, FrameState::kNone);
}

TEST_F(JoinGroupTest, LinksOfPosesThatWereDroppedTieNothing) {
  Add("");
  gap_ = {40, 60, 22.0, std::nullopt};
  Add("");
  Add("");
  Link(1, 2, 40);
  Link(2, 1, 60);
  Link(2, 3, 50);
  EXPECT_EQ(TieTo(1).state, FrameState::kNone);
  Link(1, 2, 61);
  EXPECT_EQ(TieTo(1).state, FrameState::kProvisional);
  EXPECT_EQ(TieTo(2).state, FrameState::kNone);
}

TEST_F(JoinGroupTest, MeasurementsAreOfThePosesThemselves) {
  Add("");
  Add("");
  google::protobuf::RepeatedField<double> values;
  for (const double value : {1.0, 0.0, 0.0, 1.0, 0.0, 0.01}) values.Add(value);
  LinkContent content;
  MeasurementFields& measurement = content.content.measurement.emplace();
  measurement.x_meters = 1.0;
  measurement.covariance = CovarianceFields{CovarianceForm::kPlanar6, values};
  Link(1, 2, 50, EncodeLinkContent(content));
  // Poses that cannot be read say nothing.
  EXPECT_EQ(TieTo(1).state, FrameState::kNone);
  ASSERT_FALSE(read_.empty());
  EXPECT_EQ(read_[0], std::pair(VehicleKey{1}, std::uint64_t{50}));
}

}  // namespace
}  // namespace revisit::server
