// Watches an odometry for where it began anew within one recording, as where
// its program was started again while a bag was written.
//
// The criteria are those by which the service tells a new frame from the poses
// that it was sent (core/drive/frame_watch.h), as far as samples have them:
// the odometry is back at its first pose or at the origin, heading as there,
// and either it has leapt there while nothing says that more is uncertain, or
// its covariance has fallen, which errors that add up do not allow. A leap is
// at least kLeapMeters long, and kUsualSteps times as long as the step before.
//
// A RestartWatch is not thread-safe.
#ifndef REVISIT_CLIENT_FORMATS_RESTART_WATCH_H_
#define REVISIT_CLIENT_FORMATS_RESTART_WATCH_H_

#include <memory>
#include <optional>

#include "client/formats/reader.h"
#include "client/formats/sample.h"

namespace revisit::client {

class RestartWatch {
 public:
  static constexpr double kLeapMeters = 20.0;
  static constexpr double kUsualSteps = 4.0;
  static constexpr double kReturnMeters = 1.0;
  static constexpr double kReturnRadians = 0.2;
  // A variance has fallen if it is less than that before by this factor.
  static constexpr double kFall = 4.0;

  // Whether the odometry began anew with this sample, the next one.
  bool Observe(const Sample& sample);

 private:
  bool IsRestart(const Sample& sample, double step_meters) const;

  std::optional<PlanarPose> first_;
  std::optional<Sample> last_;
  // The length of the step to the last sample.
  double last_step_meters_ = 0.0;
};

// Hands on the samples of an odometry, and sets `restarts` where it began anew.
std::unique_ptr<SampleReader> MarkRestarts(
    std::unique_ptr<SampleReader> reader);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_FORMATS_RESTART_WATCH_H_
