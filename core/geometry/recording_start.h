// Where a recording begins: one run of an estimator, whose poses are in a frame
// of their own. A drive has one or many, one behind the other.
#ifndef REVISIT_CORE_GEOMETRY_RECORDING_START_H_
#define REVISIT_CORE_GEOMETRY_RECORDING_START_H_

#include <cstddef>
#include <optional>
#include <string>

#include "core/geometry/pose.h"
#include "core/geometry/state_space.h"

namespace revisit::core {

// How much is known of where a recording's frame lies.
enum class RecordingRelation {
  // Its first pose is at the last pose of the recording before it.
  kAfter,
  // Its frame was placed in one that it shares with other recordings.
  kDatum,
  // Nothing.
  kUnknown,
};

struct RecordingStart {
  RecordingRelation relation = RecordingRelation::kAfter;
  // kAfter: of the first pose's error as seen from the last one before it, in
  // the axes of the new frame. kDatum: of the error of the datum at the first
  // pose, in the axes of the shared frame. Not used for kUnknown.
  Covariance covariance;
  // For kDatum only: the pose of the recording's frame in the shared one, and
  // the name of the datum. Recordings of one datum, with the same name, err
  // together: between them there is no error but their own. Datums without a
  // name err by themselves.
  Pose datum;
  std::string datum_id;
  // For people.
  std::string label;
};

// The covariance of kAfter where none is given: a car that was parked and moved
// a little.
Covariance UsualGap();

// Most recordings of a drive.
inline constexpr std::size_t kMostRecordings = 1000;

// The first defect in this state space, or nothing; its `part` is "after",
// "datum.pose" or "datum.covariance".
std::optional<Defect> FindDefect(const RecordingStart& start, StateSpace space);

bool operator==(const RecordingStart& a, const RecordingStart& b);
inline bool operator!=(const RecordingStart& a, const RecordingStart& b) {
  return !(a == b);
}

}  // namespace revisit::core

#endif  // REVISIT_CORE_GEOMETRY_RECORDING_START_H_
