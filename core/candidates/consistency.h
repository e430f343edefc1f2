// Whether the claimed covariances are as large as the errors that confirmed loop
// closures have shown.
#ifndef REVISIT_CORE_CANDIDATES_CONSISTENCY_H_
#define REVISIT_CORE_CANDIDATES_CONSISTENCY_H_

#include <cstdint>
#include <optional>

namespace revisit::core {

struct Consistency {
  // Loop closures whose difference has a well-conditioned covariance.
  std::int64_t confirmed = 0;
  std::int64_t rejected = 0;
  // Mean of d^T (Gamma + R)^-1 d over the confirmed ones, as claimed.
  std::optional<double> mean_normalized_innovation_squared;
  int degrees_of_freedom = 3;
  // What every claimed standard deviation would have to be multiplied by, in
  // [1, EngineSettings::max_inflation].
  double inflation = 1.0;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_CANDIDATES_CONSISTENCY_H_
