#include "server/storage/postgres/postgres_groups.h"

#include <algorithm>
#include <utility>

#include "server/storage/kept_answer.h"
#include "server/storage/postgres/postgres_group_changes.h"
#include "server/storage/postgres/postgres_group_reads.h"
#include "server/storage/read_only_storage.h"

namespace revisit::server {

void PostgresGroups::Submit(std::size_t bytes, Write write, Done done) {
  if (writer_ == nullptr) {
    done(OpenedForReading());
    return;
  }
  const KeptAnswer<std::uint64_t> revision;
  writer_->Submit(
      /*key=*/0, bytes,
      [write = std::move(write), revision](PostgresConnection& connection,
                                           const Fence&) {
        return revision.Keep(write(connection));
      },
      revision.Then(std::move(done)));
}

void PostgresGroups::CreateGroup(GroupRecord group, Done done) {
  const std::size_t bytes = group.payload.size();
  group.version.revision = 1;
  Submit(
      bytes,
      [group = std::move(group)](PostgresConnection& connection) {
        return InsertGroup(connection, group);
      },
      std::move(done));
}

void PostgresGroups::ChangeGroup(std::string id,
                                 std::optional<GroupVersion> expected,
                                 std::vector<GroupChange> changes, Done done) {
  const std::size_t bytes = BytesOf(changes);
  Submit(
      bytes,
      [id = std::move(id), expected = std::move(expected),
       changes = std::move(changes)](PostgresConnection& connection) {
        return ChangeGroupRows(connection, id, expected, changes);
      },
      std::move(done));
}

void PostgresGroups::DeleteGroup(std::string id,
                                 std::optional<GroupVersion> expected,
                                 Done done) {
  Submit(
      0,
      [id = std::move(id),
       expected = std::move(expected)](PostgresConnection& connection) {
        return RemoveGroup(connection, id, expected);
      },
      std::move(done));
}

absl::StatusOr<GroupRecord> PostgresGroups::GetGroup(const std::string& id) {
  return connections_->Answer<GroupRecord>([&](PostgresConnection& connection) {
    return FindGroup(connection, id);
  });
}

absl::StatusOr<std::vector<GroupRecord>> PostgresGroups::ListGroups(
    const std::string& after_id, const std::string& prefix, int limit) {
  return connections_->Answer<std::vector<GroupRecord>>(
      [&](PostgresConnection& connection) {
        return FindGroups(connection, after_id, prefix, limit);
      });
}

absl::StatusOr<std::vector<GroupRecord>> PostgresGroups::ListGroupVersions(
    const std::optional<std::vector<std::string>>& ids) {
  return connections_->Answer<std::vector<GroupRecord>>(
      [&](PostgresConnection& connection) {
        return FindGroupVersions(connection, ids);
      });
}

absl::StatusOr<std::vector<GroupMemberRecord>> PostgresGroups::ListMembers(
    const std::string& group_id, const std::string& after_vehicle_id,
    int limit) {
  return connections_->Answer<std::vector<GroupMemberRecord>>(
      [&](PostgresConnection& connection) {
        return FindMembers(connection, group_id, after_vehicle_id, limit);
      });
}

absl::StatusOr<std::vector<std::string>> PostgresGroups::ListGroupsOf(
    VehicleKey vehicle) {
  return connections_->Answer<std::vector<std::string>>(
      [&](PostgresConnection& connection) {
        return FindGroupsOf(connection, vehicle);
      });
}

absl::StatusOr<std::vector<GroupLinkRecord>> PostgresGroups::ListLinks(
    const std::string& group_id, const std::string& after_id, int limit) {
  return connections_->Answer<std::vector<GroupLinkRecord>>(
      [&](PostgresConnection& connection) {
        return FindLinks(connection, group_id, after_id, limit);
      });
}

absl::StatusOr<std::vector<PlacedLink>> PostgresGroups::ListLinksOf(
    VehicleKey vehicle, const LinkPlace& after, int limit) {
  return connections_->Answer<std::vector<PlacedLink>>(
      [&](PostgresConnection& connection) {
        return FindLinksOf(connection, vehicle, after, limit);
      });
}

}  // namespace revisit::server
