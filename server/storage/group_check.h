// The checks of the rows of groups (group_records.h), and the errors that all
// storages answer with, as record_check.h has them for the rest.
#ifndef REVISIT_SERVER_STORAGE_GROUP_CHECK_H_
#define REVISIT_SERVER_STORAGE_GROUP_CHECK_H_

#include <cstdint>
#include <optional>
#include <string>

#include "absl/status/status.h"
#include "server/storage/group_records.h"

namespace revisit::server {

// ---- Errors

// ALREADY_EXISTS (GROUP_EXISTS).
absl::Status GroupExists(const std::string& id);
// NOT_FOUND (GROUP_NOT_FOUND).
absl::Status NoSuchGroup(const std::string& id);
// ALREADY_EXISTS (MEMBER_EXISTS).
absl::Status MemberExists(const std::string& group_id, VehicleKey vehicle);
// NOT_FOUND (MEMBER_NOT_FOUND).
absl::Status NoSuchMember(const std::string& group_id, VehicleKey vehicle);
// ALREADY_EXISTS (LOOP_CLOSURE_EXISTS).
absl::Status LinkExists(const std::string& id);
// NOT_FOUND (LOOP_CLOSURE_NOT_FOUND).
absl::Status NoSuchLink(const std::string& id);
// ABORTED (REVISION_MISMATCH) unless the group is as it was expected.
absl::Status CheckVersion(const GroupRecord& group,
                          const std::optional<GroupVersion>& expected);

// ---- Rows as they were read; each sets `damage`, and clears the members that
// a damaged row does not give.

void CheckGroupRow(std::int64_t format, std::int64_t checksum,
                   GroupRecord* group);
void CheckMemberRow(std::int64_t format, std::int64_t checksum,
                    const std::string& group_id, GroupMemberRecord* member);
// `state` is the number in the row.
void CheckLinkRow(std::int64_t format, std::int64_t checksum,
                  const std::string& group_id, std::int64_t state,
                  GroupLinkRecord* link);

// The number that stands for a state in rows.
constexpr std::int64_t NumberOf(LinkState state) {
  return static_cast<std::int64_t>(state);
}

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_GROUP_CHECK_H_
