#include "client/map/recording_places.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <string>
#include <utility>

#include "absl/strings/str_cat.h"
#include "client/answers/names.h"
#include "client/formats/angles.h"
#include "client/map/svg.h"
#include "client/terminal/terminal.h"
#include "client/trajectory/local_pose.h"
#include "client/trajectory/stored_poses.h"

namespace revisit::client {
namespace {

// Colours of recordings but the last one; none is that of a link or a check.
constexpr std::array<const char*, 6> kColors = {
    "#8a5a00", "#6d3fa0", "#1c7c8c", "#a0306a", "#4c6b12", "#4560c4"};

struct Box {
  MapPoint low;
  MapPoint high;

  void Include(const MapPoint& point) {
    low = {std::min(low.x, point.x), std::min(low.y, point.y)};
    high = {std::max(high.x, point.x), std::max(high.y, point.y)};
  }
};

void Move(const v1::StatePose& frame, MapNode* node) {
  const double c = std::cos(frame.heading_radians());
  const double s = std::sin(frame.heading_radians());
  const auto [x, y] = node->at;
  node->at = {frame.x_meters() + c * x - s * y,
              frame.y_meters() + s * x + c * y};
  node->z_meters += frame.z_meters();
  const double xx = node->xx;
  const double xy = node->xy;
  const double yy = node->yy;
  node->xx = c * c * xx - 2.0 * c * s * xy + s * s * yy;
  node->xy = c * s * (xx - yy) + (c * c - s * s) * xy;
  node->yy = s * s * xx + 2.0 * c * s * xy + c * c * yy;
}

std::string LabelOf(const v1::Recording& recording) {
  return absl::StrCat(
      recording.label().empty()
          ? absl::StrCat("from ", recording.first_sequence())
          : recording.label(),
      ": ",
      CertaintyText(recording.frame_state(), recording.frame_covariance(),
                    "the last one"));
}

// Where the stretches of a map lie that are tied to it, and then those that are
// put beside them.
class Placed {
 public:
  void Include(const Box& box) {
    if (!any_) all_ = box;
    any_ = true;
    all_.Include(box.low);
    all_.Include(box.high);
  }
  // How far a stretch has to go that is put beside all others.
  MapPoint Beside(const Box& box) const {
    if (!any_) return {};
    const double gap = 0.08 * std::max({all_.high.x - all_.low.x,
                                        box.high.x - box.low.x, 10.0});
    return {all_.high.x + gap - box.low.x, all_.low.y - box.low.y};
  }

 private:
  Box all_;
  bool any_ = false;
};

}  // namespace

std::string StretchColor(std::size_t k) { return kColors[k % kColors.size()]; }

std::string CertaintyText(v1::FrameState state,
                          const v1::Covariance& covariance,
                          const std::string& same) {
  if (state == v1::FRAME_STATE_SAME) return same;
  if (state == v1::FRAME_STATE_NONE) {
    return "tied by nothing, drawn beside the others";
  }
  std::string text = NameOf(state);
  if (!covariance.values().empty()) {
    const StateMatrix c = StateCovariance(covariance);
    absl::StrAppend(&text, ", within ",
                    Fixed(std::sqrt(0.5 * (c[0] + c[5])), 1), " m and ",
                    Fixed(std::sqrt(c[15]) / kRadiansPerDegree, 1), " degrees");
  }
  return text;
}

void PlaceStretches(const std::vector<FramedStretch>& stretches,
                    MapContents* contents) {
  std::vector<MapNode>& nodes = contents->nodes;
  for (const FramedStretch& stretch : stretches) {
    contents->recordings.push_back(
        {stretch.first_node, stretch.label, stretch.color, stretch.vehicle});
  }
  const std::vector<MapStretch> ranges = StretchesOf(*contents);
  const auto box_of = [&](const MapStretch& range) {
    Box box{nodes[range.begin].at, nodes[range.begin].at};
    for (std::size_t i = range.begin; i < range.end; ++i) {
      box.Include(nodes[i].at);
    }
    return box;
  };
  Placed placed;
  for (std::size_t k = 0; k < ranges.size(); ++k) {
    if (!stretches[k].frame_pose) continue;
    for (std::size_t i = ranges[k].begin; i < ranges[k].end; ++i) {
      Move(*stretches[k].frame_pose, &nodes[i]);
    }
    placed.Include(box_of(ranges[k]));
  }
  for (std::size_t k = 0; k < ranges.size(); ++k) {
    if (stretches[k].frame_pose) continue;
    const MapPoint shift = placed.Beside(box_of(ranges[k]));
    for (std::size_t i = ranges[k].begin; i < ranges[k].end; ++i) {
      nodes[i].at = {nodes[i].at.x + shift.x, nodes[i].at.y + shift.y};
    }
    placed.Include(box_of(ranges[k]));
  }
}

void PlaceRecordings(const std::vector<v1::Recording>& recordings,
                     MapContents* contents) {
  const std::vector<MapNode>& nodes = contents->nodes;
  if (recordings.size() < 2 || nodes.empty()) return;
  std::vector<FramedStretch> stretches;
  const v1::Recording* last = nullptr;
  for (std::size_t i = 0; i < nodes.size(); ++i) {
    const v1::Recording* of = RecordingOf(recordings, nodes[i].sequence);
    if (of == nullptr) of = &recordings.front();
    if (of == last) continue;
    last = of;
    FramedStretch stretch{i, std::nullopt, LabelOf(*of),
                          StretchColor(stretches.size())};
    if (of->has_frame_pose()) stretch.frame_pose = of->frame_pose();
    stretches.push_back(std::move(stretch));
  }
  stretches.back().color = kMapEstimate;
  PlaceStretches(stretches, contents);
}

}  // namespace revisit::client
