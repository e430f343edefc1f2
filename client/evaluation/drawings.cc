#include "client/evaluation/drawings.h"

#include <cmath>
#include <cstddef>
#include <filesystem>
#include <string>
#include <system_error>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "client/answers/names.h"
#include "client/evaluation/calibration.h"
#include "client/evaluation/evaluation_plots.h"
#include "client/map/map_contents.h"
#include "client/map/map_html.h"
#include "client/map/map_svg.h"
#include "client/terminal/output_file.h"
#include "client/terminal/terminal.h"

namespace revisit::client {
namespace {

absl::Status Write(const std::string& path, const std::string& text) {
  OutputFile file(path);
  if (absl::Status opened = file.Open(); !opened.ok()) return opened;
  file.stream() << text;
  return file.Finish();
}

// The truth in the frame of the estimate.
std::vector<MapPoint> MoveTruth(const DriveResult& result, bool one_frame) {
  const PlanarPose& from = result.truth_at_nodes[0];
  const PlanarPose& to = result.nodes[0].estimate;
  const double turn = to.heading - from.heading;
  const double c = std::cos(turn);
  const double s = std::sin(turn);
  std::vector<MapPoint> moved;
  for (const PlanarPose& pose : result.truth_at_nodes) {
    if (one_frame) {
      moved.push_back({pose.x, pose.y});
      continue;
    }
    const double dx = pose.x - from.x;
    const double dy = pose.y - from.y;
    moved.push_back({to.x + c * dx - s * dy, to.y + s * dx + c * dy});
  }
  return moved;
}

// Indices of JudgedStyles().
enum JudgedStyle : std::size_t { kRight, kWrong, kNoLoop, kMissed };

std::vector<MapStyle> JudgedStyles() {
  // Two colours that remain distinct to those who cannot tell red from green.
  constexpr char kRightColor[] = "#0a8f6a";
  constexpr char kWrongColor[] = "#d1461f";
  return {{"candidate accepted, right", kRightColor, true, false, 1.0},
          {"candidate accepted, wrong", kWrongColor, true, true, 3.0},
          {"none accepted, no loop there", "#ffffff", false, false, 0.0},
          {"none accepted, loop missed", "#f5b800", false, false, 0.0}};
}

std::size_t StyleOf(const JudgedCheck& check) {
  if (check.accepted()) return check.top_correct() ? kRight : kWrong;
  return check.true_loop ? kMissed : kNoLoop;
}

MapCheck CheckOf(const JudgedCheck& judged) {
  MapCheck check;
  check.node = static_cast<std::size_t>(judged.answer.query);
  check.style = StyleOf(judged);
  check.empty_reason = judged.answer.empty_reason;
  for (const CandidateAnswer& answer : judged.answer.candidates) {
    MapCandidate candidate;
    candidate.node = static_cast<std::size_t>(answer.matched);
    candidate.verdict = NameOf(answer.verdict);
    candidate.opposite = answer.opposite;
    candidate.probability = answer.probability;
    candidate.meters_before = answer.meters_before;
    candidate.meters_after = answer.meters_after;
    candidate.gate = !answer.has_gate   ? "none"
                     : answer.path_gate ? "path"
                                        : "end";
    candidate.squared_distance = answer.squared_distance;
    candidate.threshold = answer.threshold;
    candidate.p_value = answer.p_value;
    check.candidates.push_back(std::move(candidate));
  }
  return check;
}

}  // namespace

MapContents JudgedMap(const DriveResult& result, bool one_frame) {
  const Tally& t = result.tally;
  MapContents contents;
  contents.title = absl::StrCat("Loop-closure candidates: ", result.drive);
  contents.subtitle = absl::StrCat(
      Fixed(result.nodes.back().travelled_meters / 1000.0, 1), " km, ",
      t.checks, " checks, ", t.true_loops, " true loops; ", t.accepted,
      " candidates accepted, ", t.accepted_correct, " of them right");
  if (t.precision().has_value() && t.recall().has_value()) {
    absl::StrAppend(&contents.subtitle, " (precision ",
                    Fixed(*t.precision(), 2), ", recall ",
                    Fixed(*t.recall(), 2), ")");
  }
  for (const GraphNode& node : result.nodes) {
    MapNode shown;
    shown.sequence = node.sequence;
    shown.travelled_meters = node.travelled_meters;
    shown.at = {node.estimate.x, node.estimate.y};
    shown.xx = node.xx;
    shown.xy = node.xy;
    shown.yy = node.yy;
    contents.nodes.push_back(std::move(shown));
  }
  contents.truth = MoveTruth(result, one_frame);
  contents.styles = JudgedStyles();
  for (const JudgedCheck& check : result.checks) {
    contents.checks.push_back(CheckOf(check));
  }
  return contents;
}

absl::Status WriteMapFile(const std::string& file,
                          const MapContents& contents) {
  return Write(file, std::filesystem::path(file).extension() == ".html"
                         ? MapPage(contents)
                         : DrawMap(contents));
}

absl::Status WriteMap(const EvaluateOptions& options,
                      const DriveResult& result) {
  if (result.nodes.empty()) {
    return LocalError(absl::FailedPreconditionError(absl::StrCat(
        result.drive, ": there is nothing to draw, the pose graph is empty")));
  }
  // Fixes and their reference are in one frame already.
  return WriteMapFile(
      options.map,
      JudgedMap(result, options.geodetic || options.fix_noise.has_value()));
}

absl::Status WritePlots(const EvaluateOptions& options, const Report& report) {
  std::error_code error;
  std::filesystem::create_directories(options.plots, error);
  if (error) {
    return LocalError(
        absl::UnknownError(absl::StrCat(options.plots, ": ", error.message())));
  }
  const Tally main = TotalOf(report.methods[report.main]);
  const std::size_t drives = report.methods[report.main].drives.size();
  const std::string subtitle =
      absl::StrCat(drives, drives == 1 ? " drive, " : " drives, ", main.checks,
                   " checks, ", main.true_loops, " true loops");
  std::vector<PlottedCurve> curves;
  for (const MethodResult& method : report.methods) {
    const Tally total = TotalOf(method);
    PlottedCurve curve;
    curve.name = NameAmong(report.methods, method);
    curve.curve = PrecisionRecallCurve(total.confidences, total.true_loops);
    curve.precision = total.precision();
    curve.recall = total.recall();
    curves.push_back(std::move(curve));
  }
  const std::string directory = options.plots + "/";
  if (absl::Status written = Write(directory + "precision_recall.svg",
                                   DrawPrecisionRecall(subtitle, curves));
      !written.ok()) {
    return written;
  }
  return Write(directory + "reliability.svg",
               DrawReliability(subtitle, Reliability(main.probabilities),
                               main.calibration_error(),
                               main.positive_calibration_error()));
}

}  // namespace revisit::client
