#include "client/cli/evaluation/drawings.h"

#include <cstddef>
#include <filesystem>
#include <fstream>
#include <string>
#include <system_error>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "client/cli/console.h"
#include "client/cli/evaluation/calibration.h"
#include "client/cli/evaluation/evaluation_plots.h"
#include "client/cli/evaluation/map_svg.h"

namespace revisit::client {
namespace {

absl::Status Write(const std::string& path, const std::string& text) {
  std::ofstream file(path, std::ios::binary | std::ios::trunc);
  file << text;
  file.close();
  if (!file) {
    return LocalError(
        absl::UnknownError(absl::StrCat(path, ": cannot be written")));
  }
  return absl::OkStatus();
}

}  // namespace

absl::Status WriteMap(const EvaluateOptions& options,
                      const DriveResult& result) {
  if (result.nodes.empty()) {
    return LocalError(absl::FailedPreconditionError(absl::StrCat(
        result.drive, ": there is nothing to draw, the pose graph is empty")));
  }
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
  contents.nodes = result.nodes;
  contents.truth_at_nodes = result.truth_at_nodes;
  contents.one_frame = options.geodetic;
  contents.checks = result.checks;
  return Write(options.map, DrawMap(contents));
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
    curve.name = method.method;
    if (!options.sequence_lengths.empty()) {
      absl::StrAppend(&curve.name, ", ",
                      Fixed(method.sequence_length_meters, 0), " m");
    }
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
                               main.calibration_error()));
}

}  // namespace revisit::client
