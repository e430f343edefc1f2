// A group as it is stored, as of one version.
#ifndef REVISIT_SERVER_FLEET_STORED_GROUP_H_
#define REVISIT_SERVER_FLEET_STORED_GROUP_H_

#include <cstdint>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "server/fields/group_settings.h"
#include "server/storage/group_storage.h"

namespace revisit::server {

// A link that ties frames.
struct StoredLink {
  std::int64_t create_time_ns = 0;
  GroupLinkRecord record;
};

struct StoredGroup {
  std::string id;
  GroupVersion version;
  GroupSettings settings;
  // By the vehicles' ids.
  std::vector<GroupMemberRecord> members;
  // In the order in which they were added.
  std::vector<StoredLink> links;
  // Rejected candidates, in no order.
  std::vector<GroupLinkRecord> rejected;
};

// Damaged links tie nothing and are left out; damaged members are there.
// Errors: those of the storage; DATA_LOSS (STORE_CORRUPT) if the group itself
// is damaged. UNAVAILABLE where it changed again and again meanwhile.
absl::StatusOr<StoredGroup> ReadStoredGroup(GroupStorage* groups,
                                            const std::string& id);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_FLEET_STORED_GROUP_H_
