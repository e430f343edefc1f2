// A map as a page for a browser.
#ifndef REVISIT_CLIENT_MAP_MAP_HTML_H_
#define REVISIT_CLIENT_MAP_MAP_HTML_H_

#include <string>

#include "client/map/map_contents.h"

namespace revisit::client {

// One HTML document that asks nothing of any server: it can be moved and
// enlarged, and shows the numbers of what is clicked. REQUIRES: at least one
// node.
std::string MapPage(const MapContents& contents);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_MAP_MAP_HTML_H_
