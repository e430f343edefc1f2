// The contract of the part of a storage (storage.h) that keeps groups of
// vehicles, their members, and the links between these.
//
// A group has no owner: any server writes it. Each write is one step, which is
// there whole or not at all, and which raises the group's revision by one; so
// does each deletion of a vehicle that is a member, and each loss of poses that
// takes links along (Storage::DeleteVehicle(), Storage::DropDamaged()), in the
// same step. Writes
// of a group come one after the other, whoever makes them, and each sees what
// those before it have left.
//
// A write may name the version that it expects: where the group has another, it
// is ABORTED (REVISION_MISMATCH; metadata `revision`), and nothing is written.
// A write that was answered with UNAVAILABLE may be there or not, and may still
// come to be there until another write of the group is answered otherwise; one
// that names a version is never done twice, so it may be sent again.
//
// Damage affects its own row only: a damaged group, member or link is returned
// with `damage` set, beside all others, and can be deleted or removed.
//
// Ids and payloads are bytes that the storage does not interpret; ids are
// ASCII. Other errors, threads and durability are as in storage.h; besides, of
// all calls, NOT_FOUND (GROUP_NOT_FOUND) for an id of no group.
//
// Thread-safe.
#ifndef REVISIT_SERVER_STORAGE_GROUP_STORAGE_H_
#define REVISIT_SERVER_STORAGE_GROUP_STORAGE_H_

#include <cstdint>
#include <functional>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "server/storage/group_records.h"

namespace revisit::server {

class GroupStorage {
 public:
  // Called once with the outcome of a write, and with the revision that it gave
  // the group, on a thread that writes: return soon, and do not block on the
  // storage.
  using Done = std::function<void(absl::StatusOr<std::uint64_t>)>;

  virtual ~GroupStorage() = default;

  // Reads id, uid and payload of the record; the group begins at revision 1,
  // without members. ALREADY_EXISTS (GROUP_EXISTS) if the id is taken, by
  // this very write if it was sent again: the uid tells.
  virtual void CreateGroup(GroupRecord group, Done done) = 0;
  // Makes changes one after the other, all in one step; with none, only the
  // revision rises. Errors, of which the first one ends the step:
  // DATA_LOSS (STORE_CORRUPT) where a part of a damaged row would stay in what
  // SetGroupPayload or SetGroupLink write; ALREADY_EXISTS (MEMBER_EXISTS) and
  // (LOOP_CLOSURE_EXISTS) for what is there already; NOT_FOUND
  // (VEHICLE_NOT_FOUND) for a member that is no vehicle, (MEMBER_NOT_FOUND) for
  // a vehicle that is no member, which the ends of a new link have to be, and
  // (LOOP_CLOSURE_NOT_FOUND).
  virtual void ChangeGroup(std::string id, std::optional<GroupVersion> expected,
                           std::vector<GroupChange> changes, Done done) = 0;
  // Removes the group with its members and links. The revision in the answer is
  // the one that it would have.
  virtual void DeleteGroup(std::string id, std::optional<GroupVersion> expected,
                           Done done) = 0;

  virtual absl::StatusOr<GroupRecord> GetGroup(const std::string& id) = 0;
  // The groups whose ids start with `prefix` and come after `after_id`, ordered
  // by id.
  virtual absl::StatusOr<std::vector<GroupRecord>> ListGroups(
      const std::string& after_id, const std::string& prefix, int limit) = 0;
  // Id and version of these groups, or of all, ordered by id, for those who
  // look often for what has changed: other members of the records are not set.
  // Groups that are not there are left out.
  virtual absl::StatusOr<std::vector<GroupRecord>> ListGroupVersions(
      const std::optional<std::vector<std::string>>& ids) = 0;
  // The members whose vehicles' ids come after `after_vehicle_id`, ordered by
  // these.
  virtual absl::StatusOr<std::vector<GroupMemberRecord>> ListMembers(
      const std::string& group_id, const std::string& after_vehicle_id,
      int limit) = 0;
  // The ids of the groups of a vehicle, in order. NOT_FOUND (VEHICLE_NOT_FOUND)
  // for a key without a vehicle, here and below.
  virtual absl::StatusOr<std::vector<std::string>> ListGroupsOf(
      VehicleKey vehicle) = 0;
  // The links whose ids come after `after_id`, ordered by id.
  virtual absl::StatusOr<std::vector<GroupLinkRecord>> ListLinks(
      const std::string& group_id, const std::string& after_id, int limit) = 0;
  // The links of all groups of which an end is at a vehicle, behind `after`, in
  // order: the poses that they name are to be kept.
  virtual absl::StatusOr<std::vector<PlacedLink>> ListLinksOf(
      VehicleKey vehicle, const LinkPlace& after, int limit) = 0;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_GROUP_STORAGE_H_
