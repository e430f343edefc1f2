// Estimates of other estimators than the one that recorded a drive: dead
// reckoning with exactly the noise of dead_reckoning.h, a gyro with a bias that
// nobody claims, and the fixes of a GNSS receiver.
//
// Random numbers come from the 64-bit Mersenne twister and a Box-Muller
// transform of our own, since the standard library leaves its distributions
// open: a seed gives the same drive everywhere, but for the last bits of sine,
// cosine and logarithm.
#ifndef REVISIT_CLIENT_EVALUATION_SIMULATION_H_
#define REVISIT_CLIENT_EVALUATION_SIMULATION_H_

#include <cstdint>
#include <optional>
#include <random>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "client/formats/drive_file.h"
#include "client/trajectory/dead_reckoning.h"

namespace revisit::client {

// Independent draws, of the standard normal distribution and of a uniform one.
class RandomSource {
 public:
  explicit RandomSource(std::uint64_t seed) : random_(seed) {}
  // Others for each name under one seed.
  RandomSource(std::uint64_t seed, const std::string& name);

  double Next();
  // A draw of the uniform distribution in (0, 1].
  double Uniform();

 private:
  std::mt19937_64 random_;
  std::optional<double> spare_;
};

// Pose b as seen from pose a.
PlanarPose Between(const PlanarPose& a, const PlanarPose& b);

// Draws the estimate of a drive anew and drops the file's covariances. The
// first pose is off by `start_position` and `start_heading`. Each step of the
// truth is seen from the pose before it and gets noise along and across its
// direction (half-way between the two headings), in heading and in height; a
// truth without heights lies in a plane. Steps shorter than 5 cm count as
// standing still: dead reckoning adds nothing there, and the motion goes into
// the next step that is longer.
//
// Drives of different names get different noise under one seed. Estimates are
// in the frame of the truth. REQUIRES: a drive with truth.
Drive SimulateDeadReckoning(const Drive& drive, const UncertaintyOptions& noise,
                            std::uint64_t seed);

// Adds a constant error of the heading's rate (radians per second) to a drive's
// estimate, by putting its own steps together anew: each is turned by the bias
// times the seconds that it took, half of that within the step. Steps without
// times, against time, or of more than 2 s count as 0.1 s, as a recording at
// 10 Hz has it. The first pose stays; the file's covariances, rotations and
// error transitions, which the new estimate does not have, are dropped.
void AddGyroBias(double radians_per_second, Drive* drive);

// The errors of a GNSS receiver: in x and y a Gauss-Markov process each.
struct FixNoise {
  // Stationary standard deviation of either axis, metres.
  double meters = 0.0;
  // The errors of two fixes that are t seconds apart have the correlation
  // exp(-t / correlation_seconds); 0 if they are independent.
  double correlation_seconds = 0.0;
  // Standard deviation of the heading, radians; independent.
  double heading = 0.05;
};

// The fixes that a receiver with these errors would state along the truth: each
// with its standard deviations as its covariance, as if it were independent of
// the others, which is what receivers claim. There is a fix each second, like
// most receivers' and since the noise of more would count as travelled
// distance; seconds in which the vehicle moved less than 0.5 m bring none,
// since the heading of a vehicle that stands is not known. The truth of samples
// without a fix is left out too. Seconds count as in AddGyroBias().
//
// Seeds and names count as in SimulateDeadReckoning(). REQUIRES: a drive with
// truth and local positions.
Drive SimulateFixes(const Drive& drive, const FixNoise& noise,
                    std::uint64_t seed);

// Reads "7", "1-5" or "1,4,8-10"; INVALID_ARGUMENT for anything else, for a
// seed that stands twice, and for more than 1000 seeds.
absl::StatusOr<std::vector<std::uint64_t>> ParseSeeds(const std::string& text);

// The pose of a drive's frame in that of its truth, as somebody would have
// placed it who erred at the drive's start: by independent normal errors of
// these standard deviations, in metres in x and y and in radians. The same seed
// and drive give the same errors, whatever else is drawn. REQUIRES: truth.
PlanarPose DrawDatum(const Drive& drive, double meters, double radians,
                     std::uint64_t seed);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_EVALUATION_SIMULATION_H_
