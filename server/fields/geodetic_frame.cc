#include "server/fields/geodetic_frame.h"

#include <cmath>
#include <cstddef>

#include "core/geometry/state_matrix.h"

namespace revisit::server {
namespace {

// J of the header.
template <int D>
core::StateMatrix<D> Jacobian(const std::vector<double>& m,
                              double heading_scale) {
  core::StateMatrix<D> j = core::StateMatrix<D>::Zero();
  for (int r = 0; r < D - 1; ++r) {
    for (int c = 0; c < D - 1; ++c) {
      j(r, c) = m[static_cast<std::size_t>(3 * r + c)];
    }
  }
  j(D - 1, D - 1) = heading_scale;
  return j;
}

template <int D>
core::StateMatrix<D> InverseJacobian(const std::vector<double>& m,
                                     double heading_scale) {
  core::StateMatrix<D> inverse = core::StateMatrix<D>::Zero();
  if constexpr (D == 3) {
    const double determinant = m[0] * m[4] - m[1] * m[3];
    inverse(0, 0) = m[4] / determinant;
    inverse(0, 1) = -m[1] / determinant;
    inverse(1, 0) = -m[3] / determinant;
    inverse(1, 1) = m[0] / determinant;
  } else {
    for (int r = 0; r < 3; ++r) {
      for (int c = 0; c < 3; ++c) {
        inverse(r, c) = m[static_cast<std::size_t>(3 * c + r)];
      }
    }
  }
  inverse(D - 1, D - 1) = 1.0 / heading_scale;
  return inverse;
}

template <int D>
void TurnUncertainty(const std::vector<double>& m, double heading_scale,
                     core::PoseSample* sample) {
  const core::StateMatrix<D> j = Jacobian<D>(m, heading_scale);
  const core::StateMatrix<D> covariance = core::ToMatrix<D>(sample->covariance);
  sample->covariance = core::ToCovariance<D>(j * covariance * j.transpose());
  if (sample->transition) {
    sample->transition =
        core::ToErrorTransition<D>(j * core::ToMatrix<D>(*sample->transition) *
                                   InverseJacobian<D>(m, heading_scale));
  }
}

}  // namespace

void CheckGeodetic(const GeodeticOrigin& position, const FieldPath& path,
                   Violations* violations) {
  CheckRange(position.latitude_degrees, -90, 90, path.Field("latitude_degrees"),
             violations);
  CheckRange(position.longitude_degrees, -180, 180,
             path.Field("longitude_degrees"), violations);
  CheckRange(position.height_meters, -10000, 100000,
             path.Field("height_meters"), violations);
}

GeodeticFrame::GeodeticFrame(const GeodeticOrigin& origin)
    : origin_(origin),
      frame_(origin.latitude_degrees, origin.longitude_degrees,
             origin.height_meters),
      rotation_(9) {}

bool GeodeticFrame::ToLocal(const GeodeticOrigin& position,
                            const std::array<double, 3>& forward,
                            core::StateSpace space, core::PoseSample* sample) {
  frame_.Forward(position.latitude_degrees, position.longitude_degrees,
                 position.height_meters, sample->pose.x, sample->pose.y,
                 sample->pose.z, rotation_);
  const std::vector<double>& m = rotation_;
  const auto& f = forward;
  const double x = m[0] * f[0] + m[1] * f[1] + m[2] * f[2];
  const double y = m[3] * f[0] + m[4] * f[1] + m[5] * f[2];
  const double squared = x * x + y * y;
  if (!(squared > kMinHorizontal * kMinHorizontal)) return false;
  sample->pose.heading = std::atan2(y, x);
  // A turn about the vertical moves the forward axis along (-f[1], f[0], 0).
  const double turned_x = -m[0] * f[1] + m[1] * f[0];
  const double turned_y = -m[3] * f[1] + m[4] * f[0];
  const double heading_scale = (x * turned_y - y * turned_x) / squared;
  if (space == core::StateSpace::kSpatial) {
    TurnUncertainty<4>(m, heading_scale, sample);
  } else {
    TurnUncertainty<3>(m, heading_scale, sample);
  }
  return true;
}

}  // namespace revisit::server
