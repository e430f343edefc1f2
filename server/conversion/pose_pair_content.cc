#include "server/conversion/pose_pair_content.h"

#include "server/base/status.h"
#include "server/conversion/covariances.h"
#include "server/conversion/stored_records.pb.h"

namespace revisit::server {
namespace {

// Copies a measurement of the API into one of the store, or back.
template <typename From, typename To>
void CopyMeasurement(const From& from, To* to) {
  to->set_x_meters(from.x_meters());
  to->set_y_meters(from.y_meters());
  to->set_z_meters(from.z_meters());
  to->set_heading_radians(from.heading_radians());
  auto* const covariance = to->mutable_covariance();
  using Form = decltype(covariance->form());
  covariance->set_form(static_cast<Form>(from.covariance().form()));
  *covariance->mutable_values() = from.covariance().values();
}

void CheckMeasurement(const v1::LoopClosureMeasurement& measurement,
                      const FieldPath& path, Violations* violations) {
  const auto check = [&](double value, const char* field, double limit) {
    CheckRange(value, -limit, limit, path.Field(field), violations);
  };
  check(measurement.x_meters(), "x_meters", kMaxMeasuredMeters);
  check(measurement.y_meters(), "y_meters", kMaxMeasuredMeters);
  check(measurement.z_meters(), "z_meters", kMaxMeasuredMeters);
  check(measurement.heading_radians(), "heading_radians",
        core::kMaxHeadingRadians);
  if (!measurement.has_covariance()) {
    violations->Add(kInvalidField, path.Field("covariance"), "required");
  }
}

// LoopClosure and RejectedCandidate have the note in common.
template <typename Message>
void EncodeNote(const Message& pair, const FieldPath& path,
                Violations* violations, stored::PosePairContent* content) {
  CheckText(pair.note(), kMaxNoteBytes, TextUse::kNote, path.Field("note"),
            violations);
  content->set_note(pair.note());
}

absl::StatusOr<stored::PosePairContent> Parse(const std::string& payload) {
  stored::PosePairContent content;
  if (!content.ParseFromString(payload)) {
    return Corrupt("a stored pair of poses is not a PosePairContent");
  }
  return content;
}

}  // namespace

std::string EncodeContent(const v1::LoopClosure& closure, const FieldPath& path,
                          Violations* violations) {
  stored::PosePairContent content;
  if (closure.has_measurement()) {
    CheckMeasurement(closure.measurement(), path.Field("measurement"),
                     violations);
    CopyMeasurement(closure.measurement(), content.mutable_measurement());
  }
  EncodeNote(closure, path, violations, &content);
  if (closure.has_score()) {
    CheckFinite(closure.score(), path.Field("score"), violations);
    content.set_score(closure.score());
  }
  return content.SerializeAsString();
}

std::string EncodeContent(const v1::RejectedCandidate& rejection,
                          const FieldPath& path, Violations* violations) {
  stored::PosePairContent content;
  EncodeNote(rejection, path, violations, &content);
  return content.SerializeAsString();
}

absl::Status DecodeContent(const std::string& payload,
                           v1::LoopClosure* closure) {
  const absl::StatusOr<stored::PosePairContent> content = Parse(payload);
  if (!content.ok()) return content.status();
  if (content->has_measurement()) {
    CopyMeasurement(content->measurement(), closure->mutable_measurement());
  }
  closure->set_note(content->note());
  if (content->has_score()) closure->set_score(content->score());
  return absl::OkStatus();
}

absl::Status DecodeContent(const std::string& payload,
                           v1::RejectedCandidate* rejection) {
  const absl::StatusOr<stored::PosePairContent> content = Parse(payload);
  if (!content.ok()) return content.status();
  rejection->set_note(content->note());
  return absl::OkStatus();
}

absl::StatusOr<std::optional<core::LoopMeasurement>> DecodeMeasurement(
    const std::string& payload, core::StateSpace space) {
  v1::LoopClosure closure;
  if (absl::Status status = DecodeContent(payload, &closure); !status.ok()) {
    return status;
  }
  if (!closure.has_measurement()) return std::optional<core::LoopMeasurement>();
  const v1::LoopClosureMeasurement& message = closure.measurement();
  core::LoopMeasurement measurement;
  measurement.relative = {message.x_meters(), message.y_meters(),
                          message.z_meters(), message.heading_radians()};
  const FieldPath request;
  const FieldPath pair = request.Field("loop_closure");
  const FieldPath path = pair.Field("measurement");
  const FieldPath covariance = path.Field("covariance");
  Violations violations;
  CheckMeasurement(message, path, &violations);
  DecodeCovariance(message.covariance(), space, covariance,
                   &measurement.covariance, &violations);
  if (violations.count() == 0) {
    CheckPositiveDefinite(measurement.covariance, space, covariance,
                          &violations);
  }
  if (violations.count() > 0) return violations.ToStatus();
  return std::optional<core::LoopMeasurement>(measurement);
}

}  // namespace revisit::server
