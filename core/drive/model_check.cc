#include "core/drive/model_check.h"

#include <algorithm>
#include <cmath>

#include "core/drive/carried_claim.h"
#include "core/geometry/gap.h"
#include "core/noise/chi_squared.h"

namespace revisit::core {
namespace {

// The ratio of standard deviations at which P(|z| < kSmooth ratio) is this
// share.
double RatioOf(double smooth_share) {
  // The share is kept below 1, as if one more triple had not been smooth: the
  // quantile of 1 is infinite.
  const double below =
      std::min(smooth_share, 1.0 - 1.0 / (ModelCheck::kLastTriples + 1.0));
  return std::max(
      1.0, std::sqrt(ChiSquaredQuantile(1.0, below)) / ModelCheck::kSmooth);
}

}  // namespace

void ModelCheck::Look(const PoseSample& sample, double max_step_meters) {
  const Covariance& s = sample.covariance;
  const Position position{sample.pose.x, sample.pose.y, s(0, 0), s(0, 1),
                          s(1, 1)};
  LookAtStretch({position, s(0, 3), s(1, 3), s(3, 3)}, max_step_meters);
  LookAtTriple(position, max_step_meters);
}

double ModelCheck::MetersBetween(const Position& a, const Position& b) {
  return std::hypot(b.x - a.x, b.y - a.y);
}

// n^T S n for n = (x, y).
double ModelCheck::VarianceAlong(const Position& position, double x, double y) {
  return x * x * position.xx + 2.0 * x * y * position.xy + y * y * position.yy;
}

// tr F S F^T over x and y.
double ModelCheck::CarriedVariance(const Estimate& from, const Position& to) {
  const double x = to.x - from.position.x;
  const double y = to.y - from.position.y;
  return from.position.xx + from.position.yy +
         2.0 * (x * from.yh - y * from.xh) + (x * x + y * y) * from.hh;
}

bool ModelCheck::HasLever(const Estimate& from, const Estimate& to) {
  Covariance claim;
  claim(0, 0) = to.position.xx;
  claim(1, 1) = to.position.yy;
  claim(0, 3) = to.xh;
  claim(1, 3) = to.yh;
  claim(3, 3) = to.hh;
  return !LacksLever(claim,
                     from.xh - (to.position.y - from.position.y) * from.hh,
                     from.yh + (to.position.x - from.position.x) * from.hh);
}

void ModelCheck::LookAtStretch(const Estimate& now, double max_step_meters) {
  if (stretch_start_) {
    const Position& start = stretch_start_->position;
    const Gap stretch(now.position.x - start.x, now.position.y - start.y);
    if (stretch.IsBelow(kStretchMeters)) return;
    if (!stretch.IsAbove(max_step_meters)) {
      const bool has_lever = HasLever(*stretch_start_, now);
      growing_.Add(now.position.xx + now.position.yy >
                           CarriedVariance(*stretch_start_, now.position) ||
                       (!has_lever && now.hh > stretch_start_->hh),
                   kLastStretches);
      without_lever_ = (1.0 - 1.0 / kLastStretches) * without_lever_ +
                       (has_lever ? 0.0 : 1.0);
    }
  }
  stretch_start_ = now;
}

void ModelCheck::LookAtTriple(const Position& c, double max_step_meters) {
  if (last_) {
    const Gap step(c.x - last_->x, c.y - last_->y);
    if (step.IsBelow(kStepMeters)) return;
    // A jump: triples begin anew.
    if (step.IsAbove(max_step_meters)) last_.reset();
  }
  if (last_ && before_) {
    const Position& a = *before_;
    const Position& b = *last_;
    const double length = MetersBetween(a, c);
    if (length >= kStepMeters) {
      const double x = (c.x - a.x) / length;
      const double y = (c.y - a.y) / length;
      const double ahead = (b.x - a.x) * x + (b.y - a.y) * y;
      const double aside = (b.y - a.y) * x - (b.x - a.x) * y;
      const double t = std::clamp(ahead / length, 0.0, 1.0);
      const double variance = VarianceAlong(b, -y, x) +
                              (1.0 - t) * (1.0 - t) * VarianceAlong(a, -y, x) +
                              t * t * VarianceAlong(c, -y, x);
      smooth_.Add(aside * aside < kSmooth * kSmooth * variance, kLastTriples);
    }
  }
  before_ = last_;
  last_ = c;
}

std::optional<FindingCode> ModelCheck::Judge(CorrelationModel model) const {
  if (growing_.counted() < kLeastStretches) return std::nullopt;
  const double growing = growing_.value();
  const bool is_smooth =
      smooth_.counted() >= kLeastTriples && smooth_.value() > kMostSmooth;
  const NoiseModel& noise = NoiseOf(model);
  if (noise.claimed_growth == ClaimedGrowth::kGrows &&
      growing < kLeastGrowing) {
    return FindingCode::kCovariancesDoNotGrow;
  }
  if (noise.claimed_growth == ClaimedGrowth::kGrows &&
      without_lever_ > kMostWithoutLever * growing_.counted()) {
    return FindingCode::kCovariancesWithoutLever;
  }
  if (noise.claimed_growth == ClaimedGrowth::kDoesNotGrow &&
      growing > kMostGrowing) {
    return FindingCode::kCovariancesGrow;
  }
  if (noise.is_white && is_smooth) return FindingCode::kErrorsCorrelated;
  return std::nullopt;
}

void ModelCheck::Save(ByteWriter* writer) const {
  writer->PutOptional(stretch_start_);
  writer->Put(growing_);
  writer->Put(without_lever_);
  writer->PutOptional(before_);
  writer->PutOptional(last_);
  writer->Put(smooth_);
}

bool ModelCheck::Load(ByteReader* reader) {
  constexpr std::size_t kNumbers = sizeof(Estimate) / sizeof(double);
  return reader->GetOptional(&stretch_start_) && reader->Get(&growing_) &&
         reader->Get(&without_lever_) && reader->GetOptional(&before_) &&
         reader->GetOptional(&last_) && reader->Get(&smooth_) &&
         (!stretch_start_ ||
          AreFinite(&stretch_start_->position.x, kNumbers)) &&
         IsFinite(before_) && IsFinite(last_) && growing_.IsValid() &&
         0.0 <= without_lever_ && without_lever_ <= growing_.counted() &&
         smooth_.IsValid();
}

bool ModelCheck::IsFinite(const std::optional<Position>& position) {
  return !position ||
         AreFinite(&position->x, sizeof(Position) / sizeof(double));
}

std::optional<Finding> ModelCheck::Find(CorrelationModel model) const {
  const std::optional<FindingCode> code = Judge(model);
  if (!code) return std::nullopt;
  Finding finding;
  finding.code = *code;
  finding.growing = growing_.value();
  if (smooth_.counted() >= kLeastTriples) {
    finding.smoother = RatioOf(smooth_.value());
  }
  return finding;
}

}  // namespace revisit::core
