// A vehicle that dead-reckons along a given true path: the noise is drawn, the
// errors are carried along exactly (not linearised), and the covariance is
// propagated beside them. What the core says about covariances can be held
// against the sample covariance of many such drives.
#ifndef REVISIT_TESTS_ORACLE_DEAD_RECKONING_H_
#define REVISIT_TESTS_ORACLE_DEAD_RECKONING_H_

#include <Eigen/Core>
#include <cmath>
#include <cstdint>
#include <random>
#include <vector>

#include "core/geometry/heading.h"
#include "core/geometry/pose.h"
#include "core/geometry/state_matrix.h"
#include "tests/random.h"

namespace revisit::oracle {

// Standard deviations per square root of a metre.
struct Noise {
  double along_meters = 0.05;
  double across_meters = 0.02;
  double heading_radians = 0.001;
  double start_position_meters = 0.1;
  double start_heading_radians = 0.01;
};

inline Eigen::Matrix3d StepNoise(const Noise& noise, double heading,
                                 double distance) {
  const double along = noise.along_meters * noise.along_meters * distance;
  const double across = noise.across_meters * noise.across_meters * distance;
  const double c = std::cos(heading);
  const double s = std::sin(heading);
  Eigen::Matrix3d q = Eigen::Matrix3d::Zero();
  q(0, 0) = c * c * along + s * s * across;
  q(1, 1) = s * s * along + c * c * across;
  q(0, 1) = q(1, 0) = c * s * (along - across);
  q(2, 2) = noise.heading_radians * noise.heading_radians * distance;
  return q;
}

// Covariances along a path, P <- F P F^T + Q, with F the lever arm of the step.
inline std::vector<core::PoseSample> WithCovariances(
    const std::vector<core::Pose>& path, const Noise& noise) {
  std::vector<core::PoseSample> samples;
  const double p = noise.start_position_meters * noise.start_position_meters;
  const double h = noise.start_heading_radians * noise.start_heading_radians;
  Eigen::Matrix3d covariance = Eigen::Vector3d(p, p, h).asDiagonal();
  for (std::size_t i = 0; i < path.size(); ++i) {
    if (i > 0) {
      const double dx = path[i].x - path[i - 1].x;
      const double dy = path[i].y - path[i - 1].y;
      Eigen::Matrix3d f = Eigen::Matrix3d::Identity();
      f(0, 2) = -dy;
      f(1, 2) = dx;
      covariance = (f * covariance * f.transpose()).eval() +
                   StepNoise(noise, path[i - 1].heading, std::hypot(dx, dy));
    }
    core::PoseSample sample;
    sample.sequence = i + 1;
    sample.pose = path[i];
    sample.covariance = core::ToCovariance<3>(covariance);
    samples.push_back(sample);
  }
  return samples;
}

// One drawn estimate of the true path: each step measured with fresh noise in
// the frame of the pose before, composed exactly.
inline std::vector<core::Pose> DrawEstimate(
    const std::vector<core::Pose>& truth, const Noise& noise,
    std::mt19937_64& random) {
  std::vector<core::Pose> estimate(truth.size());
  estimate[0] = truth[0];
  estimate[0].x += Normal(random, noise.start_position_meters);
  estimate[0].y += Normal(random, noise.start_position_meters);
  // An error of the first heading turns the whole drive about the first
  // position.
  estimate[0].heading += Normal(random, noise.start_heading_radians);
  for (std::size_t i = 1; i < truth.size(); ++i) {
    const core::Pose& a = truth[i - 1];
    const double dx = truth[i].x - a.x;
    const double dy = truth[i].y - a.y;
    const double root = std::sqrt(std::hypot(dx, dy));
    const double along = std::cos(a.heading) * dx + std::sin(a.heading) * dy +
                         Normal(random, noise.along_meters * root);
    const double across = -std::sin(a.heading) * dx + std::cos(a.heading) * dy +
                          Normal(random, noise.across_meters * root);
    const double turn = truth[i].heading - a.heading +
                        Normal(random, noise.heading_radians * root);
    const core::Pose& from = estimate[i - 1];
    estimate[i].x = from.x + std::cos(from.heading) * along -
                    std::sin(from.heading) * across;
    estimate[i].y = from.y + std::sin(from.heading) * along +
                    std::cos(from.heading) * across;
    estimate[i].heading = from.heading + turn;
  }
  return estimate;
}

}  // namespace revisit::oracle

#endif  // REVISIT_TESTS_ORACLE_DEAD_RECKONING_H_
