#include "server/conversion/pose_pairs.h"

#include "absl/strings/str_cat.h"
#include "server/conversion/loop_content.h"
#include "server/conversion/names.h"
#include "server/fields/field_violations.h"
#include "server/fields/timestamps.h"
#include "server/records/pair_content.h"

namespace revisit::server {
namespace {

// LoopClosure and RejectedCandidate have these fields in common.
template <typename Message>
void CheckSequences(const Message& pair, const FieldPath& path,
                    Violations* violations) {
  if (pair.query_sequence() == 0) {
    violations->Add(kInvalidField, path.Field("query_sequence"),
                    "required: sequences start at 1");
  }
  if (pair.matched_sequence() == 0) {
    violations->Add(kInvalidField, path.Field("matched_sequence"),
                    "required: sequences start at 1");
  } else if (pair.query_sequence() != 0 &&
             pair.matched_sequence() >= pair.query_sequence()) {
    violations->Add(kInvalidField, path.Field("matched_sequence"),
                    absl::StrCat("got ", pair.matched_sequence(),
                                 "; allowed is less than query_sequence, ",
                                 pair.query_sequence()));
  }
}

// The content of a pair beside its poses. Adds a violation for all that is
// wrong whatever the vehicle's state space is.
PairContent ContentOf(const v1::LoopClosure& closure, const FieldPath& path,
                      Violations* violations) {
  return LoopContentOf(closure, path, violations);
}

PairContent ContentOf(const v1::RejectedCandidate& rejection,
                      const FieldPath& path, Violations* violations) {
  return RejectionContentOf(rejection, path, violations);
}

void SetContent(const PairContent& content, v1::LoopClosure* closure) {
  SetLoopContent(content, closure);
}

void SetContent(const PairContent& content, v1::RejectedCandidate* rejection) {
  SetRejectionContent(content, rejection);
}

template <typename Message>
absl::StatusOr<PosePairRecord> DecodePair(PairKind kind, const Message* pair,
                                          const std::string& id,
                                          const std::string& decided_by) {
  const char* const field = WordsOf(kind).field;
  const FieldPath request;
  const FieldPath path = request.Field(field);
  Violations violations;
  PosePairRecord record;
  if (pair == nullptr) {
    violations.Add(kInvalidField, path, "required");
  } else {
    CheckSequences(*pair, path, &violations);
    PairContent content = ContentOf(*pair, path, &violations);
    content.decided_by = decided_by;
    record.payload = EncodePairContent(content);
  }
  if (violations.count() > 0) return violations.ToStatus();
  record.id = !id.empty() ? id
                          : absl::StrCat(pair->query_sequence(), "-",
                                         pair->matched_sequence());
  const std::string id_field = absl::StrCat(field, "_id");
  if (absl::Status status = CheckId(record.id, request.Field(id_field.c_str()));
      !status.ok()) {
    return status;
  }
  record.query_sequence = pair->query_sequence();
  record.matched_sequence = pair->matched_sequence();
  return record;
}

template <typename Message>
void EncodePair(PairKind kind, const std::string& vehicle_id,
                const PosePairRecord& record, Message* message) {
  message->set_name(PosePairResourceName(kind, vehicle_id, record.id));
  message->set_query_sequence(record.query_sequence);
  message->set_matched_sequence(record.matched_sequence);
  EncodeTime(record.create_time_ns, message->mutable_create_time());
  // A payload that does not decode was found when the vehicle was loaded.
  static_cast<void>(ReadPairContent(
      record.payload,
      [&](const PairContent& content) { SetContent(content, message); }));
}

}  // namespace

absl::StatusOr<PosePairRecord> DecodePosePair(const v1::LoopClosure* pair,
                                              const std::string& id,
                                              const std::string& decided_by) {
  return DecodePair(PairKind::kLoopClosure, pair, id, decided_by);
}

absl::StatusOr<PosePairRecord> DecodePosePair(const v1::RejectedCandidate* pair,
                                              const std::string& id,
                                              const std::string& decided_by) {
  return DecodePair(PairKind::kRejectedCandidate, pair, id, decided_by);
}

void EncodePosePair(const std::string& vehicle_id, const PosePairRecord& record,
                    v1::LoopClosure* message) {
  EncodePair(PairKind::kLoopClosure, vehicle_id, record, message);
}

void EncodePosePair(const std::string& vehicle_id, const PosePairRecord& record,
                    v1::RejectedCandidate* message) {
  EncodePair(PairKind::kRejectedCandidate, vehicle_id, record, message);
}

void EncodeDeletedPair(const std::string& vehicle_id,
                       const DeletedPairRecord& record,
                       v1::DeletedPosePair* message) {
  message->set_name(DeletedPairResourceName(vehicle_id, record.number));
  if (record.kind == PairKind::kLoopClosure) {
    EncodePosePair(vehicle_id, record.pair, message->mutable_loop_closure());
  } else {
    EncodePosePair(vehicle_id, record.pair,
                   message->mutable_rejected_candidate());
  }
  EncodeTime(record.delete_time_ns, message->mutable_delete_time());
  // The checksum of the row holds, and the pair was sound before.
  static_cast<void>(
      ReadPairContent(record.pair.payload, [&](const PairContent& content) {
        message->set_deleted_by(content.deleted_by);
      }));
}

}  // namespace revisit::server
