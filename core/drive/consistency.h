#ifndef REVISIT_CORE_DRIVE_CONSISTENCY_H_
#define REVISIT_CORE_DRIVE_CONSISTENCY_H_

#include <cstdint>
#include <optional>

namespace revisit::core {

// How confirmed loop closures have judged the claimed covariances
// (consistency_monitor.h).
struct Consistency {
  // Loop closures whose difference has a well-conditioned covariance.
  std::int64_t confirmed = 0;
  std::int64_t rejected = 0;
  // Mean of d^T (Gamma + R)^-1 d over the confirmed ones, as claimed; of the
  // innovation where there was a measurement.
  std::optional<double> mean_normalized_innovation_squared;
  int degrees_of_freedom = 3;
  // The estimate of f; before the first confirmed pair, that of the prior.
  double inflation = 1.0;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_DRIVE_CONSISTENCY_H_
