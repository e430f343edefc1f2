// Whether the claimed covariances are as large as the errors that confirmed
// loop closures have shown.
//
// A confirmed pair is one place, so its difference d is drawn from
// N(0, f^2 Gamma + R), f being what the claimed standard deviations would have
// to be multiplied by. f is estimated from all confirmed pairs in the order in
// which they came: the posterior mean of ln f on [0, ln max], with a normal
// prior of which a factor of two is one standard deviation. Pairs that lie
// within the gate were perhaps only looked at since they do: their likelihood
// is that of a distribution cut off by the gate in force when they came,
//
//   ln N(d; 0, f^2 Gamma + R) - ln P(gate passes | f).
//
// P is that of a weighted sum of chi-squares, by Satterthwaite's approximation
// ("An approximate distribution of estimates of variance components",
// Biometrics Bulletin 2 (1946)).
#ifndef REVISIT_CORE_CANDIDATES_CONSISTENCY_H_
#define REVISIT_CORE_CANDIDATES_CONSISTENCY_H_

#include <cstdint>
#include <optional>
#include <vector>

#include "core/alignment/known_drift.h"
#include "core/alignment/log_similarity.h"
#include "core/graph/pose_graph.h"

namespace revisit::core {

struct Consistency {
  // Loop closures whose difference has a well-conditioned covariance.
  std::int64_t confirmed = 0;
  std::int64_t rejected = 0;
  // Mean of d^T (Gamma + R)^-1 d over the confirmed ones, as claimed.
  std::optional<double> mean_normalized_innovation_squared;
  int degrees_of_freedom = 3;
  // f; before the first confirmed pair, what the prior takes it for.
  double inflation = 1.0;
};

// Standard deviation of the prior of ln f: ln 2. Estimators in the field are
// too sure of themselves more often than not, and a search that starts out with
// what is claimed never gets to see the loops that would show it.
inline constexpr double kInflationPrior = 0.693;

struct ConsistencyOptions {
  // Direction and inflation are ignored.
  SimilarityModel similarity;
  double gate_probability = 0.95;
  // Whether searches apply the inflation, so that the gate was as wide.
  bool applied = false;
  double max_inflation = 10.0;
};
bool operator==(const ConsistencyOptions& a, const ConsistencyOptions& b);

// Learns from one confirmed pair after the other.
class ConsistencyMonitor {
 public:
  explicit ConsistencyMonitor(const ConsistencyOptions& options);

  // O(1), but O(nodes between the two) for kFilter.
  void Confirm(const PoseGraph& graph, const ConfirmedLoop& loop);

  // All but `rejected`.
  const Consistency& consistency() const { return consistency_; }

 private:
  template <int D>
  void Confirm(const PoseGraph& graph, const ConfirmedLoop& loop);
  void UpdateInflation();

  ConsistencyOptions options_;
  // Of the gate.
  double threshold_;
  // ln of the posterior density of ln f, less a constant, at even steps.
  std::vector<double> log_density_;
  double sum_of_squares_ = 0.0;
  Consistency consistency_;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_CANDIDATES_CONSISTENCY_H_
