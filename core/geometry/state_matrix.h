// Poses and covariances as vectors and matrices of a state of D coordinates.
#ifndef REVISIT_CORE_GEOMETRY_STATE_MATRIX_H_
#define REVISIT_CORE_GEOMETRY_STATE_MATRIX_H_

#include <Eigen/Core>
#include <cmath>
#include <cstddef>

#include "core/geometry/pose.h"

namespace revisit::core {

// Index among (x, y, z, heading) of coordinate i of a D-dimensional state.
template <int D>
constexpr int StateIndex(int i) {
  static_assert(D == 3 || D == 4);
  return D == 3 && i == 2 ? 3 : i;
}

template <int D>
using StateVector = Eigen::Matrix<double, D, 1>;
template <int D>
using StateMatrix = Eigen::Matrix<double, D, D>;

template <int D>
StateVector<D> ToVector(const Pose& pose) {
  if constexpr (D == 3) {
    return {pose.x, pose.y, pose.heading};
  } else {
    return {pose.x, pose.y, pose.z, pose.heading};
  }
}

template <int D>
StateMatrix<D> ToMatrix(const Covariance& covariance) {
  StateMatrix<D> matrix;
  for (int r = 0; r < D; ++r) {
    for (int c = 0; c < D; ++c) {
      matrix(r, c) = covariance(StateIndex<D>(r), StateIndex<D>(c));
    }
  }
  return matrix;
}

template <int D>
StateMatrix<D> ToMatrix(const ErrorTransition& transition) {
  StateMatrix<D> matrix;
  for (int r = 0; r < D; ++r) {
    for (int c = 0; c < D; ++c) {
      matrix(r, c) = transition.values[static_cast<std::size_t>(
          4 * StateIndex<D>(r) + StateIndex<D>(c))];
    }
  }
  return matrix;
}

// The matrix that turns a state by `angle` about z.
template <int D>
StateMatrix<D> TurnAbout(double angle) {
  StateMatrix<D> turn = StateMatrix<D>::Identity();
  const double c = std::cos(angle);
  const double s = std::sin(angle);
  turn(0, 0) = c;
  turn(0, 1) = -s;
  turn(1, 0) = s;
  turn(1, 1) = c;
  return turn;
}

// A covariance in axes that are turned about z, by the angle of this cosine and
// sine: T m T^T with T as TurnAbout() has it, without its zeros.
template <int D>
StateMatrix<D> Turned(const StateMatrix<D>& m, double cosine, double sine) {
  StateMatrix<D> rows = m;
  rows.row(0) = cosine * m.row(0) - sine * m.row(1);
  rows.row(1) = sine * m.row(0) + cosine * m.row(1);
  StateMatrix<D> turned = rows;
  turned.col(0) = cosine * rows.col(0) - sine * rows.col(1);
  turned.col(1) = sine * rows.col(0) + cosine * rows.col(1);
  return turned;
}
// The same, by `angle`.
template <int D>
StateMatrix<D> Turned(const StateMatrix<D>& m, double angle) {
  return Turned<D>(m, std::cos(angle), std::sin(angle));
}

// A covariance that swings with its heading: L m L^T, L being the identity but
// for the lever arm in x and y in the column of heading.
template <int D>
StateMatrix<D> Swung(const StateMatrix<D>& m, double lever_x, double lever_y) {
  constexpr int h = D - 1;
  StateMatrix<D> rows = m;
  rows.row(0) += lever_x * m.row(h);
  rows.row(1) += lever_y * m.row(h);
  StateMatrix<D> swung = rows;
  swung.col(0) += lever_x * rows.col(h);
  swung.col(1) += lever_y * rows.col(h);
  return swung;
}

// The symmetric part.
template <int D>
StateMatrix<D> Symmetric(const StateMatrix<D>& m) {
  return 0.5 * (m + m.transpose());
}

// Reads the upper triangle. Entries of z are 0 if D is 3.
template <int D>
Covariance ToCovariance(const StateMatrix<D>& matrix) {
  Covariance covariance;
  for (int r = 0; r < D; ++r) {
    for (int c = r; c < D; ++c) {
      covariance(StateIndex<D>(r), StateIndex<D>(c)) = matrix(r, c);
    }
  }
  return covariance;
}

// Entries of z are those of the identity if D is 3.
template <int D>
ErrorTransition ToErrorTransition(const StateMatrix<D>& matrix) {
  ErrorTransition transition;
  for (int r = 0; r < D; ++r) {
    for (int c = 0; c < D; ++c) {
      transition.values[static_cast<std::size_t>(
          4 * StateIndex<D>(r) + StateIndex<D>(c))] = matrix(r, c);
    }
  }
  return transition;
}

}  // namespace revisit::core

#endif  // REVISIT_CORE_GEOMETRY_STATE_MATRIX_H_
