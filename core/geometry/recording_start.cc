#include "core/geometry/recording_start.h"

namespace revisit::core {

Covariance UsualGap() {
  Covariance covariance;
  for (int i = 0; i < 3; ++i) covariance(i, i) = 10.0 * 10.0;
  covariance(3, 3) = 0.3 * 0.3;
  return covariance;
}

std::optional<Defect> FindDefect(const RecordingStart& start,
                                 StateSpace space) {
  if (start.relation == RecordingRelation::kUnknown) return std::nullopt;
  const bool has_datum = start.relation == RecordingRelation::kDatum;
  PoseSample sample;
  if (has_datum) sample.pose = start.datum;
  sample.covariance = start.covariance;
  std::optional<Defect> defect = FindDefect(sample, space);
  if (!defect) return std::nullopt;
  if (!has_datum) {
    defect->part = "after";
  } else {
    defect->part =
        defect->part == "covariance" ? "datum.covariance" : "datum.pose";
  }
  return defect;
}

bool operator==(const RecordingStart& a, const RecordingStart& b) {
  const auto same = [](const Pose& p, const Pose& q) {
    return p.x == q.x && p.y == q.y && p.z == q.z && p.heading == q.heading;
  };
  return a.relation == b.relation && a.covariance.upper == b.covariance.upper &&
         same(a.datum, b.datum) && a.datum_id == b.datum_id &&
         a.label == b.label;
}

}  // namespace revisit::core
