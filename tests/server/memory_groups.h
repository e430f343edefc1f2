// The contract of groups in the plainest way, as memory_storage.h is for the
// rest.
#ifndef REVISIT_TESTS_SERVER_MEMORY_GROUPS_H_
#define REVISIT_TESTS_SERVER_MEMORY_GROUPS_H_

#include <cstdint>
#include <functional>
#include <map>
#include <mutex>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/storage/group_storage.h"

namespace revisit::server {

// Writes are done, and answered, before the call returns.
class MemoryGroups final : public GroupStorage {
 public:
  // The id of a vehicle, if it is there.
  using IdOf = std::function<std::optional<std::string>(VehicleKey)>;

  // `mutex` is held while `id_of` is called.
  MemoryGroups(std::mutex* mutex, IdOf id_of)
      : mutex_(*mutex), id_of_(std::move(id_of)) {}

  // Removes a vehicle from its groups, with its links, and links that name a
  // pose of it after a sequence. REQUIRES: the mutex is held.
  void Leave(VehicleKey vehicle);
  void Cut(VehicleKey vehicle, std::uint64_t last_sequence);

  void CreateGroup(GroupRecord group, Done done) override;
  void ChangeGroup(std::string id, std::optional<GroupVersion> expected,
                   std::vector<GroupChange> changes, Done done) override;
  void DeleteGroup(std::string id, std::optional<GroupVersion> expected,
                   Done done) override;

  absl::StatusOr<GroupRecord> GetGroup(const std::string& id) override;
  absl::StatusOr<std::vector<GroupRecord>> ListGroups(
      const std::string& after_id, const std::string& prefix,
      int limit) override;
  absl::StatusOr<std::vector<GroupRecord>> ListGroupVersions(
      const std::optional<std::vector<std::string>>& ids) override;
  absl::StatusOr<std::vector<GroupMemberRecord>> ListMembers(
      const std::string& group_id, const std::string& after_vehicle_id,
      int limit) override;
  absl::StatusOr<std::vector<std::string>> ListGroupsOf(
      VehicleKey vehicle) override;
  absl::StatusOr<std::vector<GroupLinkRecord>> ListLinks(
      const std::string& group_id, const std::string& after_id,
      int limit) override;
  absl::StatusOr<std::vector<PlacedLink>> ListLinksOf(VehicleKey vehicle,
                                                      const LinkPlace& after,
                                                      int limit) override;

 private:
  struct Group {
    GroupRecord record;
    // By the vehicle's id.
    std::map<std::string, GroupMemberRecord> members;
    std::map<std::string, GroupLinkRecord> links;
  };

  // The group, if it is as expected.
  absl::StatusOr<Group*> Find(const std::string& id,
                              const std::optional<GroupVersion>& expected);
  absl::Status Apply(const GroupChange& change, Group* group) const;
  // Null if the vehicle is no member.
  static GroupMemberRecord* MemberOf(Group* group, VehicleKey vehicle);
  // Removes the links for which this holds; returns whether there were any.
  static bool RemoveLinks(
      Group* group, const std::function<bool(const GroupLinkRecord&)>& goes);

  std::mutex& mutex_;
  const IdOf id_of_;
  std::map<std::string, Group> groups_;
};

}  // namespace revisit::server

#endif  // REVISIT_TESTS_SERVER_MEMORY_GROUPS_H_
