#include "server/records/pair_content.h"

#include "server/base/status.h"
#include "server/fields/field_violations.h"
#include "server/fields/loop_measurement.h"
#include "server/records/stored_records.pb.h"

namespace revisit::server {

std::string EncodePairContent(const PairContent& content) {
  stored::PosePairContent stored;
  if (content.measurement) {
    SetMeasurement(*content.measurement, stored.mutable_measurement());
  }
  stored.set_note(content.note);
  if (content.score) stored.set_score(*content.score);
  stored.set_decided_by(content.decided_by);
  stored.set_deleted_by(content.deleted_by);
  return stored.SerializeAsString();
}

absl::Status ReadPairContent(
    const std::string& payload,
    const std::function<void(const PairContent&)>& read) {
  stored::PosePairContent stored;
  if (!stored.ParseFromString(payload)) {
    return Corrupt("a stored pair of poses is not a PosePairContent");
  }
  PairContent content;
  if (stored.has_measurement()) {
    content.measurement = MeasurementFieldsOf(stored.measurement());
  }
  content.note = stored.note();
  if (stored.has_score()) content.score = stored.score();
  content.decided_by = stored.decided_by();
  content.deleted_by = stored.deleted_by();
  read(content);
  return absl::OkStatus();
}

bool PairContentsSayTheSame(const std::string& payload,
                            const std::string& other) {
  if (payload == other) return true;
  stored::PosePairContent content;
  stored::PosePairContent other_content;
  if (!content.ParseFromString(payload) ||
      !other_content.ParseFromString(other)) {
    return false;
  }
  content.clear_decided_by();
  other_content.clear_decided_by();
  return content.SerializeAsString() == other_content.SerializeAsString();
}

std::string PairContentWithDeleter(const std::string& payload,
                                   const std::string& deleted_by) {
  stored::PosePairContent stored;
  // A payload that does not decode was found when the vehicle was loaded.
  static_cast<void>(stored.ParseFromString(payload));
  stored.set_deleted_by(deleted_by);
  return stored.SerializeAsString();
}

absl::StatusOr<std::optional<core::LoopMeasurement>> DecodePairMeasurement(
    const std::string& payload, core::StateSpace space) {
  const FieldPath request;
  const FieldPath pair = request.Field("loop_closure");
  const FieldPath path = pair.Field("measurement");
  absl::StatusOr<core::LoopMeasurement> measurement;
  bool is_measured = false;
  const absl::Status readable =
      ReadPairContent(payload, [&](const PairContent& content) {
        is_measured = content.measurement.has_value();
        if (is_measured) {
          measurement = DecodeMeasurement(*content.measurement, space, path);
        }
      });
  if (!readable.ok()) return readable;
  if (!is_measured) return std::optional<core::LoopMeasurement>();
  if (!measurement.ok()) return measurement.status();
  return std::optional<core::LoopMeasurement>(*measurement);
}

}  // namespace revisit::server
