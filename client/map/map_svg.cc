#include "client/map/map_svg.h"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <functional>
#include <utility>

#include "absl/strings/str_cat.h"
#include "client/formats/angles.h"
#include "client/map/map_view.h"
#include "client/map/svg.h"

namespace revisit::client {
namespace {

// Sizes in pixels.
constexpr double kWidth = 1200.0;
constexpr double kLeft = 64.0;
constexpr double kRight = 24.0;
constexpr double kTop = 78.0;
constexpr double kBelowPlot = 44.0;
constexpr double kPlotWidth = kWidth - kLeft - kRight;
constexpr double kLegendRow = 28.0;
constexpr double kLegendMargin = 22.0;
constexpr std::size_t kLegendColumns = 3;

// Keeps text readable on lines.
constexpr char kHalo[] =
    "stroke=\"#ffffff\" stroke-width=\"4\" stroke-linejoin=\"round\" "
    "paint-order=\"stroke\"";

// 1, 2 or 5 times a power of ten: the largest that is at most `value`.
double RoundBelow(double value) {
  const double power = std::pow(10.0, std::floor(std::log10(value)));
  for (const double factor : {5.0, 2.0}) {
    if (factor * power <= value) return factor * power;
  }
  return power;
}

class Drawing {
 public:
  explicit Drawing(const MapContents& contents)
      : contents_(contents),
        view_(WholeView(contents, kLeft, kTop, kPlotWidth)) {}

  std::string Draw() {
    const std::vector<LegendEntry> legend = LegendEntries();
    const std::size_t rows =
        (legend.size() + kLegendColumns - 1) / kLegendColumns;
    const double legend_top =
        kTop + view_.frame.height + kBelowPlot + kLegendMargin;
    svg_ = SvgBegin(kWidth, legend_top + kLegendRow * static_cast<double>(rows),
                    contents_.title);
    Text(kLeft, 36.0, contents_.title, kInk, "start",
         "font-size=\"21\" font-weight=\"bold\"");
    Text(kLeft, 58.0, contents_.subtitle, kFaint, "start", "font-size=\"14\"");
    DrawGrid();
    DrawInside("plot");
    Frame(view_.frame, "none", kInk, "");
    DrawScaleBar();
    const std::vector<MapDetail> details = ChooseDetails(contents_, view_);
    for (std::size_t i = 0; i < details.size(); ++i) {
      DrawDetail(details[i], absl::StrCat("detail", i));
    }
    DrawLegend(legend, rows, legend_top);
    svg_ += "</svg>\n";
    return std::move(svg_);
  }

 private:
  PixelPoint AtNode(std::size_t node) const {
    return view_.At(contents_.nodes[node].at);
  }
  const MapStyle& StyleOf(const MapCheck& check) const {
    return contents_.styles[check.style];
  }

  void DrawDetail(const MapDetail& detail, const std::string& name) {
    Frame(detail.source, "none", kInk, "stroke-dasharray=\"2 2\"");
    // From the part to its enlargement, where they are nearest.
    const auto clamp_to = [](const Rectangle& rectangle,
                             const PixelPoint& point) {
      return PixelPoint{
          std::clamp(point.x, rectangle.left, rectangle.left + rectangle.width),
          std::clamp(point.y, rectangle.top, rectangle.top + rectangle.height)};
    };
    const Rectangle& frame = detail.view.frame;
    const PixelPoint from = clamp_to(detail.source, frame.middle());
    const PixelPoint to = clamp_to(frame, from);
    Line(from, to, kInk, 1.0, "stroke-dasharray=\"2 2\"");
    Frame(frame, "#ffffff", "none", "");
    const MapView whole = std::exchange(view_, detail.view);
    DrawInside(name);
    view_ = whole;
    Frame(frame, "none", kInk, "");
    Text(frame.left + 8.0, frame.top + 18.0,
         "enlarged " + SvgNumber(kEnlargement) + " times", kFaint, "start",
         kHalo);
  }

  void Frame(const Rectangle& frame, const char* fill, const char* stroke,
             const std::string& more) {
    svg_ += "<rect x=\"" + SvgNumber(frame.left) + "\" y=\"" +
            SvgNumber(frame.top) + "\" width=\"" + SvgNumber(frame.width) +
            "\" height=\"" + SvgNumber(frame.height) + "\" fill=\"" + fill +
            "\" stroke=\"" + stroke + "\" " + more + "/>\n";
  }

  // Everything of the view that lies in its frame.
  void DrawInside(const std::string& name) {
    svg_ += "<clipPath id=\"" + name + "\">";
    Frame(view_.frame, "none", "none", "");
    svg_ += "</clipPath>\n<g clip-path=\"url(#" + name + ")\">\n";
    DrawEllipses();
    const auto& nodes = contents_.nodes;
    if (!contents_.truth.empty()) {
      Polyline([&](std::size_t i) { return contents_.truth[i]; },
               {0, nodes.size(), kMapTruth}, 1.2);
    }
    for (const MapStretch& stretch : StretchesOf(contents_)) {
      Polyline([&](std::size_t i) { return nodes[i].at; }, stretch,
               0.8 + 1.2 * view_.mark_size);
      DrawArrows(stretch);
    }
    for (const MapPair& pair : contents_.rejections) {
      DrawPair(AtNode(pair.query), AtNode(pair.matched), false,
               view_.mark_size);
    }
    for (const MapPair& pair : contents_.closures) {
      DrawPair(AtNode(pair.query), AtNode(pair.matched), true, view_.mark_size);
    }
    for (const MapCheck& check : contents_.checks) {
      if (StyleOf(check).link) DrawLinkOf(check);
    }
    for (const MapCheck& check : contents_.checks) {
      DrawMark(AtNode(check.node), StyleOf(check), view_.mark_size);
    }
    DrawEnds();
    svg_ += "</g>\n";
  }

  void Text(double x, double y, const std::string& text, const char* color,
            const char* anchor, const std::string& more) {
    svg_ += SvgText(x, y, text, color, anchor, more);
  }

  void Line(const PixelPoint& from, const PixelPoint& to, const char* color,
            double width, const std::string& more) {
    svg_ += SvgLine(from.x, from.y, to.x, to.y, color, width, more);
  }

  void Circle(const PixelPoint& at, double radius, const char* fill,
              const char* stroke, double width) {
    svg_ += SvgCircle(at.x, at.y, radius, fill, stroke, width);
  }

  // One point per node. Breaks where the trajectory was cut, and leaves out
  // points too near to see.
  void Polyline(const std::function<MapPoint(std::size_t)>& point,
                const MapStretch& stretch, double width) {
    constexpr double kVisible = 0.8;
    svg_ += "<path fill=\"none\" stroke=\"" + stretch.color +
            "\" stroke-width=\"" + SvgNumber(width) +
            "\" stroke-linejoin=\"round\" stroke-linecap=\"round\" d=\"";
    PixelPoint last;
    for (std::size_t i = stretch.begin; i < stretch.end; ++i) {
      const PixelPoint at = view_.At(point(i));
      const bool begins = i == stretch.begin || IsCutBefore(contents_.nodes, i);
      if (!begins && i + 1 < stretch.end &&
          std::hypot(at.x - last.x, at.y - last.y) < kVisible) {
        continue;
      }
      svg_ += (begins ? "M" : "L") + SvgNumber(at.x) + " " + SvgNumber(at.y);
      last = at;
    }
    svg_ += "\"/>\n";
  }

  // Where the vehicle goes: heads of arrows along the path, some way apart.
  void DrawArrows(const MapStretch& stretch) {
    constexpr double kApart = 150.0;
    constexpr double kStep = 6.0;
    double since = 0.5 * kApart;
    PixelPoint last = AtNode(stretch.begin);
    for (std::size_t i = stretch.begin + 1; i < stretch.end; ++i) {
      const PixelPoint at = AtNode(i);
      if (IsCutBefore(contents_.nodes, i)) last = at;
      const double length = std::hypot(at.x - last.x, at.y - last.y);
      if (length < kStep) continue;
      since += length;
      if (since >= kApart) {
        since = 0.0;
        DrawArrow({0.5 * (at.x + last.x), 0.5 * (at.y + last.y)},
                  {(at.x - last.x) / length, (at.y - last.y) / length},
                  stretch.color);
      }
      last = at;
    }
  }

  // `ahead` has length 1.
  void DrawArrow(const PixelPoint& at, const PixelPoint& ahead,
                 const std::string& color) {
    constexpr double kHead = 7.0;
    constexpr double kTail = 5.0;
    const auto corner = [&](double forward, double left) {
      return SvgNumber(at.x + forward * ahead.x + left * ahead.y) + " " +
             SvgNumber(at.y + forward * ahead.y - left * ahead.x);
    };
    svg_ += "<path class=\"arrow\" fill=\"" + color + "\" d=\"M" +
            corner(kHead, 0.0) + "L" + corner(-kTail, kTail) + "L" +
            corner(-kTail, -kTail) + "Z\"/>\n";
  }

  void DrawGrid() {
    const Rectangle& plot = view_.frame;
    const MapPoint low = view_.MetersAt({plot.left, plot.top + plot.height});
    const MapPoint high = view_.MetersAt({plot.left + plot.width, plot.top});
    const double step = RoundBelow((high.x - low.x) / 5.0);
    const double bottom = plot.top + plot.height;
    for (double x = std::ceil(low.x / step) * step; x <= high.x; x += step) {
      const double at = view_.At({x, 0.0}).x;
      Line({at, plot.top}, {at, bottom}, kGrid, 1.0, "");
      Line({at, bottom}, {at, bottom + 5.0}, kInk, 1.0, "");
      Text(at, bottom + 20.0, SvgNumber(x), kInk, "middle", "");
    }
    for (double y = std::ceil(low.y / step) * step; y <= high.y; y += step) {
      const double at = view_.At({0.0, y}).y;
      Line({plot.left, at}, {plot.left + plot.width, at}, kGrid, 1.0, "");
      Line({plot.left - 5.0, at}, {plot.left, at}, kInk, 1.0, "");
      Text(plot.left - 9.0, at + 4.5, SvgNumber(y), kInk, "end", "");
    }
    Text(plot.middle().x, bottom + 38.0, "x in metres", kFaint, "middle", "");
    const double half_way = plot.middle().y;
    Text(16.0, half_way, "y in metres", kFaint, "middle",
         "transform=\"rotate(-90 16 " + SvgNumber(half_way) + ")\"");
  }

  void DrawEllipses() {
    svg_ += "<g fill=\"" + std::string(kMapEllipse) +
            "\" fill-opacity=\"0.025\" stroke=\"" + kMapEllipse +
            "\" stroke-opacity=\"" + SvgNumber(0.45 * view_.mark_size) +
            "\" stroke-width=\"0.9\">\n";
    for (const MapCheck& check : contents_.checks) {
      const MapEllipse ellipse = EllipseOf(contents_.nodes[check.node]);
      const PixelPoint at = AtNode(check.node);
      svg_ += "<ellipse rx=\"" +
              SvgNumber(ellipse.major * view_.pixels_per_meter) + "\" ry=\"" +
              SvgNumber(ellipse.minor * view_.pixels_per_meter) +
              "\" transform=\"translate(" + SvgNumber(at.x) + " " +
              SvgNumber(at.y) + ") rotate(" +
              SvgNumber(-ellipse.direction * 180.0 / kPi) + ")\"/>\n";
    }
    svg_ += "</g>\n";
  }

  void DrawLink(const PixelPoint& from, const PixelPoint& to,
                const MapStyle& style, double size) {
    Line(from, to, style.color.c_str(), 2.6 * size,
         style.dashed ? "stroke-dasharray=\"" + SvgNumber(7.0 * size) + " " +
                            SvgNumber(5.0 * size) + "\""
                      : "stroke-linecap=\"round\"");
    Circle(to, 3.2 * size, "#ffffff", style.color.c_str(), 1.8 * size);
  }

  void DrawLinkOf(const MapCheck& check) {
    const PixelPoint from = AtNode(check.node);
    const PixelPoint to = AtNode(check.candidates[0].node);
    Line(from, to, "#ffffff", 5.0 * view_.mark_size, "stroke-opacity=\"0.85\"");
    DrawLink(from, to, StyleOf(check), view_.mark_size);
  }

  // The place of a check.
  void DrawMark(const PixelPoint& at, const MapStyle& style, double size) {
    const char* color = style.color.c_str();
    if (style.link) {
      Circle(at, 4.2 * size, color, "#ffffff", 1.2 * size);
    } else {
      Circle(at, 4.4 * size, color, kInk, 1.3 * size);
    }
  }

  void DrawPair(const PixelPoint& from, const PixelPoint& to, bool confirmed,
                double size) {
    const char* color = confirmed ? kMapClosure : kMapRejection;
    Line(from, to, color, (confirmed ? 8.0 : 2.0) * size,
         confirmed ? "stroke-opacity=\"0.45\" stroke-linecap=\"round\""
                   : "stroke-dasharray=\"2 3\"");
    if (confirmed) return;
    // A cross half-way.
    const PixelPoint at = {0.5 * (from.x + to.x), 0.5 * (from.y + to.y)};
    const double arm = 4.0 * size;
    Line({at.x - arm, at.y - arm}, {at.x + arm, at.y + arm}, color, 2.0 * size,
         "");
    Line({at.x - arm, at.y + arm}, {at.x + arm, at.y - arm}, color, 2.0 * size,
         "");
  }

  // Tags at the two ends of the vehicle's own drive, on either side where they
  // lie together.
  void DrawEnds() {
    const PixelPoint start = AtNode(contents_.own_begin);
    const PixelPoint end = AtNode(contents_.nodes.size() - 1);
    const bool together =
        std::abs(start.x - end.x) < 60.0 && std::abs(start.y - end.y) < 40.0;
    const bool end_is_lower = end.y > start.y;
    DrawEnd(start, "start", kMapEstimate, !together || end_is_lower);
    DrawEnd(end, "end", "#ffffff", !together || !end_is_lower);
  }

  void DrawEnd(const PixelPoint& at, const char* label, const char* fill,
               bool label_above) {
    constexpr double kHalf = 5.5;
    Frame({at.x - kHalf, at.y - kHalf, 2.0 * kHalf, 2.0 * kHalf}, fill,
          kMapEstimate, "stroke-width=\"2\"");
    Text(at.x, at.y + (label_above ? -12.0 : 22.0), label, kInk, "middle",
         std::string("font-weight=\"bold\" ") + kHalo);
  }

  void DrawScaleBar() {
    const Rectangle& plot = view_.frame;
    const double meters = RoundBelow(0.2 * plot.width / view_.pixels_per_meter);
    const double length = meters * view_.pixels_per_meter;
    const double x = plot.left + plot.width - 18.0 - length;
    const double y = plot.top + plot.height - 18.0;
    Frame({x - 10.0, y - 24.0, length + 20.0, 34.0}, "#ffffff", "none",
          "fill-opacity=\"0.85\"");
    Line({x, y}, {x + length, y}, kInk, 2.5, "");
    Line({x, y - 5.0}, {x, y + 5.0}, kInk, 2.0, "");
    Line({x + length, y - 5.0}, {x + length, y + 5.0}, kInk, 2.0, "");
    Text(x + 0.5 * length, y - 9.0, SvgNumber(meters) + " m", kInk, "middle",
         "");
  }

  // Draws a sample, as wide as this, whose left end is at a point.
  static constexpr double kSample = 34.0;
  struct LegendEntry {
    std::string label;
    std::function<void(const PixelPoint&)> draw;
  };

  static PixelPoint RightEnd(const PixelPoint& left) {
    return {left.x + kSample, left.y};
  }
  static PixelPoint Middle(const PixelPoint& left) {
    return {left.x + 0.5 * kSample, left.y};
  }

  std::vector<LegendEntry> LegendEntries() {
    std::vector<LegendEntry> entries;
    const auto& recordings = contents_.recordings;
    if (recordings.empty()) {
      entries.push_back({"estimated trajectory", [this](const PixelPoint& at) {
                           Line(at, RightEnd(at), kMapEstimate, 2.0, "");
                         }});
    }
    // The newest ones; a legend of hundreds is none.
    constexpr std::size_t kMostNamed = 9;
    const std::size_t unnamed =
        recordings.size() > kMostNamed ? recordings.size() - kMostNamed : 0;
    if (unnamed > 0) {
      entries.push_back({absl::StrCat(unnamed, " recordings before these"),
                         [](const PixelPoint&) {}});
    }
    for (std::size_t k = unnamed; k < recordings.size(); ++k) {
      entries.push_back({recordings[k].label, [this, k](const PixelPoint& at) {
                           Line(at, RightEnd(at),
                                contents_.recordings[k].color.c_str(), 2.0, "");
                         }});
    }
    if (!contents_.truth.empty()) {
      entries.push_back({"true trajectory", [this](const PixelPoint& at) {
                           Line(at, RightEnd(at), kMapTruth, 1.2, "");
                         }});
    }
    entries.push_back(
        {"95 % uncertainty at a check", [this](const PixelPoint& at) {
           svg_ += "<ellipse cx=\"" + SvgNumber(Middle(at).x) + "\" cy=\"" +
                   SvgNumber(at.y) + "\" rx=\"16\" ry=\"8\" fill=\"" +
                   kMapEllipse + "\" fill-opacity=\"0.08\" stroke=\"" +
                   kMapEllipse + "\" stroke-opacity=\"0.7\"/>\n";
         }});
    for (const MapStyle& style : contents_.styles) {
      entries.push_back({style.label, [this, &style](const PixelPoint& at) {
                           if (style.link) DrawLink(at, RightEnd(at), style, 1);
                           DrawMark(style.link ? at : Middle(at), style, 1.0);
                         }});
    }
    for (const bool confirmed : {true, false}) {
      const auto& pairs = confirmed ? contents_.closures : contents_.rejections;
      if (pairs.empty()) continue;
      entries.push_back(
          {absl::StrCat(confirmed ? "confirmed: " : "rejected: ", pairs.size()),
           [this, confirmed](const PixelPoint& at) {
             DrawPair(at, RightEnd(at), confirmed, 1.0);
           }});
    }
    return entries;
  }

  // Column by column.
  void DrawLegend(const std::vector<LegendEntry>& entries, std::size_t rows,
                  double top) {
    constexpr double kColumn = 380.0;
    for (std::size_t i = 0; i < entries.size(); ++i) {
      const std::size_t column = i / rows;
      const PixelPoint at = {kLeft + kColumn * static_cast<double>(column),
                             top + kLegendRow * static_cast<double>(i % rows)};
      entries[i].draw(at);
      Text(at.x + kSample + 10.0, at.y + 4.5, entries[i].label, kInk, "start",
           "");
    }
  }

  const MapContents& contents_;
  // The whole map's, or the detail's while that is drawn.
  MapView view_;
  std::string svg_;
};

}  // namespace

std::string DrawMap(const MapContents& contents) {
  return Drawing(contents).Draw();
}

}  // namespace revisit::client
