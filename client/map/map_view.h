// Which part of a map is drawn where, at which scale.
#ifndef REVISIT_CLIENT_MAP_MAP_VIEW_H_
#define REVISIT_CLIENT_MAP_MAP_VIEW_H_

#include <vector>

#include "client/map/map_contents.h"

namespace revisit::client {

// In pixels, y downwards.
struct PixelPoint {
  double x = 0.0;
  double y = 0.0;
};

struct Rectangle {
  double left = 0.0;
  double top = 0.0;
  double width = 0.0;
  double height = 0.0;

  PixelPoint middle() const { return {left + 0.5 * width, top + 0.5 * height}; }
  bool Contains(const PixelPoint& point, double margin) const {
    return point.x >= left - margin && point.x <= left + width + margin &&
           point.y >= top - margin && point.y <= top + height + margin;
  }
};

struct MapView {
  // Pixels.
  Rectangle frame;
  // In the middle of the frame.
  MapPoint middle;
  double pixels_per_meter = 1.0;
  // The size of marks and links, relative to the legend's.
  double mark_size = 1.0;

  PixelPoint At(const MapPoint& meters) const;
  MapPoint MetersAt(const PixelPoint& pixels) const;
};

// All of the contents, with their ellipses unless these would make the path
// small, in a frame of this width whose height follows. REQUIRES: a node.
MapView WholeView(const MapContents& contents, double left, double top,
                  double width);

// An enlarged part of the map, in a corner where there is nothing else.
struct MapDetail {
  // On the map, in pixels.
  Rectangle source;
  MapView view;
};

inline constexpr double kEnlargement = 3.0;

// The parts that gain most where marks had to be made small; none elsewhere.
std::vector<MapDetail> ChooseDetails(const MapContents& contents,
                                     const MapView& whole);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_MAP_MAP_VIEW_H_
