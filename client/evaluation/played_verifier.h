// A verifier that knows the truth, and errs as much as it is told to: what the
// image or scan matcher behind a fleet does with candidates.
#ifndef REVISIT_CLIENT_EVALUATION_PLAYED_VERIFIER_H_
#define REVISIT_CLIENT_EVALUATION_PLAYED_VERIFIER_H_

#include <cstdint>
#include <optional>
#include <string>

#include "client/evaluation/simulation.h"
#include "client/formats/drive_file.h"
#include "revisit/v1/loop_closure.pb.h"

namespace revisit::client {

// Standard deviations of a measurement.
struct MeasurementNoise {
  double meters = 0.0;
  double heading_radians = 0.0;
};

struct VerifierErrors {
  // Shares, in [0, 1]: of candidates about which nothing is said, and of the
  // others of which the opposite of the truth is said.
  double silent = 0.0;
  double wrong = 0.0;
  // If set, who confirms a candidate also says how the two poses lie to each
  // other: truly, with this noise, which is stated. For PLANAR vehicles only.
  std::optional<MeasurementNoise> measured;
};

class PlayedVerifier {
 public:
  // Draws are those of the drive and the seed, one after the other.
  PlayedVerifier(const VerifierErrors& errors, const std::string& drive,
                 std::uint64_t seed)
      : errors_(errors),
        draws_(seed, drive + ", verifier"),
        noise_(~seed, drive + ", verifier") {}

  enum class Word { kNothing, kConfirm, kReject };

  // The word about the next candidate.
  Word Judge(bool is_right);

  // The measurement of a candidate that was confirmed; nothing where none is
  // made. Whoever confirms a place that the vehicle is not at takes one pose
  // for the other.
  std::optional<v1::LoopClosureMeasurement> Measure(const PlanarPose& query,
                                                    const PlanarPose& matched,
                                                    bool is_right);

 private:
  VerifierErrors errors_;
  RandomSource draws_;
  RandomSource noise_;
};

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_EVALUATION_PLAYED_VERIFIER_H_
