#include "server/service/kept_covariances.h"

#include <cassert>
#include <cmath>
#include <cstddef>

#include "absl/strings/str_cat.h"
#include "core/base/number_text.h"
#include "core/geometry/quadratic_form.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/chi_squared.h"

namespace revisit::server {
namespace {

using absl::StrCat;

// Within three standard deviations lie so many of a normal variable's values.
constexpr double kThreeDeviations = 0.9973;
// One pose of so many may have moved that far by chance.
constexpr std::int64_t kByChance = 100;

template <int D>
double SquaredDistance(const core::PoseSample& before,
                       const core::PoseSample& after) {
  const auto form = core::Evaluate<D>(
      core::ToMatrix<D>(before.covariance),
      core::ToVector<D>(core::Difference(after.pose, before.pose)));
  return form ? form->squared_mahalanobis : 0.0;
}

bool HasMoved(const core::Pose& a, const core::Pose& b) {
  return a.x != b.x || a.y != b.y || a.z != b.z || a.heading != b.heading;
}

}  // namespace

KeptCovariances::KeptCovariances(core::StateSpace space)
    : space_(space),
      most_(core::ChiSquaredQuantile(
          space == core::StateSpace::kPlanar ? 3.0 : 4.0, kThreeDeviations)) {}

void KeptCovariances::Look(const std::vector<core::PoseSample>& before,
                           const std::vector<core::PoseSample>& after) {
  assert(before.size() == after.size());
  for (std::size_t i = 0; i < before.size(); ++i) {
    if (!HasMoved(before[i].pose, after[i].pose)) continue;
    ++revised_;
    if (before[i].covariance.upper != after[i].covariance.upper) continue;
    const double squared = space_ == core::StateSpace::kPlanar
                               ? SquaredDistance<3>(before[i], after[i])
                               : SquaredDistance<4>(before[i], after[i]);
    if (squared <= most_) continue;
    ++outrun_;
    if (squared <= squared_) continue;
    squared_ = squared;
    sequence_ = after[i].sequence;
    meters_ = core::Distance(before[i].pose, after[i].pose, space_);
  }
}

std::optional<v1::Warning> KeptCovariances::Judge() const {
  if (outrun_ * kByChance <= revised_) return std::nullopt;
  v1::Warning warning;
  warning.set_reason(v1::WARNING_REASON_COVARIANCES_KEPT);
  warning.set_message(StrCat(
      outrun_, " of ", revised_,
      " poses have moved farther than 3 standard deviations of their "
      "covariances, which stay as they were stored; sequence ",
      sequence_, " by ", std::round(10.0 * meters_) / 10.0,
      " m: claims that were too small before stay so. Send larger ones with "
      "the poses, and have the estimator claim more"));
  auto& metadata = *warning.mutable_metadata();
  metadata["poses"] = StrCat(outrun_);
  metadata["sequence"] = StrCat(sequence_);
  metadata["meters"] = core::NumberText(meters_);
  return warning;
}

}  // namespace revisit::server
