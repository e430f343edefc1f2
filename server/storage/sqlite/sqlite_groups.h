// The groups of a storage in a SQLite file.
#ifndef REVISIT_SERVER_STORAGE_SQLITE_SQLITE_GROUPS_H_
#define REVISIT_SERVER_STORAGE_SQLITE_SQLITE_GROUPS_H_

#include <cstdint>
#include <functional>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "server/storage/group_storage.h"
#include "server/storage/sqlite/reader_pool.h"
#include "server/storage/sqlite/sqlite_database.h"
#include "server/storage/sqlite/sqlite_writer.h"

namespace revisit::server {

// Thread-safe.
class SqliteGroups final : public GroupStorage {
 public:
  // Both outlive this. `writer` is null in a store that was opened for reading,
  // where writes are FAILED_PRECONDITION.
  SqliteGroups(ReaderPool* readers, SqliteWriter* writer)
      : readers_(readers), writer_(writer) {}

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
  // Returns the revision that the group has then.
  using Write = std::function<absl::StatusOr<std::uint64_t>(SqliteDatabase&)>;
  void Submit(std::size_t bytes, PendingWrite::Need need, Write write,
              Done done);

  ReaderPool* const readers_;
  SqliteWriter* const writer_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_SQLITE_SQLITE_GROUPS_H_
