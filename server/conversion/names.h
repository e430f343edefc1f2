// Names of resources and the ids in them.
#ifndef REVISIT_SERVER_CONVERSION_NAMES_H_
#define REVISIT_SERVER_CONVERSION_NAMES_H_

#include <cstdint>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/fields/field_violations.h"
#include "server/storage/records.h"

namespace revisit::server {

// `vehicles/{vehicle}`.
std::string VehicleName(const std::string& vehicle_id);

// `vehicles/{vehicle}/loopClosures/{loop_closure}` or
// `vehicles/{vehicle}/rejectedCandidates/{rejected_candidate}`.
std::string PosePairResourceName(PairKind kind, const std::string& vehicle_id,
                                 const std::string& id);

// `vehicles/{vehicle}/deletedPosePairs/{number}`.
std::string DeletedPairResourceName(const std::string& vehicle_id,
                                    std::uint64_t number);

// `vehicles/{vehicle}/recordings/{first_sequence}`.
std::string RecordingName(const std::string& vehicle_id,
                          std::uint64_t first_sequence);

// `vehicles/{vehicle}/checks/{sequence}`.
std::string CheckName(const std::string& vehicle_id, std::uint64_t sequence);
// `vehicles/{vehicle}/checks/{sequence}/candidates/{number}`.
std::string CheckCandidateName(const std::string& vehicle_id,
                               std::uint64_t sequence, std::uint32_t number);

// `groups/{group}`.
std::string GroupName(const std::string& group_id);
// `groups/{group}/members/{vehicle}`.
std::string MemberName(const std::string& group_id,
                       const std::string& vehicle_id);
// `groups/{group}/loopClosures/{loop_closure}` or
// `groups/{group}/rejectedCandidates/{rejected_candidate}`.
std::string GroupLinkName(PairKind kind, const std::string& group_id,
                          const std::string& id);

// INVALID_ARGUMENT (INVALID_RESOURCE_NAME) unless the id matches the pattern of
// ids.
absl::Status CheckId(const std::string& id, const FieldPath& path);

// The id in `vehicles/{vehicle}`.
absl::StatusOr<std::string> ParseVehicleName(const std::string& name,
                                             const FieldPath& path);

// The id in `groups/{group}`.
absl::StatusOr<std::string> ParseGroupName(const std::string& name,
                                           const FieldPath& path);

// The ids in the name of what belongs to a group.
struct NameInGroup {
  std::string group_id;
  // The id of the vehicle, the loop closure, or the rejected candidate.
  std::string id;
};
absl::StatusOr<NameInGroup> ParseMemberName(const std::string& name,
                                            const FieldPath& path);
absl::StatusOr<NameInGroup> ParseGroupLinkName(PairKind kind,
                                               const std::string& name,
                                               const FieldPath& path);

// INVALID_ARGUMENT (INVALID_FIELD) unless the uid of a vehicle is empty or has
// the form of one.
absl::Status CheckUid(const std::string& uid, const FieldPath& path);

// The ids in the name of a pair of poses.
struct PosePairName {
  std::string vehicle_id;
  std::string id;
};
absl::StatusOr<PosePairName> ParsePosePairName(PairKind kind,
                                               const std::string& name,
                                               const FieldPath& path);

// The parts of the name of a check, or of a candidate of one: then `number` is
// not 0.
struct ParsedCheckName {
  std::string vehicle_id;
  std::uint64_t sequence = 0;
  std::uint32_t number = 0;
};
absl::StatusOr<ParsedCheckName> ParseCheckName(const std::string& name,
                                               const FieldPath& path);
absl::StatusOr<ParsedCheckName> ParseCheckCandidateName(const std::string& name,
                                                        const FieldPath& path);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_CONVERSION_NAMES_H_
