// The content of a loop closure, or of a rejected candidate, beside its poses,
// in one vehicle or between two.
#ifndef REVISIT_SERVER_CONVERSION_LOOP_CONTENT_H_
#define REVISIT_SERVER_CONVERSION_LOOP_CONTENT_H_

#include <cstddef>
#include <string>

#include "server/fields/field_violations.h"
#include "server/fields/loop_measurement.h"
#include "server/fields/pose_fields.h"
#include "server/records/pair_content.h"

namespace revisit::server {

inline constexpr std::size_t kMaxNoteBytes = 1024;

// `path` is that of the message with the note.
inline void CheckNote(const std::string& note, const FieldPath& path,
                      Violations* violations) {
  CheckText(note, kMaxNoteBytes, TextUse::kNote, path.Field("note"),
            violations);
}

// What a message of a loop closure at `path` says, which points into it; a
// violation for all that is wrong whatever the state space of the vehicles is.
// `decided_by` is not read.
template <typename LoopClosure>
PairContent LoopContentOf(const LoopClosure& closure, const FieldPath& path,
                          Violations* violations) {
  PairContent content;
  if (closure.has_measurement()) {
    content.measurement = MeasurementFieldsOf(closure.measurement());
    CheckMeasurement(*content.measurement, path.Field("measurement"),
                     violations);
  }
  CheckNote(closure.note(), path, violations);
  content.note = closure.note();
  if (closure.has_score()) {
    CheckFinite(closure.score(), path.Field("score"), violations);
    content.score = closure.score();
  }
  return content;
}

template <typename LoopClosure>
void SetLoopContent(const PairContent& content, LoopClosure* closure) {
  if (content.measurement) {
    SetMeasurement(*content.measurement, closure->mutable_measurement());
  }
  closure->set_note(content.note);
  if (content.score) closure->set_score(*content.score);
  closure->set_decided_by(content.decided_by);
}

// The same of a rejected candidate.
template <typename RejectedCandidate>
PairContent RejectionContentOf(const RejectedCandidate& rejection,
                               const FieldPath& path, Violations* violations) {
  CheckNote(rejection.note(), path, violations);
  PairContent content;
  content.note = rejection.note();
  return content;
}

template <typename RejectedCandidate>
void SetRejectionContent(const PairContent& content,
                         RejectedCandidate* rejection) {
  rejection->set_note(content.note);
  rejection->set_decided_by(content.decided_by);
}

}  // namespace revisit::server

#endif  // REVISIT_SERVER_CONVERSION_LOOP_CONTENT_H_
