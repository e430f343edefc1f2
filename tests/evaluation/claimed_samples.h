// The poses of a recorded drive as programs of the evaluation append them.
#ifndef REVISIT_TESTS_EVALUATION_CLAIMED_SAMPLES_H_
#define REVISIT_TESTS_EVALUATION_CLAIMED_SAMPLES_H_

#include <array>
#include <cstddef>
#include <vector>

#include "client/formats/drive_file.h"
#include "client/trajectory/dead_reckoning.h"
#include "core/drive/drive.h"

namespace revisit::evaluation {

// The estimates, with the covariances that `revisit evaluate` claims.
inline std::vector<core::PoseSample> SamplesOf(const client::Drive& drive) {
  const auto claims = client::ClaimUncertainty(drive, {});
  std::vector<core::PoseSample> samples;
  for (std::size_t i = 0; i < drive.samples.size(); ++i) {
    const client::PlanarPose& pose = drive.samples[i].estimate;
    const std::array<double, 6>& claim = (*claims)[i].planar;
    core::PoseSample sample;
    sample.sequence = i + 1;
    sample.pose = {pose.x, pose.y, 0.0, pose.heading};
    sample.covariance(0, 0) = claim[0];
    sample.covariance(0, 1) = claim[1];
    sample.covariance(0, 3) = claim[2];
    sample.covariance(1, 1) = claim[3];
    sample.covariance(1, 3) = claim[4];
    sample.covariance(3, 3) = claim[5];
    sample.covariance(2, 2) = 1.0;
    samples.push_back(sample);
  }
  return samples;
}

}  // namespace revisit::evaluation

#endif  // REVISIT_TESTS_EVALUATION_CLAIMED_SAMPLES_H_
