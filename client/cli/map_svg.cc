#include "client/cli/map_svg.h"

#include <algorithm>
#include <cmath>
#include <cstddef>

#include "client/cli/console.h"

namespace revisit::client {
namespace {

// Sizes in pixels.
constexpr double kWidth = 1000.0;
constexpr double kLeft = 64.0;
constexpr double kRight = 24.0;
constexpr double kTop = 78.0;
constexpr double kBelowPlot = 44.0;
constexpr double kLegendHeight = 104.0;
constexpr double kPlotWidth = kWidth - kLeft - kRight;
constexpr double kMinPlotHeight = 300.0;
constexpr double kMaxPlotHeight = 1000.0;

// Quantile of chi-square with two degrees of freedom at 0.95: -2 ln 0.05.
constexpr double kEllipseScale = 5.991464547107979;

constexpr char kInk[] = "#222222";
constexpr char kFaint[] = "#6b6b6b";
constexpr char kGrid[] = "#ececec";
constexpr char kEstimate[] = "#1f3b57";
constexpr char kTruth[] = "#9a9a9a";
constexpr char kEllipse[] = "#7b68b5";
// A pair that those who cannot tell red from green can tell apart.
constexpr char kCorrect[] = "#0a8f6a";
constexpr char kWrong[] = "#d1461f";

struct Point {
  double x = 0.0;
  double y = 0.0;
};

std::string Number(double value) {
  std::string text = Fixed(value, 2);
  text.erase(text.find_last_not_of('0') + 1);
  if (text.back() == '.') text.pop_back();
  return text == "-0" ? "0" : text;
}

std::string Escaped(const std::string& text) {
  std::string escaped;
  for (const char c : text) {
    switch (c) {
      case '&':
        escaped += "&amp;";
        break;
      case '<':
        escaped += "&lt;";
        break;
      case '>':
        escaped += "&gt;";
        break;
      default:
        escaped += c;
    }
  }
  return escaped;
}

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
    const double dx = pose.x - from.x;
    const double dy = pose.y - from.y;
    moved.push_back({to.x + c * dx - s * dy, to.y + s * dx + c * dy});
  }
  return moved;
}

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
    const double height = kTop + plot_height_ + kBelowPlot + kLegendHeight;
    svg_ = "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"" +
           Number(kWidth) + "\" height=\"" + Number(height) +
           "\" viewBox=\"0 0 " + Number(kWidth) + " " + Number(height) +
           "\" font-family=\"'Helvetica Neue', Helvetica, Arial, 'DejaVu "
           "Sans', sans-serif\" font-size=\"13\">\n"
           "<title>" +
           Escaped(contents_.title) +
           "</title>\n<rect width=\"100%\" height=\"100%\" "
           "fill=\"#ffffff\"/>\n"
           "<clipPath id=\"plot\"><rect x=\"" +
           Number(kLeft) + "\" y=\"" + Number(kTop) + "\" width=\"" +
           Number(kPlotWidth) + "\" height=\"" + Number(plot_height_) +
           "\"/></clipPath>\n";
    Text(kLeft, 36.0, contents_.title, kInk, "start",
         "font-size=\"21\" font-weight=\"bold\"");
    Text(kLeft, 58.0, contents_.subtitle, kFaint, "start", "font-size=\"14\"");
    DrawGrid();
    svg_ += "<g clip-path=\"url(#plot)\">\n";
    DrawEllipses();
    Polyline(truth_, kTruth, 1.2, "");
    Polyline(estimate_, kEstimate, 2.0, "");
    DrawLinks();
    DrawChecks();
    DrawEnds();
    svg_ += "</g>\n";
    svg_ += "<rect x=\"" + Number(kLeft) + "\" y=\"" + Number(kTop) +
            "\" width=\"" + Number(kPlotWidth) + "\" height=\"" +
            Number(plot_height_) + "\" fill=\"none\" stroke=\"" + kInk +
            "\" stroke-width=\"1\"/>\n";
    DrawScaleBar();
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
    pixels_per_meter_ = std::min(kPlotWidth / width, kMaxPlotHeight / height);
    plot_height_ = std::max(kMinPlotHeight, height * pixels_per_meter_);
    middle_ = {0.5 * (low.x + high.x), 0.5 * (low.y + high.y)};
  }

  double X(double x) const {
    return kLeft + 0.5 * kPlotWidth + (x - middle_.x) * pixels_per_meter_;
  }
  double Y(double y) const {
    return kTop + 0.5 * plot_height_ - (y - middle_.y) * pixels_per_meter_;
  }

  void Text(double x, double y, const std::string& text, const char* color,
            const char* anchor, const std::string& more) {
    svg_ += "<text x=\"" + Number(x) + "\" y=\"" + Number(y) + "\" fill=\"" +
            color + "\" text-anchor=\"" + anchor + "\" " + more + ">" +
            Escaped(text) + "</text>\n";
  }

  void Line(double x1, double y1, double x2, double y2, const char* color,
            double width, const std::string& more) {
    svg_ += "<line x1=\"" + Number(x1) + "\" y1=\"" + Number(y1) + "\" x2=\"" +
            Number(x2) + "\" y2=\"" + Number(y2) + "\" stroke=\"" + color +
            "\" stroke-width=\"" + Number(width) + "\" " + more + "/>\n";
  }

  void Circle(double x, double y, double radius, const char* fill,
              const char* stroke, double width) {
    svg_ += "<circle cx=\"" + Number(x) + "\" cy=\"" + Number(y) + "\" r=\"" +
            Number(radius) + "\" fill=\"" + fill + "\" stroke=\"" + stroke +
            "\" stroke-width=\"" + Number(width) + "\"/>\n";
  }

  // Breaks where the trajectory was cut, and leaves out points too near to see.
  void Polyline(const std::vector<Point>& points, const char* color,
                double width, const std::string& more) {
    constexpr double kVisible = 0.8;
    svg_ += "<path fill=\"none\" stroke=\"" + std::string(color) +
            "\" stroke-width=\"" + Number(width) +
            "\" stroke-linejoin=\"round\" stroke-linecap=\"round\" " + more +
            " d=\"";
    Point last;
    for (std::size_t i = 0; i < points.size(); ++i) {
      const Point at = {X(points[i].x), Y(points[i].y)};
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
      svg_ += (i == 0 || cut ? "M" : "L") + Number(at.x) + " " + Number(at.y);
      last = at;
    }
    svg_ += "\"/>\n";
  }

  void DrawGrid() {
    const double step = RoundBelow(kPlotWidth / pixels_per_meter_ / 5.0);
    const double half_width = 0.5 * kPlotWidth / pixels_per_meter_;
    const double half_height = 0.5 * plot_height_ / pixels_per_meter_;
    const double bottom = kTop + plot_height_;
    for (double x = std::ceil((middle_.x - half_width) / step) * step;
         x <= middle_.x + half_width; x += step) {
      Line(X(x), kTop, X(x), bottom, kGrid, 1.0, "");
      Line(X(x), bottom, X(x), bottom + 5.0, kInk, 1.0, "");
      Text(X(x), bottom + 20.0, Number(x), kInk, "middle", "");
    }
    for (double y = std::ceil((middle_.y - half_height) / step) * step;
         y <= middle_.y + half_height; y += step) {
      Line(kLeft, Y(y), kLeft + kPlotWidth, Y(y), kGrid, 1.0, "");
      Line(kLeft - 5.0, Y(y), kLeft, Y(y), kInk, 1.0, "");
      Text(kLeft - 9.0, Y(y) + 4.5, Number(y), kInk, "end", "");
    }
    Text(kLeft + 0.5 * kPlotWidth, bottom + 38.0, "x in metres", kFaint,
         "middle", "");
    const std::string middle = Number(kTop + 0.5 * plot_height_);
    Text(16.0, kTop + 0.5 * plot_height_, "y in metres", kFaint, "middle",
         "transform=\"rotate(-90 16 " + middle + ")\"");
  }

  const GraphNode& NodeOf(const JudgedCheck& check) const {
    return contents_.nodes[static_cast<std::size_t>(check.answer.query)];
  }

  void DrawEllipses() {
    svg_ += "<g fill=\"" + std::string(kEllipse) +
            "\" fill-opacity=\"0.025\" stroke=\"" + kEllipse +
            "\" stroke-opacity=\"0.45\" stroke-width=\"0.9\">\n";
    for (const JudgedCheck& check : contents_.checks) {
      const GraphNode& node = NodeOf(check);
      const Ellipse ellipse = EllipseOf(node);
      svg_ += "<ellipse rx=\"" + Number(ellipse.major * pixels_per_meter_) +
              "\" ry=\"" + Number(ellipse.minor * pixels_per_meter_) +
              "\" transform=\"translate(" + Number(X(node.estimate.x)) + " " +
              Number(Y(node.estimate.y)) + ") rotate(" +
              Number(-ellipse.direction * 180.0 / 3.14159265358979323846) +
              ")\"/>\n";
    }
    svg_ += "</g>\n";
  }

  static const char* LinkColor(bool right) { return right ? kCorrect : kWrong; }
  static const char* LinkDashes(bool right) {
    return right ? "stroke-linecap=\"round\"" : "stroke-dasharray=\"7 5\"";
  }

  void DrawLinks() {
    for (const JudgedCheck& check : contents_.checks) {
      if (!check.accepted()) continue;
      const GraphNode& from = NodeOf(check);
      const GraphNode& to = contents_.nodes[static_cast<std::size_t>(
          check.answer.candidates[0].matched)];
      const bool right = check.top_correct();
      const double x1 = X(from.estimate.x);
      const double y1 = Y(from.estimate.y);
      const double x2 = X(to.estimate.x);
      const double y2 = Y(to.estimate.y);
      Line(x1, y1, x2, y2, "#ffffff", 5.0, "stroke-opacity=\"0.85\"");
      Line(x1, y1, x2, y2, LinkColor(right), 2.6, LinkDashes(right));
      Circle(x2, y2, 3.2, "#ffffff", LinkColor(right), 1.8);
    }
  }

  void DrawChecks() {
    for (const JudgedCheck& check : contents_.checks) {
      const double x = X(NodeOf(check).estimate.x);
      const double y = Y(NodeOf(check).estimate.y);
      if (check.accepted()) {
        Circle(x, y, 4.2, LinkColor(check.top_correct()), "#ffffff", 1.2);
      } else {
        DrawNone(x, y, check.true_loop);
      }
    }
  }

  void DrawNone(double x, double y, bool missed) {
    Circle(x, y, 4.4, missed ? "#f5b800" : "#ffffff", kInk, 1.3);
  }

  // Tags at the two ends of the drive, set apart where the ends lie together.
  void DrawEnds() {
    const Point start = {X(estimate_.front().x), Y(estimate_.front().y)};
    const Point end = {X(estimate_.back().x), Y(estimate_.back().y)};
    DrawEnd(start, "start", kEstimate, -12.0);
    const bool together =
        std::abs(start.x - end.x) < 60.0 && std::abs(start.y - end.y) < 24.0;
    DrawEnd(end, "end", "#ffffff", together ? 22.0 : -12.0);
  }

  void DrawEnd(const Point& at, const char* label, const char* fill,
               double offset) {
    constexpr double kHalf = 5.5;
    svg_ += "<rect x=\"" + Number(at.x - kHalf) + "\" y=\"" +
            Number(at.y - kHalf) + "\" width=\"" + Number(2.0 * kHalf) +
            "\" height=\"" + Number(2.0 * kHalf) + "\" fill=\"" + fill +
            "\" stroke=\"" + kEstimate + "\" stroke-width=\"2\"/>\n";
    Text(at.x, at.y + offset, label, kInk, "middle",
         "font-weight=\"bold\" stroke=\"#ffffff\" stroke-width=\"4\" "
         "stroke-linejoin=\"round\" paint-order=\"stroke\"");
  }

  void DrawScaleBar() {
    const double meters = RoundBelow(0.2 * kPlotWidth / pixels_per_meter_);
    const double length = meters * pixels_per_meter_;
    const double x = kLeft + kPlotWidth - 18.0 - length;
    const double y = kTop + plot_height_ - 18.0;
    svg_ += "<rect x=\"" + Number(x - 10.0) + "\" y=\"" + Number(y - 24.0) +
            "\" width=\"" + Number(length + 20.0) +
            "\" height=\"34\" fill=\"#ffffff\" fill-opacity=\"0.85\"/>\n";
    Line(x, y, x + length, y, kInk, 2.5, "");
    Line(x, y - 5.0, x, y + 5.0, kInk, 2.0, "");
    Line(x + length, y - 5.0, x + length, y + 5.0, kInk, 2.0, "");
    Text(x + 0.5 * length, y - 9.0, Number(meters) + " m", kInk, "middle", "");
  }

  void DrawLegend() {
    const double top = kTop + plot_height_ + kBelowPlot + 22.0;
    constexpr double kRow = 28.0;
    const double columns[] = {kLeft, kLeft + 310.0, kLeft + 610.0};
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

    svg_ += "<ellipse cx=\"" + Number(columns[0] + 0.5 * kSample) + "\" cy=\"" +
            Number(y(2)) + "\" rx=\"16\" ry=\"8\" fill=\"" + kEllipse +
            "\" fill-opacity=\"0.08\" stroke=\"" + kEllipse +
            "\" stroke-opacity=\"0.7\"/>\n";
    label(0, 2, "95 % uncertainty at a check");

    for (const bool right : {true, false}) {
      const int row = right ? 0 : 1;
      Line(columns[1], y(row), columns[1] + kSample, y(row), LinkColor(right),
           2.6, LinkDashes(right));
      Circle(columns[1], y(row), 4.2, LinkColor(right), "#ffffff", 1.2);
      Circle(columns[1] + kSample, y(row), 3.2, "#ffffff", LinkColor(right),
             1.8);
    }
    label(1, 0, "candidate accepted, right");
    label(1, 1, "candidate accepted, wrong");

    DrawNone(columns[2] + 0.5 * kSample, y(0), false);
    label(2, 0, "none accepted, no loop there");
    DrawNone(columns[2] + 0.5 * kSample, y(1), true);
    label(2, 1, "none accepted, loop missed");
  }

  const MapContents& contents_;
  const std::vector<Point> truth_;
  std::vector<Point> estimate_;
  double pixels_per_meter_ = 1.0;
  double plot_height_ = kMinPlotHeight;
  Point middle_;
  std::string svg_;
};

}  // namespace

std::string DrawMap(const MapContents& contents) {
  return Map(contents).Draw();
}

}  // namespace revisit::client
