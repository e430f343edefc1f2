#include "server/fleet/joined_group.h"

#include <cstddef>
#include <map>
#include <utility>

#include "core/drive/confirmed_loop.h"
#include "core/drive/dropped_stretch.h"
#include "core/drive/measured_loop.h"
#include "server/fleet/fix_datums.h"
#include "server/records/group_content.h"

namespace revisit::server {
namespace {

using Datum = std::shared_ptr<const core::RecordingStart>;

bool HasFixes(const KnownHistory& history) {
  return history.config.frame == CoordinateFrame::kGeodetic;
}

// The error of the first pose, where the others are reckoned from it.
std::optional<core::Covariance> FirstError(const KnownHistory& history) {
  const core::DriveView& view = *history.view;
  if (!view.nodes().have_references() || view.graph.size() == 0) {
    return std::nullopt;
  }
  return view.graph.node(0).covariance;
}

class Joining {
 public:
  Joining(const StoredGroup& group,
          const std::vector<std::shared_ptr<const KnownHistory>>& histories)
      : group_(group), histories_(histories) {
    for (std::size_t d = 0; d < histories.size(); ++d) {
      drives_.emplace(histories[d]->key, d);
    }
  }

  std::vector<core::JoinedDrive> Drives() const {
    std::vector<Datum> datums(histories_.size());
    bool has_datum = false;
    for (const GroupMemberRecord& member : group_.members) {
      const auto drive = drives_.find(member.vehicle);
      if (drive == drives_.end()) continue;
      const KnownHistory& history = *histories_[drive->second];
      if (HasFixes(history)) continue;
      datums[drive->second] = DatumOf(member, history);
      if (datums[drive->second] != nullptr) has_datum = true;
    }
    PlaceByFixes(has_datum, &datums);
    std::vector<core::JoinedDrive> drives;
    for (std::size_t d = 0; d < histories_.size(); ++d) {
      drives.push_back({histories_[d]->view, std::move(datums[d])});
    }
    return drives;
  }

  std::vector<core::FrameLink> Links(const PoseReader& read_pose) const {
    std::vector<core::FrameLink> links;
    for (const StoredLink& stored : group_.links) {
      if (const auto link = LinkOf(stored.record, read_pose)) {
        links.push_back(*link);
      }
    }
    return links;
  }

  std::vector<core::FrameLink> Rejected() const {
    std::vector<core::FrameLink> rejected;
    for (const GroupLinkRecord& record : group_.rejected) {
      if (const auto link = NodesOf(record)) rejected.push_back(*link);
    }
    return rejected;
  }

 private:
  // Null where there is none, or none for the vehicle as it is now.
  static Datum DatumOf(const GroupMemberRecord& member,
                       const KnownHistory& history) {
    absl::StatusOr<Datum> datum =
        DecodeMemberDatum(member.payload, history.config.drive.state_space);
    return datum.ok() ? *std::move(datum) : nullptr;
  }

  // The group's frame is that of its origin; without one, members with fixes
  // are tied to each other where no datum is of another frame.
  void PlaceByFixes(bool has_datum, std::vector<Datum>* datums) const {
    std::optional<GeodeticOrigin> anchor = group_.settings.geodetic_origin;
    if (!anchor && has_datum) return;
    for (std::size_t d = 0; d < histories_.size(); ++d) {
      const VehicleConfig& config = histories_[d]->config;
      if (!HasFixes(*histories_[d]) || !config.origin) continue;
      if (!anchor) anchor = config.origin;
      (*datums)[d] =
          DatumOfFixes(*anchor, *config.origin, group_.settings.fix_bias_meters,
                       config.drive.state_space, FirstError(*histories_[d]));
    }
  }

  // Without what was measured.
  std::optional<core::FrameLink> NodesOf(const GroupLinkRecord& record) const {
    const auto query = drives_.find(record.query.vehicle);
    const auto matched = drives_.find(record.matched.vehicle);
    if (query == drives_.end() || matched == drives_.end()) return std::nullopt;
    const auto query_node =
        NodeAt(*histories_[query->second], record.query.sequence);
    const auto matched_node =
        NodeAt(*histories_[matched->second], record.matched.sequence);
    if (!query_node || !matched_node) return std::nullopt;
    return core::FrameLink{
        query->second, matched->second, {*query_node, *matched_node, nullptr}};
  }

  std::optional<core::FrameLink> LinkOf(const GroupLinkRecord& record,
                                        const PoseReader& read_pose) const {
    std::optional<core::FrameLink> link = NodesOf(record);
    if (!link) return std::nullopt;
    const KnownHistory& asking = *histories_[link->query_drive];
    const KnownHistory& other = *histories_[link->matched_drive];
    const absl::StatusOr<std::optional<core::LoopMeasurement>> measurement =
        DecodeLinkMeasurement(record.payload, asking.config.drive.state_space);
    if (!measurement.ok()) return std::nullopt;
    if (!*measurement) return link;
    const auto query_pose = read_pose(asking, record.query.sequence);
    const auto matched_pose = read_pose(other, record.matched.sequence);
    if (!query_pose || !matched_pose) return std::nullopt;
    link->loop.measured = std::make_shared<const core::MeasuredLoop>(
        core::MeasuredLoop{**measurement, *query_pose, *matched_pose});
    return link;
  }

  // Nothing for a pose that the history does not have yet, or does not keep.
  static std::optional<core::NodeIndex> NodeAt(const KnownHistory& history,
                                               std::uint64_t sequence) {
    if (sequence > history.last_sequence) return std::nullopt;
    const core::DriveView& view = *history.view;
    return core::NodeOf(view.graph, view.dropped, sequence);
  }

  const StoredGroup& group_;
  const std::vector<std::shared_ptr<const KnownHistory>>& histories_;
  // By the vehicle's key.
  std::map<VehicleKey, std::size_t> drives_;
};

}  // namespace

std::shared_ptr<const JoinedGroup> JoinGroup(
    std::shared_ptr<const StoredGroup> group,
    std::vector<std::shared_ptr<const KnownHistory>> histories,
    const PoseReader& read_pose, const core::JoinedDrives* before) {
  const Joining joining(*group, histories);
  auto drives = std::make_shared<const core::JoinedDrives>(
      joining.Drives(), joining.Links(read_pose), joining.Rejected(), before);
  return std::make_shared<const JoinedGroup>(
      JoinedGroup{std::move(group), std::move(histories), std::move(drives)});
}

}  // namespace revisit::server
