// A map of an evaluated drive.
#ifndef REVISIT_CLIENT_CLI_EVALUATION_MAP_SVG_H_
#define REVISIT_CLIENT_CLI_EVALUATION_MAP_SVG_H_

#include <string>
#include <vector>

#include "client/cli/evaluation/evaluation.h"
#include "client/formats/drive_file.h"

namespace revisit::client {

struct MapContents {
  std::string title;
  std::string subtitle;
  std::vector<GraphNode> nodes;
  // One for each node.
  std::vector<PlanarPose> truth_at_nodes;
  // Whether the truth is in the frame of the estimate; otherwise it is moved so
  // that the two begin at one pose.
  bool one_frame = false;
  std::vector<JudgedCheck> checks;
};

// An SVG document, drawn in the frame of the estimate: the estimated
// trajectory; the truth; at each check the 95 % ellipse of its position; a link
// from each check to its first candidate, where that was accepted, solid where
// right and dashed where wrong; a circle at each check where it was not, filled
// where a true loop was missed.
//
// REQUIRES: at least one node.
std::string DrawMap(const MapContents& contents);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_EVALUATION_MAP_SVG_H_
