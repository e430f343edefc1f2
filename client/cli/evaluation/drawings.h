// The SVG files of an evaluation.
#ifndef REVISIT_CLIENT_CLI_EVALUATION_DRAWINGS_H_
#define REVISIT_CLIENT_CLI_EVALUATION_DRAWINGS_H_

#include "absl/status/status.h"
#include "client/cli/evaluation/evaluate_options.h"
#include "client/cli/evaluation/evaluation_report.h"

namespace revisit::client {

// Writes `options.map`.
absl::Status WriteMap(const EvaluateOptions& options,
                      const DriveResult& result);

// Writes both plots into `options.plots`.
absl::Status WritePlots(const EvaluateOptions& options, const Report& report);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_EVALUATION_DRAWINGS_H_
