// The contents of a map of one vehicle, or of one among others, whatever it is
// drawn with.
#ifndef REVISIT_CLIENT_MAP_MAP_CONTENTS_H_
#define REVISIT_CLIENT_MAP_MAP_CONTENTS_H_

#include <cstddef>
#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "google/protobuf/timestamp.pb.h"

namespace revisit::client {

// Metres in the local frame.
struct MapPoint {
  double x = 0.0;
  double y = 0.0;
};

// A node of the pose graph.
struct MapNode {
  std::uint64_t sequence = 0;
  std::optional<google::protobuf::Timestamp> stamp;
  double travelled_meters = 0.0;
  MapPoint at;
  double z_meters = 0.0;
  // Covariance of the position: xx, xy, yy.
  double xx = 0.0;
  double xy = 0.0;
  double yy = 0.0;
};

// How some of the checks are drawn, and the legend's words for them.
struct MapStyle {
  std::string label;
  // A colour of SVG, such as "#0a8f6a".
  std::string color;
  // Drawn as a link to the first candidate, otherwise as a circle filled with
  // the colour.
  bool link = false;
  bool dashed = false;
  // How much these are what a reader looks for: where marks are too crowded,
  // parts with the most of it are enlarged.
  double weight = 1.0;
};

struct MapCandidate {
  // Index among the nodes.
  std::size_t node = 0;
  std::string verdict;
  bool opposite = false;
  // Candidate.probability, and Candidate.place_interval: how far before and
  // after the node the place may lie.
  std::optional<double> probability;
  double meters_before = 0.0;
  double meters_after = 0.0;
  // The gate that decided: "end" or "path"; "none" where nothing tells how the
  // frames lie to each other, and then the numbers mean nothing.
  std::string gate;
  double squared_distance = 0.0;
  double threshold = 0.0;
  double p_value = 0.0;
  // How the frame of its recording is tied to that of the check's, as
  // v1::FrameState names it; empty where that is not told.
  std::string frame_state = "";
};

struct MapCheck {
  // Index among the nodes.
  std::size_t node = 0;
  // Index among the styles.
  std::size_t style = 0;
  // Best first. REQUIRES: one at least, where the style is a link.
  std::vector<MapCandidate> candidates;
  // Why there are none.
  std::string empty_reason;
};

// Two nodes that a verifier has looked at.
struct MapPair {
  std::size_t query = 0;
  std::size_t matched = 0;
  // The resource name.
  std::string name;
  // The verifier's; empty if there is none.
  std::string note;
};

// A stretch of nodes that were recorded in one frame.
struct MapRecording {
  // Index of its first node.
  std::size_t first_node = 0;
  // For the legend: which one it is, and how well it is known where it lies.
  std::string label;
  // Colour of what is drawn, in the form of MapStyle.color.
  std::string color;
  // The id of its vehicle, if that is another one than the one whose map it is.
  std::string vehicle = "";
};

struct MapContents {
  std::string title;
  std::string subtitle;
  // In one frame, but for recordings that nothing ties to it, which lie beside
  // the others.
  std::vector<MapNode> nodes;
  // Where those of the vehicle begin whose map it is; those before it are of
  // other vehicles.
  std::size_t own_begin = 0;
  // One behind the other, from the first node on; empty where there is one.
  std::vector<MapRecording> recordings;
  // One for each node, in the frame of the estimate; empty if it is not known.
  std::vector<MapPoint> truth;
  std::vector<MapStyle> styles;
  std::vector<MapCheck> checks;
  std::vector<MapPair> closures;
  std::vector<MapPair> rejections;
};

// The nodes of each recording: the first one, and the one behind the last; all
// of them where there is one recording.
struct MapStretch {
  std::size_t begin = 0;
  std::size_t end = 0;
  std::string color;
};
std::vector<MapStretch> StretchesOf(const MapContents& contents);

// Whether the trajectory is cut before this node: a jump adds no distance.
bool IsCutBefore(const std::vector<MapNode>& nodes, std::size_t index);

// The 95 % ellipse of a position: half axes in metres, and the direction of the
// longer one from +x counter-clockwise in radians.
struct MapEllipse {
  double major = 0.0;
  double minor = 0.0;
  double direction = 0.0;
};

MapEllipse EllipseOf(const MapNode& node);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_MAP_MAP_CONTENTS_H_
