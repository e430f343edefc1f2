// The records of groups that a storage keeps (group_storage.h).
#ifndef REVISIT_SERVER_STORAGE_GROUP_RECORDS_H_
#define REVISIT_SERVER_STORAGE_GROUP_RECORDS_H_

#include <cstddef>
#include <cstdint>
#include <string>
#include <variant>
#include <vector>

#include "absl/status/status.h"
#include "server/storage/records.h"

namespace revisit::server {

// Which group of an id, since one may be deleted and another made in its place,
// and how often it was changed.
struct GroupVersion {
  std::string uid;
  // 1 for a new group; rises by one with each write.
  std::uint64_t revision = 0;
};

inline bool operator==(const GroupVersion& a, const GroupVersion& b) {
  return a.uid == b.uid && a.revision == b.revision;
}
inline bool operator!=(const GroupVersion& a, const GroupVersion& b) {
  return !(a == b);
}

// Vehicles whose histories are searched together.
struct GroupRecord {
  std::string id;
  GroupVersion version;
  std::string payload;
  // DATA_LOSS if the row is damaged: then only id and version are set, as the
  // row claims them.
  absl::Status damage = absl::OkStatus();
};

// A vehicle in a group.
struct GroupMemberRecord {
  VehicleKey vehicle = 0;
  std::string payload;
  // Given by the storage.
  std::string vehicle_id = std::string();
  // DATA_LOSS if the row is damaged: then the payload is empty.
  absl::Status damage = absl::OkStatus();
};

// A pose of a vehicle.
struct VehiclePose {
  VehicleKey vehicle = 0;
  std::uint64_t sequence = 0;
};

inline bool operator==(const VehiclePose& a, const VehiclePose& b) {
  return a.vehicle == b.vehicle && a.sequence == b.sequence;
}

// How far a link is believed. The numbers stand for the states in rows.
enum class LinkState {
  kConfirmed = 1,
  kTentative = 2,
  kSuspect = 3,
  // The two poses are not one place: a rejected candidate.
  kRejected = 4
};

// A finding about two poses of two members of a group.
struct GroupLinkRecord {
  // Unique in its group.
  std::string id;
  LinkState state = LinkState::kConfirmed;
  VehiclePose query;
  VehiclePose matched;
  std::string payload = std::string();
  // DATA_LOSS if the row is damaged: then only the id is set.
  absl::Status damage = absl::OkStatus();
};

// A link among those of several groups. Places are compared as (group, id); the
// default one is before all.
struct LinkPlace {
  std::string group;
  std::string id;
};

struct PlacedLink {
  std::string group;
  GroupLinkRecord link;
};

// ---- Changes of a group

struct SetGroupPayload {
  std::string payload;
};
struct AddGroupMember {
  GroupMemberRecord member;
};
// Replaces the payload, also of a damaged row.
struct SetGroupMember {
  GroupMemberRecord member;
};
// Removes the vehicle's links in this group too.
struct RemoveGroupMember {
  VehicleKey vehicle = 0;
};
struct AddGroupLink {
  GroupLinkRecord link;
};
// Replaces state and payload.
struct SetGroupLink {
  std::string id;
  LinkState state = LinkState::kConfirmed;
  std::string payload;
};
struct RemoveGroupLink {
  std::string id;
};

using GroupChange = std::variant<SetGroupPayload, AddGroupMember,
                                 SetGroupMember, RemoveGroupMember,
                                 AddGroupLink, SetGroupLink, RemoveGroupLink>;

// About what the changes write.
std::size_t BytesOf(const std::vector<GroupChange>& changes);
// Whether they leave less behind than there was.
bool OnlyRemove(const std::vector<GroupChange>& changes);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_GROUP_RECORDS_H_
