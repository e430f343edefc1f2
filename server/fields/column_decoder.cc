#include "server/fields/column_decoder.h"

#include <cmath>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <utility>
#include <vector>

#include "absl/types/span.h"
#include "core/noise/noise_model.h"
#include "server/base/sequences.h"
#include "server/fields/covariances.h"
#include "server/fields/field_violations.h"
#include "server/fields/pose_orientation.h"
#include "server/fields/timestamps.h"
#include "server/sessions/vehicle_config.h"

namespace revisit::server {
namespace {

using Samples = std::vector<core::PoseSample>;
using Values = absl::Span<const double>;

// False for NaN.
bool AreWithin(Values values, double limit) {
  bool within = true;
  for (const double value : values) within &= std::abs(value) <= limit;
  return within;
}

// Whether all numbers are in their ranges, each column at a time.
bool AreInRange(const ColumnFields& columns) {
  const double limit = core::kMaxCoordinateMeters;
  return AreWithin(columns.x_meters, limit) &&
         AreWithin(columns.y_meters, limit) &&
         AreWithin(columns.z_meters, limit) &&
         AreWithin(columns.heading_radians, core::kMaxHeadingRadians) &&
         // A unit quaternion's are smaller, and NaN is not within.
         AreWithin(columns.quaternions, 2.0) &&
         AreWithin(columns.error_transitions, core::kMaxTransitionEntry);
}

std::optional<double> HeadingOf(Values numbers) {
  const Quaternion quaternion = {numbers[0], numbers[1], numbers[2],
                                 numbers[3]};
  const double norm = NormOf(quaternion);
  if (!IsUnit(norm)) return std::nullopt;
  const std::optional<Forward> forward = ForwardOf(quaternion, norm);
  if (!forward) return std::nullopt;
  return forward->heading;
}

// Decodes the poses behind the first, whose numbers are in range, one by one.
class SoundDecoder {
 public:
  SoundDecoder(PoseColumns* columns, const VehicleConfig& config,
               const core::Covariance& first)
      : columns_(columns),
        fields_(columns->fields()),
        space_(config.drive.state_space),
        carries_transitions_(
            core::NoiseOf(config.drive.search.correlation_model)
                .carries_transitions),
        first_(first) {}

  // Whether the pose is sound.
  bool Decode(std::size_t i, core::PoseSample* sample) {
    sample->sequence = fields_.first_sequence + i;
    sample->pose.x = fields_.x_meters[i];
    sample->pose.y = fields_.y_meters[i];
    if (!fields_.z_meters.empty()) sample->pose.z = fields_.z_meters[i];
    return TakeHeading(i, sample) && TakeStamp(i, sample) &&
           TakeTransition(i, sample) && TakeCovariance(i, sample);
  }

 private:
  bool TakeHeading(std::size_t i, core::PoseSample* sample) const {
    if (fields_.quaternions.empty()) {
      sample->pose.heading = fields_.heading_radians[i];
      return true;
    }
    const std::optional<double> heading =
        HeadingOf(fields_.quaternions.subspan(4 * i, 4));
    sample->pose.heading = heading.value_or(0.0);
    return heading.has_value();
  }

  bool TakeStamp(std::size_t i, core::PoseSample* sample) const {
    if (columns_->stamps_ns().empty()) return true;
    sample->stamp_ns = columns_->stamps_ns()[i];
    return IsTimestamp(*sample->stamp_ns);
  }

  bool TakeTransition(std::size_t i, core::PoseSample* sample) const {
    const Values given = columns_->TransitionAt(i);
    if (!carries_transitions_) return given.empty();
    const int size = core::DegreesOfFreedom(space_);
    if (given.size() != static_cast<std::size_t>(size * size)) return false;
    auto& values = sample->transition.emplace().values;
    for (int k = 0; k < size * size; ++k) {
      values[TransitionIndex(space_, k / size, k % size)] =
          given[static_cast<std::size_t>(k)];
    }
    return true;
  }

  bool TakeCovariance(std::size_t i, core::PoseSample* sample) {
    if (columns_->has_one_covariance()) {
      sample->covariance = first_;
      return true;
    }
    DecodeCovariance(columns_->CovarianceAt(i), space_, FieldPath(),
                     &sample->covariance, &violations_);
    return violations_.count() == 0 &&
           core::IsSound(sample->covariance, space_);
  }

  PoseColumns* const columns_;
  const ColumnFields& fields_;
  const core::StateSpace space_;
  const bool carries_transitions_;
  // The covariance of the first pose.
  const core::Covariance first_;
  Violations violations_;
};

// Nothing where a pose may have a defect, or is geodetic.
std::optional<Samples> DecodeSound(PoseColumns* columns,
                                   const VehicleConfig& config,
                                   PoseSource source) {
  if (config.frame == CoordinateFrame::kGeodetic) return std::nullopt;
  const ColumnFields& fields = columns->fields();
  if (fields.x_meters.empty() || !AreInRange(fields) ||
      fields.first_sequence > kMaxSequence - (columns->size() - 1)) {
    return std::nullopt;
  }
  Samples samples;
  samples.reserve(columns->size());
  // The first pose may have what others have not.
  Violations violations;
  samples.push_back(PoseDecoder(config, source, &violations)
                        .Decode(columns->At(0), FieldPath()));
  if (violations.count() > 0) return std::nullopt;
  SoundDecoder decoder(columns, config, samples.front().covariance);
  while (samples.size() < columns->size()) {
    const std::size_t i = samples.size();
    if (!decoder.Decode(i, &samples.emplace_back())) return std::nullopt;
  }
  return samples;
}

}  // namespace

std::vector<core::PoseSample> DecodeColumns(PoseColumns* columns,
                                            PoseDecoder* decoder,
                                            Violations* violations) {
  std::optional<Samples> sound =
      DecodeSound(columns, decoder->config(), decoder->source());
  if (sound) return *std::move(sound);
  return DecodePoses(
      columns->size(), [&](std::size_t i) { return columns->At(i); },
      FieldPath(), decoder, violations, [](const PoseFields&) {});
}

}  // namespace revisit::server
