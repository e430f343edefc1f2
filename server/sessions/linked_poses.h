// The poses of a vehicle to which loop closures of groups refer.
#ifndef REVISIT_SERVER_SESSIONS_LINKED_POSES_H_
#define REVISIT_SERVER_SESSIONS_LINKED_POSES_H_

#include <cstdint>
#include <vector>

#include "absl/status/statusor.h"
#include "server/storage/group_storage.h"

namespace revisit::server {

// Their sequences, in no order, of loop closures in any state, since one that
// is not believed now may be believed again. A rejected candidate keeps no
// poses, as one of a vehicle's own does not. Blocks on the storage, which it
// reads some links at a time, so that one which is added meanwhile may be
// missing. DATA_LOSS (STORE_CORRUPT) if a link is damaged: nobody knows which
// pose it names.
absl::StatusOr<std::vector<std::uint64_t>> ReadLinkedPoses(GroupStorage* groups,
                                                           VehicleKey vehicle);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SESSIONS_LINKED_POSES_H_
