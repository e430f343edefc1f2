#include "client/cli/evaluation/map_svg.h"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>

#include "absl/strings/str_cat.h"
#include "client/cli/evaluation/svg.h"
#include "client/formats/angles.h"

namespace revisit::client {
namespace {

// Sizes in pixels.
constexpr double kWidth = 1200.0;
constexpr double kLeft = 64.0;
constexpr double kRight = 24.0;
constexpr double kTop = 78.0;
constexpr double kBelowPlot = 44.0;
constexpr double kLegendHeight = 104.0;
constexpr double kPlotWidth = kWidth - kLeft - kRight;
constexpr double kMinPlotHeight = 300.0;
constexpr double kMaxPlotHeight = 1150.0;

// Quantile of chi-square with two degrees of freedom at 0.95: -2 ln 0.05.
constexpr double kEllipseScale = 5.991464547107979;

// Keeps text readable on lines.
constexpr char kHalo[] =
    "stroke=\"#ffffff\" stroke-width=\"4\" stroke-linejoin=\"round\" "
    "paint-order=\"stroke\"";

constexpr char kEstimate[] = "#1f3b57";
constexpr char kTruth[] = "#9a9a9a";
constexpr char kEllipse[] = "#7b68b5";
// Two colours that remain distinct to those who cannot tell red from green.
constexpr char kCorrect[] = "#0a8f6a";
constexpr char kWrong[] = "#d1461f";

struct Point {
  double x = 0.0;
  double y = 0.0;
};

// 1, 2 or 5 times a power of ten: the largest that is at most `value`.
double RoundBelow(double value) {
  const double power = std::pow(10.0, std::floor(std::log10(value)));
  for (const double factor : {5.0, 2.0}) {
    if (factor * power <= value) return factor * power;
  }
  return power;
}

// Half axes and the direction of the longer one, from +x counter-clockwise.
struct Ellipse {
  double major = 0.0;
  double minor = 0.0;
  double direction = 0.0;
};

Ellipse EllipseOf(const GraphNode& node) {
  const double mean = 0.5 * (node.xx + node.yy);
  const double spread = std::hypot(0.5 * (node.xx - node.yy), node.xy);
  return {std::sqrt(kEllipseScale * (mean + spread)),
          std::sqrt(kEllipseScale * std::max(0.0, mean - spread)),
          0.5 * std::atan2(2.0 * node.xy, node.xx - node.yy)};
}

// The truth in the frame of the estimate.
std::vector<Point> MoveTruth(const MapContents& contents) {
  const PlanarPose& from = contents.truth_at_nodes[0];
  const PlanarPose& to = contents.nodes[0].estimate;
  const double turn = to.heading - from.heading;
  const double c = std::cos(turn);
  const double s = std::sin(turn);
  std::vector<Point> moved;
  for (const PlanarPose& pose : contents.truth_at_nodes) {
    if (contents.one_frame) {
      moved.push_back({pose.x, pose.y});
      continue;
    }
    const double dx = pose.x - from.x;
    const double dy = pose.y - from.y;
    moved.push_back({to.x + c * dx - s * dy, to.y + s * dx + c * dy});
  }
  return moved;
}

struct Rectangle {
  double left = 0.0;
  double top = 0.0;
  double width = 0.0;
  double height = 0.0;

  bool Contains(const Point& point, double margin) const {
    return point.x >= left - margin && point.x <= left + width + margin &&
           point.y >= top - margin && point.y <= top + height + margin;
  }
};

// Maps metres to pixels.
struct View {
  // Pixels.
  Rectangle frame;
  // Metres, in the middle of the frame.
  Point middle;
  double pixels_per_meter = 1.0;
  // Marks and links, relative to the legend's.
  double mark_size = 1.0;

  Point At(const Point& meters) const {
    return {frame.left + 0.5 * frame.width +
                (meters.x - middle.x) * pixels_per_meter,
            frame.top + 0.5 * frame.height -
                (meters.y - middle.y) * pixels_per_meter};
  }
};

class Map {
 public:
  explicit Map(const MapContents& contents)
      : contents_(contents), truth_(MoveTruth(contents)) {
    for (const GraphNode& node : contents.nodes) {
      estimate_.push_back({node.estimate.x, node.estimate.y});
    }
    ChooseScale();
  }

  std::string Draw() {
    const double height =
        kTop + view_.frame.height + kBelowPlot + kLegendHeight;
    svg_ = SvgBegin(kWidth, height, contents_.title);
    Text(kLeft, 36.0, contents_.title, kInk, "start",
         "font-size=\"21\" font-weight=\"bold\"");
    Text(kLeft, 58.0, contents_.subtitle, kFaint, "start", "font-size=\"14\"");
    DrawGrid();
    DrawInside("plot");
    Frame(view_.frame, "none", kInk, "");
    DrawScaleBar();
    const std::vector<Detail> details = ChooseDetails();
    for (std::size_t i = 0; i < details.size(); ++i) {
      DrawDetail(details[i], absl::StrCat("detail", i));
    }
    DrawLegend();
    svg_ += "</svg>\n";
    return std::move(svg_);
  }

 private:
  void ChooseScale() {
    Point low = estimate_[0];
    Point high = estimate_[0];
    const auto include = [&](const Point& point) {
      low.x = std::min(low.x, point.x);
      low.y = std::min(low.y, point.y);
      high.x = std::max(high.x, point.x);
      high.y = std::max(high.y, point.y);
    };
    for (const Point& point : estimate_) include(point);
    for (const Point& point : truth_) include(point);
    // Ellipses too, unless they would make the path small.
    const double size = std::max({high.x - low.x, high.y - low.y, 1.0});
    const Point path_low = low;
    const Point path_high = high;
    for (const JudgedCheck& check : contents_.checks) {
      const GraphNode& node = NodeOf(check);
      const double across = std::sqrt(kEllipseScale * node.xx);
      const double up = std::sqrt(kEllipseScale * node.yy);
      include({node.estimate.x - across, node.estimate.y - up});
      include({node.estimate.x + across, node.estimate.y + up});
    }
    const double most = 0.2 * size;
    const double margin = 0.04 * size;
    low = {std::max(low.x, path_low.x - most) - margin,
           std::max(low.y, path_low.y - most) - margin};
    high = {std::min(high.x, path_high.x + most) + margin,
            std::min(high.y, path_high.y + most) + margin};
    const double width = high.x - low.x;
    const double height = high.y - low.y;
    view_.pixels_per_meter =
        std::min(kPlotWidth / width, kMaxPlotHeight / height);
    view_.frame = {kLeft, kTop, kPlotWidth,
                   std::max(kMinPlotHeight, height * view_.pixels_per_meter)};
    view_.middle = {0.5 * (low.x + high.x), 0.5 * (low.y + high.y)};
    view_.mark_size = MarkSize(view_.pixels_per_meter);
  }

  // Smaller marks where checks lie close together on the drawing.
  double MarkSize(double pixels_per_meter) const {
    constexpr double kRoomy = 44.0;
    constexpr double kSmallest = 0.55;
    const auto& checks = contents_.checks;
    if (checks.size() < 2) return 1.0;
    const double meters = (NodeOf(checks.back()).travelled_meters -
                           NodeOf(checks.front()).travelled_meters) /
                          static_cast<double>(checks.size() - 1);
    return std::clamp(meters * pixels_per_meter / kRoomy, kSmallest, 1.0);
  }

  Point EstimateAt(std::int64_t node) const {
    return view_.At(estimate_[static_cast<std::size_t>(node)]);
  }
  Point Start(const JudgedCheck& check) const {
    return EstimateAt(check.answer.query);
  }

  // An enlarged part of the map, in a corner where there is nothing else. It is
  // drawn where marks had to be made small.
  struct Detail {
    // On the map, in pixels.
    Rectangle source;
    Rectangle frame;
  };

  static constexpr double kEnlargement = 3.0;

  // Corners in which a square of this side hides no trajectory; not the lower
  // right, where the scale bar is.
  std::vector<Rectangle> FreeCorners(double side) const {
    constexpr double kMargin = 16.0;
    const Rectangle& plot = view_.frame;
    const double left = plot.left + kMargin;
    const double top = plot.top + kMargin;
    const double right = plot.left + plot.width - kMargin - side;
    const double bottom = plot.top + plot.height - kMargin - side;
    std::vector<Rectangle> corners;
    for (const Point& corner :
         {Point{right, top}, Point{left, bottom}, Point{left, top}}) {
      const Rectangle frame = {corner.x, corner.y, side, side};
      const auto free = [&](const Point& meters) {
        return !frame.Contains(view_.At(meters), kMargin);
      };
      if (std::all_of(estimate_.begin(), estimate_.end(), free) &&
          std::all_of(truth_.begin(), truth_.end(), free)) {
        corners.push_back(frame);
      }
    }
    return corners;
  }

  // Total length of the links that lie in a window; wrong ones count for more,
  // since they are what a reader looks for.
  double LinksShown(const Rectangle& window) const {
    double shown = 0.0;
    for (const JudgedCheck& check : contents_.checks) {
      if (!check.accepted()) continue;
      const Point from = Start(check);
      const Point to = EstimateAt(check.answer.candidates[0].matched);
      if (!window.Contains(from, 0.0) || !window.Contains(to, 0.0)) continue;
      shown += std::hypot(from.x - to.x, from.y - to.y) *
               (check.top_correct() ? 1.0 : 3.0);
    }
    return shown;
  }

  std::vector<Detail> ChooseDetails() const {
    constexpr double kCrowded = 0.8;
    constexpr std::size_t kMost = 2;
    std::vector<Detail> details;
    if (view_.mark_size >= kCrowded) return details;
    const double side = 0.36 * std::min(view_.frame.width, view_.frame.height);
    const double source_side = side / kEnlargement;
    for (const Rectangle& frame : FreeCorners(side)) {
      if (details.size() == kMost) break;
      double most_shown = 0.0;
      Rectangle best;
      for (const JudgedCheck& middle : contents_.checks) {
        if (!middle.accepted()) continue;
        const Point at = Start(middle);
        const Rectangle window = {at.x - 0.5 * source_side,
                                  at.y - 0.5 * source_side, source_side,
                                  source_side};
        const bool taken = std::any_of(
            details.begin(), details.end(), [&](const Detail& detail) {
              return std::abs(detail.source.left - window.left) < source_side &&
                     std::abs(detail.source.top - window.top) < source_side;
            });
        const double shown = taken ? 0.0 : LinksShown(window);
        if (shown > most_shown) {
          most_shown = shown;
          best = window;
        }
      }
      if (most_shown > 0.0) details.push_back({best, frame});
    }
    return details;
  }

  void DrawDetail(const Detail& detail, const std::string& name) {
    Frame(detail.source, "none", kInk, "stroke-dasharray=\"2 2\"");
    const View whole = view_;
    const Point middle = {detail.source.left + 0.5 * detail.source.width,
                          detail.source.top + 0.5 * detail.source.height};
    view_.middle = {whole.middle.x + (middle.x - whole.frame.left -
                                      0.5 * whole.frame.width) /
                                         whole.pixels_per_meter,
                    whole.middle.y - (middle.y - whole.frame.top -
                                      0.5 * whole.frame.height) /
                                         whole.pixels_per_meter};
    view_.frame = detail.frame;
    view_.pixels_per_meter *= kEnlargement;
    view_.mark_size = MarkSize(view_.pixels_per_meter);
    // From the part to its enlargement, where they are nearest.
    const auto clamp_to = [](const Rectangle& rectangle, const Point& point) {
      return Point{
          std::clamp(point.x, rectangle.left, rectangle.left + rectangle.width),
          std::clamp(point.y, rectangle.top, rectangle.top + rectangle.height)};
    };
    const Point from =
        clamp_to(detail.source, {detail.frame.left + 0.5 * detail.frame.width,
                                 detail.frame.top + 0.5 * detail.frame.height});
    const Point to = clamp_to(detail.frame, from);
    Line(from.x, from.y, to.x, to.y, kInk, 1.0, "stroke-dasharray=\"2 2\"");
    Frame(detail.frame, "#ffffff", "none", "");
    DrawInside(name);
    Frame(detail.frame, "none", kInk, "");
    Text(detail.frame.left + 8.0, detail.frame.top + 18.0,
         "enlarged " + SvgNumber(kEnlargement) + " times", kFaint, "start",
         kHalo);
    view_ = whole;
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
    Polyline(truth_, kTruth, 1.2);
    Polyline(estimate_, kEstimate, 0.8 + 1.2 * view_.mark_size);
    DrawLinks();
    DrawChecks();
    DrawEnds();
    svg_ += "</g>\n";
  }

  void Text(double x, double y, const std::string& text, const char* color,
            const char* anchor, const std::string& more) {
    svg_ += SvgText(x, y, text, color, anchor, more);
  }

  void Line(double x1, double y1, double x2, double y2, const char* color,
            double width, const std::string& more) {
    svg_ += SvgLine(x1, y1, x2, y2, color, width, more);
  }

  void Circle(double x, double y, double radius, const char* fill,
              const char* stroke, double width) {
    svg_ += SvgCircle(x, y, radius, fill, stroke, width);
  }

  // Breaks where the trajectory was cut, and leaves out points too near to see.
  void Polyline(const std::vector<Point>& points, const char* color,
                double width) {
    constexpr double kVisible = 0.8;
    svg_ += "<path fill=\"none\" stroke=\"" + std::string(color) +
            "\" stroke-width=\"" + SvgNumber(width) +
            "\" stroke-linejoin=\"round\" stroke-linecap=\"round\" d=\"";
    Point last;
    for (std::size_t i = 0; i < points.size(); ++i) {
      const Point at = view_.At(points[i]);
      // A jump adds no distance.
      const bool cut =
          i > 0 && std::hypot(points[i].x - points[i - 1].x,
                              points[i].y - points[i - 1].y) >
                       3.0 * (contents_.nodes[i].travelled_meters -
                              contents_.nodes[i - 1].travelled_meters) +
                           10.0;
      if (i > 0 && !cut && i + 1 < points.size() &&
          std::hypot(at.x - last.x, at.y - last.y) < kVisible) {
        continue;
      }
      svg_ +=
          (i == 0 || cut ? "M" : "L") + SvgNumber(at.x) + " " + SvgNumber(at.y);
      last = at;
    }
    svg_ += "\"/>\n";
  }

  void DrawGrid() {
    const Rectangle& plot = view_.frame;
    const Point& middle = view_.middle;
    const double half_width = 0.5 * plot.width / view_.pixels_per_meter;
    const double half_height = 0.5 * plot.height / view_.pixels_per_meter;
    const double step = RoundBelow(half_width / 2.5);
    const double bottom = plot.top + plot.height;
    for (double x = std::ceil((middle.x - half_width) / step) * step;
         x <= middle.x + half_width; x += step) {
      const double at = view_.At({x, 0.0}).x;
      Line(at, plot.top, at, bottom, kGrid, 1.0, "");
      Line(at, bottom, at, bottom + 5.0, kInk, 1.0, "");
      Text(at, bottom + 20.0, SvgNumber(x), kInk, "middle", "");
    }
    for (double y = std::ceil((middle.y - half_height) / step) * step;
         y <= middle.y + half_height; y += step) {
      const double at = view_.At({0.0, y}).y;
      Line(plot.left, at, plot.left + plot.width, at, kGrid, 1.0, "");
      Line(plot.left - 5.0, at, plot.left, at, kInk, 1.0, "");
      Text(plot.left - 9.0, at + 4.5, SvgNumber(y), kInk, "end", "");
    }
    Text(plot.left + 0.5 * plot.width, bottom + 38.0, "x in metres", kFaint,
         "middle", "");
    const double half_way = plot.top + 0.5 * plot.height;
    Text(16.0, half_way, "y in metres", kFaint, "middle",
         "transform=\"rotate(-90 16 " + SvgNumber(half_way) + ")\"");
  }

  const GraphNode& NodeOf(const JudgedCheck& check) const {
    return contents_.nodes[static_cast<std::size_t>(check.answer.query)];
  }

  void DrawEllipses() {
    svg_ += "<g fill=\"" + std::string(kEllipse) +
            "\" fill-opacity=\"0.025\" stroke=\"" + kEllipse +
            "\" stroke-opacity=\"" + SvgNumber(0.45 * view_.mark_size) +
            "\" stroke-width=\"0.9\">\n";
    for (const JudgedCheck& check : contents_.checks) {
      const Ellipse ellipse = EllipseOf(NodeOf(check));
      const Point at = Start(check);
      svg_ += "<ellipse rx=\"" +
              SvgNumber(ellipse.major * view_.pixels_per_meter) + "\" ry=\"" +
              SvgNumber(ellipse.minor * view_.pixels_per_meter) +
              "\" transform=\"translate(" + SvgNumber(at.x) + " " +
              SvgNumber(at.y) + ") rotate(" +
              SvgNumber(-ellipse.direction * 180.0 / kPi) + ")\"/>\n";
    }
    svg_ += "</g>\n";
  }

  static const char* LinkColor(bool right) { return right ? kCorrect : kWrong; }

  void DrawLink(double x1, double y1, double x2, double y2, bool right,
                double size) {
    Line(x1, y1, x2, y2, LinkColor(right), 2.6 * size,
         right ? "stroke-linecap=\"round\""
               : "stroke-dasharray=\"" + SvgNumber(7.0 * size) + " " +
                     SvgNumber(5.0 * size) + "\"");
    Circle(x2, y2, 3.2 * size, "#ffffff", LinkColor(right), 1.8 * size);
  }

  void DrawLinkStart(double x, double y, bool right, double size) {
    Circle(x, y, 4.2 * size, LinkColor(right), "#ffffff", 1.2 * size);
  }

  void DrawNone(double x, double y, bool missed, double size) {
    Circle(x, y, 4.4 * size, missed ? "#f5b800" : "#ffffff", kInk, 1.3 * size);
  }

  void DrawLinks() {
    for (const JudgedCheck& check : contents_.checks) {
      if (!check.accepted()) continue;
      const Point from = Start(check);
      const Point to = EstimateAt(check.answer.candidates[0].matched);
      Line(from.x, from.y, to.x, to.y, "#ffffff", 5.0 * view_.mark_size,
           "stroke-opacity=\"0.85\"");
      DrawLink(from.x, from.y, to.x, to.y, check.top_correct(),
               view_.mark_size);
    }
  }

  void DrawChecks() {
    for (const JudgedCheck& check : contents_.checks) {
      const Point at = Start(check);
      if (check.accepted()) {
        DrawLinkStart(at.x, at.y, check.top_correct(), view_.mark_size);
      } else {
        DrawNone(at.x, at.y, check.true_loop, view_.mark_size);
      }
    }
  }

  // Tags at the two ends of the drive, on either side where they lie together.
  void DrawEnds() {
    const Point start = view_.At(estimate_.front());
    const Point end = view_.At(estimate_.back());
    const bool together =
        std::abs(start.x - end.x) < 60.0 && std::abs(start.y - end.y) < 40.0;
    const bool end_is_lower = end.y > start.y;
    DrawEnd(start, "start", kEstimate, !together || end_is_lower);
    DrawEnd(end, "end", "#ffffff", !together || !end_is_lower);
  }

  void DrawEnd(const Point& at, const char* label, const char* fill,
               bool label_above) {
    constexpr double kHalf = 5.5;
    svg_ += "<rect x=\"" + SvgNumber(at.x - kHalf) + "\" y=\"" +
            SvgNumber(at.y - kHalf) + "\" width=\"" + SvgNumber(2.0 * kHalf) +
            "\" height=\"" + SvgNumber(2.0 * kHalf) + "\" fill=\"" + fill +
            "\" stroke=\"" + kEstimate + "\" stroke-width=\"2\"/>\n";
    Text(at.x, at.y + (label_above ? -12.0 : 22.0), label, kInk, "middle",
         std::string("font-weight=\"bold\" ") + kHalo);
  }

  void DrawScaleBar() {
    const Rectangle& plot = view_.frame;
    const double meters = RoundBelow(0.2 * plot.width / view_.pixels_per_meter);
    const double length = meters * view_.pixels_per_meter;
    const double x = plot.left + plot.width - 18.0 - length;
    const double y = plot.top + plot.height - 18.0;
    svg_ += "<rect x=\"" + SvgNumber(x - 10.0) + "\" y=\"" +
            SvgNumber(y - 24.0) + "\" width=\"" + SvgNumber(length + 20.0) +
            "\" height=\"34\" fill=\"#ffffff\" fill-opacity=\"0.85\"/>\n";
    Line(x, y, x + length, y, kInk, 2.5, "");
    Line(x, y - 5.0, x, y + 5.0, kInk, 2.0, "");
    Line(x + length, y - 5.0, x + length, y + 5.0, kInk, 2.0, "");
    Text(x + 0.5 * length, y - 9.0, SvgNumber(meters) + " m", kInk, "middle",
         "");
  }

  void DrawLegend() {
    const double top = kTop + view_.frame.height + kBelowPlot + 22.0;
    constexpr double kRow = 28.0;
    const double columns[] = {kLeft, kLeft + 380.0, kLeft + 760.0};
    constexpr double kSample = 34.0;
    const auto label = [&](int column, int row, const char* text) {
      Text(columns[column] + kSample + 10.0, top + row * kRow + 4.5, text, kInk,
           "start", "");
    };
    const auto y = [&](int row) { return top + row * kRow; };

    Line(columns[0], y(0), columns[0] + kSample, y(0), kEstimate, 2.0, "");
    label(0, 0, "estimated trajectory");
    Line(columns[0], y(1), columns[0] + kSample, y(1), kTruth, 1.2, "");
    label(0, 1, "true trajectory");

    svg_ += "<ellipse cx=\"" + SvgNumber(columns[0] + 0.5 * kSample) +
            "\" cy=\"" + SvgNumber(y(2)) + "\" rx=\"16\" ry=\"8\" fill=\"" +
            kEllipse + "\" fill-opacity=\"0.08\" stroke=\"" + kEllipse +
            "\" stroke-opacity=\"0.7\"/>\n";
    label(0, 2, "95 % uncertainty at a check");

    for (const bool right : {true, false}) {
      const int row = right ? 0 : 1;
      DrawLink(columns[1], y(row), columns[1] + kSample, y(row), right, 1.0);
      DrawLinkStart(columns[1], y(row), right, 1.0);
    }
    label(1, 0, "candidate accepted, right");
    label(1, 1, "candidate accepted, wrong");

    DrawNone(columns[2] + 0.5 * kSample, y(0), false, 1.0);
    label(2, 0, "none accepted, no loop there");
    DrawNone(columns[2] + 0.5 * kSample, y(1), true, 1.0);
    label(2, 1, "none accepted, loop missed");
  }

  const MapContents& contents_;
  const std::vector<Point> truth_;
  std::vector<Point> estimate_;
  // The whole map's, or the detail's while that is drawn.
  View view_;
  std::string svg_;
};

}  // namespace

std::string DrawMap(const MapContents& contents) {
  return Map(contents).Draw();
}

}  // namespace revisit::client
