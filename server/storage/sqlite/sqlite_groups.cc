#include "server/storage/sqlite/sqlite_groups.h"

#include <algorithm>
#include <utility>

#include "server/storage/kept_answer.h"
#include "server/storage/read_only_storage.h"
#include "server/storage/sqlite/group_rows.h"
#include "server/storage/sqlite/link_rows.h"
#include "server/storage/sqlite/member_rows.h"
#include "server/storage/sqlite/vehicle_rows.h"

namespace revisit::server {

void SqliteGroups::Submit(std::size_t bytes, PendingWrite::Need need,
                          Write write, Done done) {
  if (writer_ == nullptr) {
    done(OpenedForReading());
    return;
  }
  const KeptAnswer<std::uint64_t> revision;
  writer_->Submit(
      bytes,
      [write = std::move(write), revision](SqliteDatabase& database) {
        return revision.Keep(write(database));
      },
      revision.Then(std::move(done)), need);
}

void SqliteGroups::CreateGroup(GroupRecord group, Done done) {
  const std::size_t bytes = group.payload.size();
  group.version.revision = 1;
  Submit(
      bytes, PendingWrite::Need::kRoom,
      [group = std::move(group)](
          SqliteDatabase& database) -> absl::StatusOr<std::uint64_t> {
        const absl::Status status = InsertGroup(database, group);
        if (!status.ok()) return status;
        return group.version.revision;
      },
      std::move(done));
}

void SqliteGroups::ChangeGroup(std::string id,
                               std::optional<GroupVersion> expected,
                               std::vector<GroupChange> changes, Done done) {
  const std::size_t bytes = BytesOf(changes);
  const PendingWrite::Need need = OnlyRemove(changes)
                                      ? PendingWrite::Need::kLittle
                                      : PendingWrite::Need::kRoom;
  Submit(
      bytes, need,
      [id = std::move(id), expected = std::move(expected),
       changes = std::move(changes)](SqliteDatabase& database) {
        return ChangeGroupRows(database, id, expected, changes);
      },
      std::move(done));
}

void SqliteGroups::DeleteGroup(std::string id,
                               std::optional<GroupVersion> expected,
                               Done done) {
  Submit(
      0, PendingWrite::Need::kLittle,
      [id = std::move(id),
       expected = std::move(expected)](SqliteDatabase& database) {
        return RemoveGroup(database, id, expected);
      },
      std::move(done));
}

absl::StatusOr<GroupRecord> SqliteGroups::GetGroup(const std::string& id) {
  return readers_->Answer<GroupRecord>(
      [&](SqliteDatabase& database) { return FindGroup(database, id); });
}

absl::StatusOr<std::vector<GroupRecord>> SqliteGroups::ListGroups(
    const std::string& after_id, const std::string& prefix, int limit) {
  return readers_->Answer<std::vector<GroupRecord>>(
      [&](SqliteDatabase& database) {
        return FindGroups(database, after_id, prefix, limit);
      });
}

absl::StatusOr<std::vector<GroupRecord>> SqliteGroups::ListGroupVersions(
    const std::optional<std::vector<std::string>>& ids) {
  return readers_->Answer<std::vector<GroupRecord>>(
      [&](SqliteDatabase& database) {
        return FindGroupVersions(database, ids);
      });
}

absl::StatusOr<std::vector<GroupMemberRecord>> SqliteGroups::ListMembers(
    const std::string& group_id, const std::string& after_vehicle_id,
    int limit) {
  using Members = std::vector<GroupMemberRecord>;
  return readers_->Answer<Members>(
      [&](SqliteDatabase& database) -> absl::StatusOr<Members> {
        const absl::Status group = FindGroup(database, group_id).status();
        if (!group.ok()) return group;
        return FindMembers(database, group_id, after_vehicle_id, limit);
      });
}

absl::StatusOr<std::vector<std::string>> SqliteGroups::ListGroupsOf(
    VehicleKey vehicle) {
  using Ids = std::vector<std::string>;
  return readers_->Answer<Ids>(
      [&](SqliteDatabase& database) -> absl::StatusOr<Ids> {
        const absl::Status is_there = VehicleId(database, vehicle).status();
        if (!is_there.ok()) return is_there;
        return FindGroupIdsOf(database, vehicle);
      });
}

absl::StatusOr<std::vector<GroupLinkRecord>> SqliteGroups::ListLinks(
    const std::string& group_id, const std::string& after_id, int limit) {
  using Links = std::vector<GroupLinkRecord>;
  return readers_->Answer<Links>(
      [&](SqliteDatabase& database) -> absl::StatusOr<Links> {
        const absl::Status group = FindGroup(database, group_id).status();
        if (!group.ok()) return group;
        return FindLinks(database, group_id, after_id, limit);
      });
}

absl::StatusOr<std::vector<PlacedLink>> SqliteGroups::ListLinksOf(
    VehicleKey vehicle, const LinkPlace& after, int limit) {
  return readers_->Answer<std::vector<PlacedLink>>(
      [&](SqliteDatabase& database) {
        return FindLinksOf(database, vehicle, after, limit);
      });
}

}  // namespace revisit::server
