#include "server/fields/covariances.h"

#include <array>
#include <cmath>
#include <cstddef>

#include "absl/strings/str_cat.h"
#include "core/geometry/state_matrix.h"

namespace revisit::server {
namespace {

using Values = absl::Span<const double>;

bool AreFinite(Values values) {
  bool finite = true;
  for (const double value : values) finite &= std::isfinite(value);
  return finite;
}

// Whether there are as many numbers as needed, all finite.
bool CheckValues(Values values, std::size_t needed, const char* form,
                 const FieldPath& path, Violations* violations) {
  if (values.size() != needed) {
    violations->Add("COVARIANCE_SIZE", path.Field("values"),
                    absl::StrCat("got ", values.size(), " numbers; ", form,
                                 " has ", needed));
    return false;
  }
  if (AreFinite(values)) return true;
  for (std::size_t i = 0; i < needed; ++i) {
    CheckFinite(values[i], path.At("values", i), violations);
  }
  return false;
}

void TakePlanar(Values values, core::Covariance* covariance) {
  std::size_t next = 0;
  for (int r = 0; r < 3; ++r) {
    for (int c = r; c < 3; ++c) {
      (*covariance)(core::StateIndex<3>(r), core::StateIndex<3>(c)) =
          values[next++];
    }
  }
}

// A PLANAR vehicle leaves out the row and column of z.
void TakeSpatial(Values values, bool spatial, core::Covariance* covariance) {
  std::size_t next = 0;
  for (int r = 0; r < 4; ++r) {
    for (int c = r; c < 4; ++c, ++next) {
      if (spatial || (r != 2 && c != 2)) {
        (*covariance)(r, c) = values[next];
      }
    }
  }
}

// Takes the rows and columns x, y, (z) and rotation about z.
void TakeRos(Values values, bool spatial, const FieldPath& path,
             core::Covariance* covariance, Violations* violations) {
  static constexpr int kRosRow[] = {0, 1, 2, 5};
  std::array<int, 4> kept{0, 1, 2, 3};
  int size = 4;
  if (!spatial) {
    kept = {0, 1, 3, 0};
    size = 3;
  }
  std::array<double, 16> reduced{};
  for (int r = 0; r < size; ++r) {
    for (int c = 0; c < size; ++c) {
      const int row = kept[static_cast<std::size_t>(r)];
      const int column = kept[static_cast<std::size_t>(c)];
      const double value =
          values[static_cast<std::size_t>(6 * kRosRow[row] + kRosRow[column])];
      reduced[static_cast<std::size_t>(size * r + c)] = value;
      if (c >= r) (*covariance)(row, column) = value;
    }
  }
  if (const auto defect = core::FindAsymmetry(reduced.data(), size)) {
    violations->Add(
        "COVARIANCE_NOT_SYMMETRIC", path.Field("values"),
        absl::StrCat("reduced to the state, ", defect->description));
  }
}

}  // namespace

std::size_t RowsOf(CovarianceForm form) {
  switch (form) {
    case CovarianceForm::kPlanar6:
      return 3;
    case CovarianceForm::kSpatial10:
      return 4;
    case CovarianceForm::kRos36:
      return 6;
  }
  return 0;
}

void DecodeCovariance(const CovarianceFields& fields, core::StateSpace space,
                      const FieldPath& path, core::Covariance* covariance,
                      Violations* violations) {
  const bool spatial = space == core::StateSpace::kSpatial;
  const Values values = fields.values;
  switch (fields.form) {
    case CovarianceForm::kPlanar6:
      if (spatial) {
        violations->Add(kInvalidField, path.Field("form"),
                        "got PLANAR_6; this vehicle's state space is SPATIAL, "
                        "which takes SPATIAL_10 or ROS_36");
      } else if (CheckValues(values, 6, "PLANAR_6", path, violations)) {
        TakePlanar(values, covariance);
      }
      return;
    case CovarianceForm::kSpatial10:
      if (CheckValues(values, 10, "SPATIAL_10", path, violations)) {
        TakeSpatial(values, spatial, covariance);
      }
      return;
    case CovarianceForm::kRos36:
      if (CheckValues(values, 36, "ROS_36", path, violations)) {
        TakeRos(values, spatial, path, covariance, violations);
      }
      return;
  }
  violations->Add(
      kInvalidField, path.Field("form"),
      absl::StrCat(
          "got ", static_cast<int>(fields.form), "; required is ",
          spatial ? "SPATIAL_10 or ROS_36" : "PLANAR_6, SPATIAL_10 or ROS_36"));
}

const char* ReasonOf(core::DefectKind kind) {
  switch (kind) {
    case core::DefectKind::kNotFinite:
      return kNotFinite;
    case core::DefectKind::kOutOfRange:
      return kInvalidField;
    case core::DefectKind::kNotSymmetric:
      return "COVARIANCE_NOT_SYMMETRIC";
    case core::DefectKind::kNotPositiveDefinite:
      return "COVARIANCE_NOT_POSITIVE_DEFINITE";
  }
  return kInvalidField;
}

void CheckPositiveDefinite(const core::Covariance& covariance,
                           core::StateSpace space, const FieldPath& path,
                           Violations* violations) {
  core::PoseSample sample;
  sample.covariance = covariance;
  if (const auto defect = core::FindDefect(sample, space)) {
    violations->Add(ReasonOf(defect->kind), path.Field("values"),
                    defect->description);
  }
}

std::size_t TransitionIndex(core::StateSpace space, int row, int column) {
  const auto coordinate = [space](int k) {
    return space == core::StateSpace::kSpatial ? k : core::StateIndex<3>(k);
  };
  return static_cast<std::size_t>(4 * coordinate(row) + coordinate(column));
}

void EncodeTransition(const core::ErrorTransition& transition,
                      core::StateSpace space,
                      google::protobuf::RepeatedField<double>* values) {
  values->Clear();
  const int size = core::DegreesOfFreedom(space);
  for (int r = 0; r < size; ++r) {
    for (int c = 0; c < size; ++c) {
      values->Add(transition.values[TransitionIndex(space, r, c)]);
    }
  }
}

}  // namespace revisit::server
