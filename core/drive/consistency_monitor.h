// Whether the claimed covariances are as large as the errors that confirmed
// loop closures have shown.
//
// A confirmed pair is one place, so its difference d has the distribution
// N(0, f^2 Gamma + R), with f the factor by which the claimed standard
// deviations are too small. f is estimated from all confirmed pairs, in the
// order in which they came, as the posterior mean of ln f on [0, ln max]. The
// standard deviation of the normal prior is a factor of two. Pairs within the
// gate may have been looked at only because they are within it, so their
// likelihood is that of a distribution cut off by the gate then in force,
//
//   ln N(d; 0, f^2 Gamma + R) - ln P(gate passes | f).
//
// Where the closure was measured, the density is that of the innovation instead
// (confirmed_loop.h), with the measurement's covariance in the place of R; how
// the poses truly lie to each other says nothing about f, so P stays.
//
// P concerns a weighted sum of chi-squares and uses Satterthwaite's
// approximation ("An approximate distribution of estimates of variance
// components", Biometrics Bulletin 2 (1946)).
#ifndef REVISIT_CORE_DRIVE_CONSISTENCY_MONITOR_H_
#define REVISIT_CORE_DRIVE_CONSISTENCY_MONITOR_H_

#include <cstdint>
#include <optional>
#include <vector>

#include "core/drive/confirmed_loop.h"
#include "core/drive/consistency.h"
#include "core/drive/pose_graph.h"
#include "core/noise/similarity_model.h"

namespace revisit::core {

// Standard deviation of the prior of ln f: ln 2. Estimators in the field are
// more often overconfident than not, and a search that begins with the claimed
// covariances would never see the loops that show it.
inline constexpr double kInflationPrior = 0.693;

struct ConsistencyOptions {
  // The model of differences; its direction and inflation are ignored.
  SimilarityModel similarity;
  double gate_probability = 0.95;
  // Whether searches apply the inflation, so that their gate was wider by it.
  bool applied = false;
  double max_inflation = 10.0;
};

// Estimates f from one confirmed pair after the other.
class ConsistencyMonitor {
 public:
  explicit ConsistencyMonitor(const ConsistencyOptions& options);

  // Adds a confirmed pair. O(1) where the noise model has a closed form, else
  // O(nodes between the two).
  void Confirm(const PoseGraph& graph, const ConfirmedLoop& loop);

  // `rejected` is not filled in.
  const Consistency& consistency() const { return consistency_; }

 private:
  template <int D>
  void Confirm(const PoseGraph& graph, const ConfirmedLoop& loop);

  ConsistencyOptions options_;
  // Threshold of the gate.
  double threshold_;
  // Logarithm of the posterior density of ln f, less a constant, at even steps
  // of ln f. Empty before the first confirmed pair.
  std::vector<double> log_density_;
  double sum_of_squares_ = 0.0;
  Consistency consistency_;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_DRIVE_CONSISTENCY_MONITOR_H_
