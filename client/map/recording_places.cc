#include "client/map/recording_places.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <string>

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

bool IsTied(const v1::Recording& recording) {
  return recording.has_frame_pose();
}

// How well it is known where a recording lies, in words.
std::string CertaintyOf(const v1::Recording& recording) {
  if (!IsTied(recording)) return "tied by nothing, drawn beside the others";
  if (recording.frame_state() == v1::FRAME_STATE_SAME) return "the last one";
  std::string text = NameOf(recording.frame_state());
  if (recording.has_frame_covariance()) {
    const StateMatrix c = StateCovariance(recording.frame_covariance());
    absl::StrAppend(&text, ", within ",
                    Fixed(std::sqrt(0.5 * (c[0] + c[5])), 1), " m and ",
                    Fixed(std::sqrt(c[15]) / kRadiansPerDegree, 1), " degrees");
  }
  return text;
}

std::string LabelOf(const v1::Recording& recording) {
  return absl::StrCat(recording.label().empty()
                          ? absl::StrCat("from ", recording.first_sequence())
                          : recording.label(),
                      ": ", CertaintyOf(recording));
}

}  // namespace

void PlaceRecordings(const std::vector<v1::Recording>& recordings,
                     MapContents* contents) {
  std::vector<MapNode>& nodes = contents->nodes;
  if (recordings.size() < 2 || nodes.empty()) return;
  std::vector<const v1::Recording*> drawn;
  for (std::size_t i = 0; i < nodes.size(); ++i) {
    const v1::Recording* of = RecordingOf(recordings, nodes[i].sequence);
    if (of == nullptr) of = &recordings.front();
    if (drawn.empty() || of != drawn.back()) {
      drawn.push_back(of);
      contents->recordings.push_back({i, LabelOf(*of), kMapEstimate});
    }
    if (IsTied(*of)) Move(of->frame_pose(), &nodes[i]);
  }
  for (std::size_t k = 0; k + 1 < drawn.size(); ++k) {
    contents->recordings[k].color = kColors[k % kColors.size()];
  }
  const std::vector<MapStretch> stretches = StretchesOf(*contents);
  std::vector<Box> boxes;
  Box all;
  bool any = false;
  for (std::size_t k = 0; k < stretches.size(); ++k) {
    Box box{nodes[stretches[k].begin].at, nodes[stretches[k].begin].at};
    for (std::size_t i = stretches[k].begin; i < stretches[k].end; ++i) {
      box.Include(nodes[i].at);
    }
    boxes.push_back(box);
    if (!IsTied(*drawn[k])) continue;
    if (!any) all = box;
    any = true;
    all.Include(box.low);
    all.Include(box.high);
  }
  for (std::size_t k = 0; k < stretches.size(); ++k) {
    if (IsTied(*drawn[k])) continue;
    if (!any) all = {boxes[k].low, boxes[k].low};
    const double gap =
        any ? 0.08 * std::max({all.high.x - all.low.x,
                               boxes[k].high.x - boxes[k].low.x, 10.0})
            : 0.0;
    const double dx = all.high.x + gap - boxes[k].low.x;
    const double dy = all.low.y - boxes[k].low.y;
    for (std::size_t i = stretches[k].begin; i < stretches[k].end; ++i) {
      nodes[i].at = {nodes[i].at.x + dx, nodes[i].at.y + dy};
    }
    any = true;
    all.Include({boxes[k].low.x + dx, boxes[k].low.y + dy});
    all.Include({boxes[k].high.x + dx, boxes[k].high.y + dy});
  }
}

}  // namespace revisit::client
