#include "client/map/map_view.h"

#include <algorithm>
#include <cmath>
#include <cstddef>

namespace revisit::client {
namespace {

constexpr double kMinHeight = 300.0;
constexpr double kMaxHeight = 1150.0;

class Bounds {
 public:
  explicit Bounds(const MapPoint& first) : low(first), high(first) {}

  void Include(const MapPoint& point) {
    low.x = std::min(low.x, point.x);
    low.y = std::min(low.y, point.y);
    high.x = std::max(high.x, point.x);
    high.y = std::max(high.y, point.y);
  }

  MapPoint low;
  MapPoint high;
};

// Smaller marks where checks lie close together on the drawing.
double MarkSize(const MapContents& contents, double pixels_per_meter) {
  constexpr double kRoomy = 44.0;
  constexpr double kSmallest = 0.55;
  const auto& checks = contents.checks;
  if (checks.size() < 2) return 1.0;
  const double meters = (contents.nodes[checks.back().node].travelled_meters -
                         contents.nodes[checks.front().node].travelled_meters) /
                        static_cast<double>(checks.size() - 1);
  return std::clamp(meters * pixels_per_meter / kRoomy, kSmallest, 1.0);
}

Bounds BoundsOf(const MapContents& contents) {
  Bounds path(contents.nodes[0].at);
  for (const MapNode& node : contents.nodes) path.Include(node.at);
  for (const MapPoint& point : contents.truth) path.Include(point);
  const double size =
      std::max({path.high.x - path.low.x, path.high.y - path.low.y, 1.0});
  Bounds all = path;
  for (const MapCheck& check : contents.checks) {
    const MapNode& node = contents.nodes[check.node];
    const double reach = EllipseOf(node).major;
    all.Include({node.at.x - reach, node.at.y - reach});
    all.Include({node.at.x + reach, node.at.y + reach});
  }
  const double most = 0.2 * size;
  const double margin = 0.04 * size;
  all.low = {std::max(all.low.x, path.low.x - most) - margin,
             std::max(all.low.y, path.low.y - most) - margin};
  all.high = {std::min(all.high.x, path.high.x + most) + margin,
              std::min(all.high.y, path.high.y + most) + margin};
  return all;
}

// Corners in which a square of this side hides no trajectory; not the lower
// right, where the scale bar is.
std::vector<Rectangle> FreeCorners(const MapContents& contents,
                                   const MapView& view, double side) {
  constexpr double kMargin = 16.0;
  const Rectangle& plot = view.frame;
  const double left = plot.left + kMargin;
  const double top = plot.top + kMargin;
  const double right = plot.left + plot.width - kMargin - side;
  const double bottom = plot.top + plot.height - kMargin - side;
  std::vector<Rectangle> corners;
  for (const PixelPoint& corner :
       {PixelPoint{right, top}, PixelPoint{left, bottom},
        PixelPoint{left, top}}) {
    const Rectangle frame = {corner.x, corner.y, side, side};
    const auto free = [&](const MapPoint& meters) {
      return !frame.Contains(view.At(meters), kMargin);
    };
    if (std::all_of(contents.nodes.begin(), contents.nodes.end(),
                    [&](const MapNode& node) { return free(node.at); }) &&
        std::all_of(contents.truth.begin(), contents.truth.end(), free)) {
      corners.push_back(frame);
    }
  }
  return corners;
}

bool IsLink(const MapContents& contents, const MapCheck& check) {
  return contents.styles[check.style].link;
}

// Total length of the links that lie in a window, by weight.
double LinksShown(const MapContents& contents, const MapView& view,
                  const Rectangle& window) {
  double shown = 0.0;
  for (const MapCheck& check : contents.checks) {
    if (!IsLink(contents, check)) continue;
    const PixelPoint from = view.At(contents.nodes[check.node].at);
    const PixelPoint to = view.At(contents.nodes[check.candidates[0].node].at);
    if (!window.Contains(from, 0.0) || !window.Contains(to, 0.0)) continue;
    shown += std::hypot(from.x - to.x, from.y - to.y) *
             contents.styles[check.style].weight;
  }
  return shown;
}

}  // namespace

PixelPoint MapView::At(const MapPoint& meters) const {
  return {frame.middle().x + (meters.x - middle.x) * pixels_per_meter,
          frame.middle().y - (meters.y - middle.y) * pixels_per_meter};
}

MapPoint MapView::MetersAt(const PixelPoint& pixels) const {
  return {middle.x + (pixels.x - frame.middle().x) / pixels_per_meter,
          middle.y - (pixels.y - frame.middle().y) / pixels_per_meter};
}

MapView WholeView(const MapContents& contents, double left, double top,
                  double width) {
  const Bounds bounds = BoundsOf(contents);
  const double across = bounds.high.x - bounds.low.x;
  const double up = bounds.high.y - bounds.low.y;
  MapView view;
  view.pixels_per_meter = std::min(width / across, kMaxHeight / up);
  view.frame = {left, top, width,
                std::max(kMinHeight, up * view.pixels_per_meter)};
  view.middle = {0.5 * (bounds.low.x + bounds.high.x),
                 0.5 * (bounds.low.y + bounds.high.y)};
  view.mark_size = MarkSize(contents, view.pixels_per_meter);
  return view;
}

std::vector<MapDetail> ChooseDetails(const MapContents& contents,
                                     const MapView& whole) {
  constexpr double kCrowded = 0.8;
  constexpr std::size_t kMost = 2;
  std::vector<MapDetail> details;
  if (whole.mark_size >= kCrowded) return details;
  const double side = 0.36 * std::min(whole.frame.width, whole.frame.height);
  const double source_side = side / kEnlargement;
  for (const Rectangle& frame : FreeCorners(contents, whole, side)) {
    if (details.size() == kMost) break;
    double most_shown = 0.0;
    Rectangle best;
    for (const MapCheck& middle : contents.checks) {
      if (!IsLink(contents, middle)) continue;
      const PixelPoint at = whole.At(contents.nodes[middle.node].at);
      const Rectangle window = {at.x - 0.5 * source_side,
                                at.y - 0.5 * source_side, source_side,
                                source_side};
      const bool taken = std::any_of(
          details.begin(), details.end(), [&](const MapDetail& detail) {
            return std::abs(detail.source.left - window.left) < source_side &&
                   std::abs(detail.source.top - window.top) < source_side;
          });
      const double shown = taken ? 0.0 : LinksShown(contents, whole, window);
      if (shown > most_shown) {
        most_shown = shown;
        best = window;
      }
    }
    if (most_shown == 0.0) continue;
    MapView view;
    view.frame = frame;
    view.middle = whole.MetersAt(best.middle());
    view.pixels_per_meter = whole.pixels_per_meter * kEnlargement;
    view.mark_size = MarkSize(contents, view.pixels_per_meter);
    details.push_back({best, view});
  }
  return details;
}

}  // namespace revisit::client
