#include "client/evaluation/evaluation_plots.h"

#include <algorithm>
#include <cmath>
#include <cstddef>

#include "absl/strings/str_cat.h"
#include "client/map/svg.h"
#include "client/terminal/terminal.h"

namespace revisit::client {
namespace {

// Sizes in pixels. Both axes go from 0 to 1.
constexpr double kPlotLeft = 72.0;
constexpr double kPlotTop = 78.0;
constexpr double kSide = 520.0;
constexpr double kBelow = 62.0;
constexpr double kPlotRight = 32.0;
constexpr double kLegendRow = 26.0;

// Colours that stay apart for those who do not see all of them (Okabe and Ito),
// and dashes that stay apart in grey.
struct Style {
  const char* color;
  const char* dashes;
};
constexpr Style kStyles[] = {{"#0072b2", ""},    {"#d55e00", "9 4"},
                             {"#009e73", "2 3"}, {"#cc79a7", "9 3 2 3"},
                             {"#e69f00", "5 3"}, {"#56b4e9", "12 3"},
                             {"#222222", "1 4"}, {"#8c6d31", "6 2 1 2"}};

double X(double value) { return kPlotLeft + kSide * value; }
double Y(double value) { return kPlotTop + kSide * (1.0 - value); }

std::string PlotFrame(const std::string& title, const std::string& subtitle,
                      double height, const std::string& x_label,
                      const std::string& y_label) {
  std::string svg = SvgBegin(kPlotLeft + kSide + kPlotRight, height, title);
  svg += SvgText(kPlotLeft, 36.0, title, kInk, "start",
                 "font-size=\"21\" font-weight=\"bold\"");
  svg += SvgText(kPlotLeft, 58.0, subtitle, kFaint, "start", "");
  for (int i = 0; i <= 10; i += 2) {
    const double value = 0.1 * i;
    svg += SvgLine(X(value), Y(0.0), X(value), Y(1.0), kGrid, 1.0, "");
    svg += SvgLine(X(0.0), Y(value), X(1.0), Y(value), kGrid, 1.0, "");
    svg +=
        SvgText(X(value), Y(0.0) + 20.0, SvgNumber(value), kInk, "middle", "");
    svg += SvgText(X(0.0) - 9.0, Y(value) + 4.5, SvgNumber(value), kInk, "end",
                   "");
  }
  svg += SvgText(X(0.5), Y(0.0) + 44.0, x_label, kFaint, "middle", "");
  svg += SvgText(24.0, Y(0.5), y_label, kFaint, "middle",
                 "transform=\"rotate(-90 24 " + SvgNumber(Y(0.5)) + ")\"");
  return svg;
}

std::string Border() {
  return "<rect x=\"" + SvgNumber(X(0.0)) + "\" y=\"" + SvgNumber(Y(1.0)) +
         "\" width=\"" + SvgNumber(kSide) + "\" height=\"" + SvgNumber(kSide) +
         "\" fill=\"none\" stroke=\"" + kInk + "\"/>\n";
}

std::string Dashes(const Style& style) {
  return style.dashes[0] == '\0'
             ? ""
             : "stroke-dasharray=\"" + std::string(style.dashes) + "\"";
}

constexpr char kBar[] = "#0072b2";

using Bins = std::array<ReliabilityBin, kReliabilityBins>;

std::string Bars(const Bins& bins) {
  std::string svg;
  for (const ReliabilityBin& bin : bins) {
    if (bin.count == 0) continue;
    const double top = Y(bin.share_correct);
    svg += "<rect x=\"" + SvgNumber(X(bin.low) + 1.5) + "\" y=\"" +
           SvgNumber(top) + "\" width=\"" +
           SvgNumber(kSide * (bin.high - bin.low) - 3.0) + "\" height=\"" +
           SvgNumber(Y(0.0) - top) + "\" fill=\"" + kBar +
           "\" fill-opacity=\"0.28\" stroke=\"" + kBar + "\"/>\n";
  }
  return svg;
}

// Dots at the mean statements, and how many candidates each bin has.
std::string Dots(const Bins& bins) {
  std::string svg;
  for (const ReliabilityBin& bin : bins) {
    if (bin.count == 0) continue;
    svg += SvgCircle(X(bin.mean_stated), Y(bin.share_correct), 4.5, kBar,
                     "#ffffff", 1.5);
    svg += SvgText(X(0.5 * (bin.low + bin.high)), Y(0.0) - 9.0,
                   absl::StrCat(bin.count), kInk, "middle",
                   "stroke=\"#ffffff\" stroke-width=\"4\" "
                   "stroke-linejoin=\"round\" paint-order=\"stroke\"");
  }
  return svg;
}

std::string ErrorText(std::optional<double> expected_calibration_error,
                      std::optional<double> positive_error) {
  std::string error = "No probability was stated.";
  if (expected_calibration_error.has_value()) {
    error =
        "Expected calibration error " + Fixed(*expected_calibration_error, 3);
    if (positive_error.has_value()) {
      error += ", where stated at 0.1 or more " + Fixed(*positive_error, 3);
    }
    error += ". Numbers: candidates of each bin.";
  }
  return error;
}

}  // namespace

std::string DrawPrecisionRecall(const std::string& subtitle,
                                const std::vector<PlottedCurve>& curves) {
  const double rows = static_cast<double>(curves.size()) + 1.0;
  std::string svg = PlotFrame(
      "Precision and recall", subtitle,
      kPlotTop + kSide + kBelow + rows * kLegendRow + 10.0,
      "recall: right, of the true loops", "precision: right, of those chosen");
  for (std::size_t i = 0; i < curves.size(); ++i) {
    const Style& style = kStyles[i % std::size(kStyles)];
    if (!curves[i].curve.empty()) {
      svg += "<path fill=\"none\" stroke=\"" + std::string(style.color) +
             "\" stroke-width=\"2\" stroke-linejoin=\"round\" " +
             Dashes(style) + " d=\"";
      for (std::size_t k = 0; k < curves[i].curve.size(); ++k) {
        const CurvePoint& point = curves[i].curve[k];
        svg += (k == 0 ? "M" : "L") + SvgNumber(X(point.recall)) + " " +
               SvgNumber(Y(point.precision));
      }
      svg += "\"/>\n";
    }
    if (curves[i].precision.has_value() && curves[i].recall.has_value()) {
      svg += SvgCircle(X(*curves[i].recall), Y(*curves[i].precision), 5.0,
                       style.color, "#ffffff", 1.5);
    }
  }
  svg += Border();
  double y = kPlotTop + kSide + kBelow + 12.0;
  for (std::size_t i = 0; i < curves.size(); ++i) {
    const Style& style = kStyles[i % std::size(kStyles)];
    svg += SvgLine(kPlotLeft, y, kPlotLeft + 40.0, y, style.color, 2.0,
                   Dashes(style));
    svg +=
        SvgText(kPlotLeft + 52.0, y + 4.5, curves[i].name, kInk, "start", "");
    y += kLegendRow;
  }
  svg += SvgCircle(kPlotLeft + 20.0, y, 5.0, kFaint, "#ffffff", 1.5);
  svg += SvgText(kPlotLeft + 52.0, y + 4.5,
                 "where the method's own verdicts stand", kFaint, "start", "");
  return svg + "</svg>\n";
}

std::string DrawReliability(
    const std::string& subtitle,
    const std::array<ReliabilityBin, kReliabilityBins>& bins,
    std::optional<double> expected_calibration_error,
    std::optional<double> positive_error) {
  std::string svg =
      PlotFrame("Reliability of stated probabilities", subtitle,
                kPlotTop + kSide + kBelow + 2.0 * kLegendRow + 10.0,
                "probability stated for the first candidate",
                "share of these candidates that are right");
  svg += Bars(bins);
  svg += SvgLine(X(0.0), Y(0.0), X(1.0), Y(1.0), kFaint, 1.2,
                 "stroke-dasharray=\"6 4\"");
  svg += Dots(bins);
  svg += Border();
  const std::string error =
      ErrorText(expected_calibration_error, positive_error);
  const double y = kPlotTop + kSide + kBelow + 12.0;
  svg += SvgText(kPlotLeft, y + 4.5, error, kInk, "start", "");
  svg +=
      SvgText(kPlotLeft, y + kLegendRow + 4.5,
              "Bars: share right. Dots: at the bin's mean statement. Dashed: "
              "as it should be.",
              kFaint, "start", "");
  return svg + "</svg>\n";
}

}  // namespace revisit::client
