// Drawings of how well candidates are ranked and how true their probabilities
// are.
#ifndef REVISIT_CLIENT_EVALUATION_EVALUATION_PLOTS_H_
#define REVISIT_CLIENT_EVALUATION_EVALUATION_PLOTS_H_

#include <array>
#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "client/evaluation/calibration.h"

namespace revisit::client {

struct PlottedCurve {
  std::string name;
  std::vector<CurvePoint> curve;
  // Precision and recall of the verdicts themselves, where they accepted
  // anything.
  std::optional<double> precision;
  std::optional<double> recall;
};

// An SVG document: precision against recall, a line for each curve with a dot
// where its verdicts stand.
std::string DrawPrecisionRecall(const std::string& subtitle,
                                const std::vector<PlottedCurve>& curves);

// An SVG document: the share that was correct against the stated probability,
// a bar for each bin with its count; perfect statements lie on the diagonal.
// `positive_error` is that of what is stated at 0.1 or more (calibration.h).
std::string DrawReliability(
    const std::string& subtitle,
    const std::array<ReliabilityBin, kReliabilityBins>& bins,
    std::optional<double> expected_calibration_error,
    std::optional<double> positive_error);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_EVALUATION_EVALUATION_PLOTS_H_
