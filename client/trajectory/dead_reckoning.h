// The uncertainty that a drive's estimate claims when it is streamed.
//
// Model: dead reckoning with noise that grows with the distance. A step of
// length s from (x, y, h) to (x + dx, y + dy, .) carries the covariance on as
//
//   P <- F P F^T + G Q G^T
//
//       1 0 -dy         c -s' 0
//   F = 0 1  dx     G = s' c  0     Q = s diag(along^2, across^2, heading^2)
//       0 0  1          0  0  1
//
// with (c, s') the direction half-way between the two headings. It starts at
// diag(position^2, position^2, heading^2). Height, where it counts, is on its
// own: variance position^2 + up^2 times the distance.
#ifndef REVISIT_CLIENT_TRAJECTORY_DEAD_RECKONING_H_
#define REVISIT_CLIENT_TRAJECTORY_DEAD_RECKONING_H_

#include <array>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "client/formats/angles.h"
#include "client/formats/drive_file.h"

namespace revisit::client {

struct UncertaintyOptions {
  enum class Source {
    // The model above, along the file's estimate.
    kModel,
    // The file's columns. Since files start with certainty, which the server
    // refuses, the start's covariance is added, carried along by F as above.
    kFile,
    // The file's covariances as they are: each pose is a fix of its own, or the
    // file has error transitions. Positions without a covariance have
    // `fix_position`, and headings that geodetic ones have beside them
    // `start_heading`.
    kFixes,
  };
  Source source = Source::kModel;
  // Standard deviations per square root of a metre: metres and radians.
  double along = 0.1;
  double across = 0.05;
  double up = 0.05;
  double heading = 0.1 * kPi / 180.0;
  // Standard deviations at the start: metres and radians.
  double start_position = 0.1;
  double start_heading = 0.01;
  // Whether these are also those of the start of each further recording, in the
  // frame of the recordings before it. If not, that claims no more than a step.
  bool start_is_given = false;
  // Standard deviation of each coordinate of a fix whose file states none.
  double fix_position = 5.0;
  // Every standard deviation is claimed this many times as large as the above
  // says: 0.5 is a filter that is overconfident by two. Positive.
  double claimed_scale = 1.0;
};

struct ClaimedUncertainty {
  // xx, xy, xh, yy, yh, hh.
  std::array<double, 6> planar{};
  double z_variance = 0.0;
  // xz, yz and zh; 0 unless the file has them.
  std::array<double, 3> z_mixed{};
};

// Claims the uncertainty of one sample after the other.
class UncertaintyClaims {
 public:
  // `name` is the recording's, for messages.
  UncertaintyClaims(const UncertaintyOptions& options, std::string name);

  // Begins another recording, behind this pose with its covariance.
  void ContinueFrom(const PlanarPose& pose,
                    const std::array<double, 6>& covariance);

  // The samples that follow are those of another file, behind the last.
  void BeginRecording(const std::string& name);

  // The next sample is the first one in a frame of its own, in which errors
  // begin anew.
  void BeginFrame();

  // INVALID_ARGUMENT if the source is the file and the sample has no
  // covariance, or none that a fix can have.
  absl::StatusOr<ClaimedUncertainty> Next(const Sample& sample);

 private:
  // The file and line of a sample, for messages.
  std::string PlaceOf(const Sample& sample) const;
  // The covariance that the file states, or that fixes without one have.
  absl::StatusOr<std::array<double, 6>> StatedBy(const Sample& sample) const;
  absl::Status FromFile(const Sample& sample, ClaimedUncertainty* claim) const;

  const UncertaintyOptions options_;
  std::string name_;
  std::array<double, 6> carried_;
  // The last claim, before it was scaled.
  std::array<double, 6> claimed_{};
  // Whether the next sample is the first of a further recording.
  bool is_first_ = false;
  double distance_ = 0.0;
  std::optional<PlanarPose> previous_;
};

// Multiplies the standard deviations by this factor. REQUIRES: it is positive.
void ScaleClaims(double factor, std::vector<ClaimedUncertainty>* claims);

// One for each sample, with the errors of UncertaintyClaims::Next().
absl::StatusOr<std::vector<ClaimedUncertainty>> ClaimUncertainty(
    const Drive& drive, const UncertaintyOptions& options);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_TRAJECTORY_DEAD_RECKONING_H_
