// Loop closures and rejected candidates: pairs of poses that were verified.
#ifndef REVISIT_SERVER_CONVERSION_POSE_PAIRS_H_
#define REVISIT_SERVER_CONVERSION_POSE_PAIRS_H_

#include <string>

#include "absl/status/statusor.h"
#include "revisit/v1/loop_closure.pb.h"
#include "server/storage/records.h"

namespace revisit::server {

// The record that a request for a new pair asks for, without creation time;
// what depends on the vehicle's state space (RecordCodec::DecodeMeasurement())
// is not checked. `pair` is null if it was left out; an id that was left out is
// made from the sequences. `decided_by` is the caller's identity: that of the
// message is not read.
absl::StatusOr<PosePairRecord> DecodePosePair(const v1::LoopClosure* pair,
                                              const std::string& id,
                                              const std::string& decided_by);
absl::StatusOr<PosePairRecord> DecodePosePair(const v1::RejectedCandidate* pair,
                                              const std::string& id,
                                              const std::string& decided_by);

void EncodePosePair(const std::string& vehicle_id, const PosePairRecord& record,
                    v1::LoopClosure* message);
void EncodePosePair(const std::string& vehicle_id, const PosePairRecord& record,
                    v1::RejectedCandidate* message);
void EncodeDeletedPair(const std::string& vehicle_id,
                       const DeletedPairRecord& record,
                       v1::DeletedPosePair* message);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_CONVERSION_POSE_PAIRS_H_
