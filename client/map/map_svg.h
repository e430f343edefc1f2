// A map as a drawing.
#ifndef REVISIT_CLIENT_MAP_MAP_SVG_H_
#define REVISIT_CLIENT_MAP_MAP_SVG_H_

#include <string>

#include "client/map/map_contents.h"

namespace revisit::client {

// An SVG document, drawn in the frame of the estimate: the trajectory; the
// truth, where it is known; at each check the 95 % ellipse of its position and
// its mark; the pairs that a verifier has confirmed or rejected.
//
// REQUIRES: at least one node.
std::string DrawMap(const MapContents& contents);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_MAP_MAP_SVG_H_
