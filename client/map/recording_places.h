// Where stretches of nodes lie on one map that were recorded in frames of their
// own: the recordings of a vehicle, or those of several.
#ifndef REVISIT_CLIENT_MAP_RECORDING_PLACES_H_
#define REVISIT_CLIENT_MAP_RECORDING_PLACES_H_

#include <cstddef>
#include <optional>
#include <string>
#include <vector>

#include "client/map/map_contents.h"
#include "revisit/v1/geometry.pb.h"
#include "revisit/v1/recording.pb.h"

namespace revisit::client {

// Nodes up to the next stretch's first one.
struct FramedStretch {
  // Index of its first node.
  std::size_t first_node = 0;
  // Its frame in that of the map; nothing where nothing ties the two.
  std::optional<v1::StatePose> frame_pose;
  // The same as in MapRecording.
  std::string label;
  std::string color;
  std::string vehicle = "";
};

// The k-th of the colours for stretches beside those of kMapEstimate; none is
// that of a link or a check.
std::string StretchColor(std::size_t k);

// Carries the nodes, each in the frame of its stretch, to that of the map;
// those of stretches that nothing ties to it go beside the others, each by
// itself. REQUIRES: the stretches in the order of their nodes, of which each
// has one at least and the first one has the first.
void PlaceStretches(const std::vector<FramedStretch>& stretches,
                    MapContents* contents);

// The same for the recordings of one vehicle: to the frame of the last one.
// Nothing changes where there are fewer than two. REQUIRES: recordings in their
// order.
void PlaceRecordings(const std::vector<v1::Recording>& recordings,
                     MapContents* contents);

// How well it is known where a frame lies in another one, in words. `same` is
// said of that one itself.
std::string CertaintyText(v1::FrameState state,
                          const v1::Covariance& covariance,
                          const std::string& same);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_MAP_RECORDING_PLACES_H_
