#include "client/evaluation/calibration.h"

#include <algorithm>
#include <cmath>

namespace revisit::client {
namespace {

// The calibration error over the bins from this one on.
std::optional<double> ErrorFrom(std::size_t first,
                                const std::vector<Scored>& stated) {
  const auto bins = Reliability(stated);
  double sum = 0.0;
  std::int64_t count = 0;
  for (std::size_t i = first; i < bins.size(); ++i) {
    sum += static_cast<double>(bins[i].count) *
           std::abs(bins[i].mean_stated - bins[i].share_correct);
    count += bins[i].count;
  }
  if (count == 0) return std::nullopt;
  return sum / static_cast<double>(count);
}

}  // namespace

std::vector<CurvePoint> PrecisionRecallCurve(std::vector<Scored> scored,
                                             std::int64_t true_loops) {
  std::vector<CurvePoint> curve;
  if (true_loops <= 0) return curve;
  std::sort(scored.begin(), scored.end(),
            [](const Scored& a, const Scored& b) { return a.score > b.score; });
  std::int64_t correct = 0;
  for (std::size_t i = 0; i < scored.size(); ++i) {
    if (scored[i].correct) ++correct;
    // Candidates of equal score are chosen together.
    if (i + 1 < scored.size() && scored[i + 1].score == scored[i].score) {
      continue;
    }
    curve.push_back(
        {scored[i].score,
         static_cast<double>(correct) / static_cast<double>(i + 1),
         static_cast<double>(correct) / static_cast<double>(true_loops)});
  }
  return curve;
}

std::array<ReliabilityBin, kReliabilityBins> Reliability(
    const std::vector<Scored>& stated) {
  constexpr double kBins = static_cast<double>(kReliabilityBins);
  std::array<ReliabilityBin, kReliabilityBins> bins;
  for (std::size_t i = 0; i < bins.size(); ++i) {
    bins[i].low = static_cast<double>(i) / kBins;
    bins[i].high = static_cast<double>(i + 1) / kBins;
  }
  for (const Scored& one : stated) {
    ReliabilityBin& bin = bins[std::min(
        static_cast<std::size_t>(one.score * kBins), kReliabilityBins - 1)];
    ++bin.count;
    bin.mean_stated += one.score;
    bin.share_correct += one.correct ? 1.0 : 0.0;
  }
  for (ReliabilityBin& bin : bins) {
    if (bin.count == 0) continue;
    bin.mean_stated /= static_cast<double>(bin.count);
    bin.share_correct /= static_cast<double>(bin.count);
  }
  return bins;
}

std::optional<double> ExpectedCalibrationError(
    const std::vector<Scored>& stated) {
  return ErrorFrom(0, stated);
}

std::optional<double> PositiveCalibrationError(
    const std::vector<Scored>& stated) {
  return ErrorFrom(1, stated);
}

}  // namespace revisit::client
