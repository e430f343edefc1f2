// How well stated confidence agrees with the truth.
//
// Precision-recall: a check's first candidate counts as chosen if its score
// reaches a threshold; precision and recall as in evaluation.h, over all
// thresholds.
//
// Reliability: stated probabilities are sorted into ten bins of equal width;
// in each, their mean is compared with the share that was correct. The expected
// calibration error is the mean absolute difference, weighed by the bins'
// counts:
//
//   ECE = sum over bins of n_b / n |mean stated_b - share correct_b|
//
// Most checks of a drive are no loops and stated near 0, which is easy and
// makes this error small. The same sum without the first bin, n being the count
// of the other nine, is therefore what statements are judged by.
#ifndef REVISIT_CLIENT_EVALUATION_CALIBRATION_H_
#define REVISIT_CLIENT_EVALUATION_CALIBRATION_H_

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <vector>

namespace revisit::client {

// How sure a method was of one candidate (the higher the score, the surer), and
// whether the candidate was correct.
struct Scored {
  double score = 0.0;
  bool correct = false;
};

struct CurvePoint {
  double threshold = 0.0;
  double precision = 0.0;
  double recall = 0.0;
};

// A point for each different score, from the highest on. Recall is not capped:
// it refers to `true_loops`. Empty if there are none of either.
std::vector<CurvePoint> PrecisionRecallCurve(std::vector<Scored> scored,
                                             std::int64_t true_loops);

inline constexpr std::size_t kReliabilityBins = 10;

// Probabilities in [low, high); the last bin has 1 too. Means of an empty bin
// are 0.
struct ReliabilityBin {
  double low = 0.0;
  double high = 0.0;
  std::int64_t count = 0;
  double mean_stated = 0.0;
  double share_correct = 0.0;
};

// REQUIRES: scores in [0, 1].
std::array<ReliabilityBin, kReliabilityBins> Reliability(
    const std::vector<Scored>& stated);

// Absent if nothing was stated. REQUIRES: scores in [0, 1].
std::optional<double> ExpectedCalibrationError(
    const std::vector<Scored>& stated);

// The same over what is stated at 0.1 or more. Absent if nothing is. REQUIRES:
// scores in [0, 1].
std::optional<double> PositiveCalibrationError(
    const std::vector<Scored>& stated);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_EVALUATION_CALIBRATION_H_
