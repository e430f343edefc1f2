// Drives drawn from the noise model of dead_reckoning.h: what an odometer with
// exactly that noise would have estimated along the true path.
//
// Random numbers come from the 64-bit Mersenne twister and a Box-Muller
// transform of our own, since the standard library leaves its distributions
// open: a seed gives the same drive everywhere, but for the last bits of sine,
// cosine and logarithm.
#ifndef REVISIT_CLIENT_CLI_EVALUATION_SIMULATION_H_
#define REVISIT_CLIENT_CLI_EVALUATION_SIMULATION_H_

#include <cstdint>
#include <optional>
#include <random>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "client/cli/evaluation/dead_reckoning.h"
#include "client/formats/drive_file.h"

namespace revisit::client {

// Independent draws of the standard normal distribution.
class NormalSource {
 public:
  explicit NormalSource(std::uint64_t seed) : random_(seed) {}

  double Next();

 private:
  // In (0, 1].
  double Uniform();

  std::mt19937_64 random_;
  std::optional<double> spare_;
};

// Draws the estimate of a drive anew and drops the file's covariances. The
// first pose is off by `start_position` and `start_heading`. Each step of the
// truth is seen from the pose before it and gets noise along and across its
// direction (half-way between the two headings) and in heading. Steps shorter
// than 5 cm count as standing still: dead reckoning adds nothing there, and the
// motion goes into the next step that is longer.
//
// Drives of different names get different noise under one seed. Estimates are
// in the frame of the truth. REQUIRES: a drive with truth.
Drive SimulateDeadReckoning(const Drive& drive, const UncertaintyOptions& noise,
                            std::uint64_t seed);

// Reads "7", "1-5" or "1,4,8-10"; INVALID_ARGUMENT for anything else, for a
// seed that stands twice, and for more than 1000 seeds.
absl::StatusOr<std::vector<std::uint64_t>> ParseSeeds(const std::string& text);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_EVALUATION_SIMULATION_H_
