// The drawings of an evaluation.
#ifndef REVISIT_CLIENT_EVALUATION_DRAWINGS_H_
#define REVISIT_CLIENT_EVALUATION_DRAWINGS_H_

#include <string>

#include "absl/status/status.h"
#include "client/evaluation/evaluate_options.h"
#include "client/evaluation/evaluation_report.h"
#include "client/map/map_contents.h"

namespace revisit::client {

// A drive with its truth, checks by whether they are right. The truth is moved
// so that it begins at the estimate's first pose, unless the two are in one
// frame. REQUIRES: at least one node.
MapContents JudgedMap(const DriveResult& result, bool one_frame);

// Writes a map: a page for a browser if the file's name ends in .html,
// otherwise SVG.
absl::Status WriteMapFile(const std::string& file, const MapContents& contents);

// Writes `options.map`.
absl::Status WriteMap(const EvaluateOptions& options,
                      const DriveResult& result);

// Writes both plots into `options.plots`.
absl::Status WritePlots(const EvaluateOptions& options, const Report& report);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_EVALUATION_DRAWINGS_H_
