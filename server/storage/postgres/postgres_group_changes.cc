#include "server/storage/postgres/postgres_group_changes.h"

#include <functional>
#include <set>
#include <utility>
#include <variant>

#include "server/base/status.h"
#include "server/storage/group_check.h"
#include "server/storage/postgres/postgres_group_reads.h"
#include "server/storage/record_check.h"
#include "server/storage/record_checksum.h"

namespace revisit::server {
namespace {

constexpr Statement kInsertGroup = {
    "insert_group",
    "INSERT INTO vehicle_groups (id, format, revision, uid, checksum, payload) "
    "VALUES ($1::text, $2::int8, $3::int8, $4::text, $5::int8, $6::bytea) "
    "ON CONFLICT (id) DO NOTHING RETURNING revision"};
constexpr Statement kRaiseGroup = {
    "raise_group",
    "UPDATE vehicle_groups SET revision = revision + 1 WHERE id = $1::text"};
constexpr Statement kSetGroup = {
    "set_group",
    "UPDATE vehicle_groups SET format = $2::int8, checksum = $3::int8, "
    "payload = $4::bytea WHERE id = $1::text"};
constexpr Statement kRemoveLinksOfGroup = {
    "remove_links_of_group",
    "DELETE FROM group_links WHERE group_id = $1::text"};
constexpr Statement kRemoveMembersOfGroup = {
    "remove_members_of_group",
    "DELETE FROM group_members WHERE group_id = $1::text"};
constexpr Statement kRemoveGroup = {
    "remove_group", "DELETE FROM vehicle_groups WHERE id = $1::text"};

// Keeps the vehicles from being deleted until the transaction ends.
constexpr Statement kHoldVehicles = {
    "hold_vehicles",
    "SELECT key FROM vehicles WHERE key = ANY($1::int8[]) ORDER BY key "
    "FOR KEY SHARE"};

// $1 group, $2 vehicle, $3 format, $4 checksum, $5 payload.
constexpr Statement kInsertMember = {
    "insert_member",
    "INSERT INTO group_members (group_id, vehicle_key, format, checksum, "
    "payload) VALUES ($1::text, $2::int8, $3::int8, $4::int8, $5::bytea) "
    "ON CONFLICT (group_id, vehicle_key) DO NOTHING RETURNING vehicle_key"};
constexpr Statement kSetMember = {
    "set_member",
    "UPDATE group_members SET format = $3::int8, checksum = $4::int8, payload "
    "= $5::bytea WHERE group_id = $1::text AND vehicle_key = $2::int8 "
    "RETURNING vehicle_key"};
constexpr Statement kHasMember = {
    "has_member",
    "SELECT vehicle_key FROM group_members WHERE group_id = $1::text AND "
    "vehicle_key = $2::int8"};
constexpr Statement kRemoveMember = {
    "remove_member",
    "DELETE FROM group_members WHERE group_id = $1::text AND vehicle_key = "
    "$2::int8 RETURNING vehicle_key"};
constexpr Statement kRemoveLinksOfMember = {
    "remove_links_of_member",
    "DELETE FROM group_links WHERE group_id = $1::text AND (query_vehicle = "
    "$2::int8 OR matched_vehicle = $2::int8)"};

// $1 group, $2 id, $3 format, $4 state, $5 and $6 query, $7 and $8 match, $9
// checksum, $10 payload.
constexpr Statement kInsertLink = {
    "insert_link",
    "INSERT INTO group_links (group_id, id, format, state, query_vehicle, "
    "query_sequence, matched_vehicle, matched_sequence, checksum, payload) "
    "VALUES ($1::text, $2::text, $3::int8, $4::int8, $5::int8, $6::int8, "
    "$7::int8, $8::int8, $9::int8, $10::bytea) "
    "ON CONFLICT (group_id, id) DO NOTHING RETURNING format"};
// $1 group, $2 id, $3 format, $4 state, $5 checksum, $6 payload.
constexpr Statement kSetLink = {
    "set_link",
    "UPDATE group_links SET format = $3::int8, state = $4::int8, checksum = "
    "$5::int8, payload = $6::bytea WHERE group_id = $1::text AND id = "
    "$2::text"};
constexpr Statement kRemoveLink = {
    "remove_link",
    "DELETE FROM group_links WHERE group_id = $1::text AND id = $2::text "
    "RETURNING format"};

Parameters MemberParameters(const std::string& group_id,
                            const GroupMemberRecord& member) {
  return Parameters()
      .AddText(group_id)
      .Add(member.vehicle)
      .Add(kSharedRowFormat)
      .Add(ChecksumOfMember(kSharedRowFormat, group_id, member))
      .AddText(member.payload);
}

// Runs a statement that answers a row for each that it has written, or
// `otherwise` where there was none.
absl::Status WriteRow(PostgresConnection& connection,
                      const Statement& statement, const Parameters& parameters,
                      const absl::Status& otherwise) {
  const auto rows = connection.Run(statement, parameters);
  if (!rows.ok()) return rows.status();
  return rows->size() > 0 ? absl::OkStatus() : otherwise;
}

// The changes of a group whose row is held, but for its revision.
struct Changer {
  absl::Status operator()(const SetGroupPayload& change) const {
    // A damaged row that is written again would pass for sound.
    if (!group.damage.ok()) return group.damage;
    GroupRecord changed = group;
    changed.payload = change.payload;
    return connection
        .Run(kSetGroup, Parameters()
                            .AddText(changed.id)
                            .Add(kSharedRowFormat)
                            .Add(ChecksumOfGroup(kSharedRowFormat, changed))
                            .AddText(changed.payload))
        .status();
  }
  absl::Status operator()(const AddGroupMember& change) const {
    if (held_vehicles.count(change.member.vehicle) == 0) {
      return UnknownVehicle(change.member.vehicle);
    }
    return InsertMemberRow(connection, group.id, change.member);
  }
  absl::Status operator()(const SetGroupMember& change) const {
    return WriteRow(connection, kSetMember,
                    MemberParameters(group.id, change.member),
                    NoSuchMember(group.id, change.member.vehicle));
  }
  absl::Status operator()(const RemoveGroupMember& change) const {
    const Parameters member =
        Parameters().AddText(group.id).Add(change.vehicle);
    const absl::Status status =
        WriteRow(connection, kRemoveMember, member,
                 NoSuchMember(group.id, change.vehicle));
    if (!status.ok()) return status;
    return connection.Run(kRemoveLinksOfMember, member).status();
  }
  absl::Status operator()(const AddGroupLink& change) const {
    for (const VehiclePose& end : {change.link.query, change.link.matched}) {
      const absl::Status status =
          WriteRow(connection, kHasMember,
                   Parameters().AddText(group.id).Add(end.vehicle),
                   NoSuchMember(group.id, end.vehicle));
      if (!status.ok()) return status;
    }
    return InsertLinkRow(connection, group.id, change.link);
  }
  absl::Status operator()(const SetGroupLink& change) const {
    absl::StatusOr<GroupLinkRecord> link =
        FindLink(connection, group.id, change.id);
    if (!link.ok()) return link.status();
    if (!link->damage.ok()) return link->damage;
    link->state = change.state;
    link->payload = change.payload;
    return connection
        .Run(kSetLink,
             Parameters()
                 .AddText(group.id)
                 .AddText(link->id)
                 .Add(kSharedRowFormat)
                 .Add(NumberOf(link->state))
                 .Add(ChecksumOfLink(kSharedRowFormat, group.id, *link))
                 .AddText(link->payload))
        .status();
  }
  absl::Status operator()(const RemoveGroupLink& change) const {
    return WriteRow(connection, kRemoveLink,
                    Parameters().AddText(group.id).AddText(change.id),
                    NoSuchLink(change.id));
  }

  PostgresConnection& connection;
  const GroupRecord& group;
  const std::set<VehicleKey>& held_vehicles;
};

// Holds the vehicles that are to become members; returns those that are there.
absl::StatusOr<std::set<VehicleKey>> HoldNewMembers(
    PostgresConnection& connection, const std::vector<GroupChange>& changes) {
  std::vector<std::int64_t> keys;
  for (const GroupChange& change : changes) {
    if (const auto* add = std::get_if<AddGroupMember>(&change)) {
      keys.push_back(add->member.vehicle);
    }
  }
  std::set<VehicleKey> held;
  if (keys.empty()) return held;
  const auto rows = connection.Run(kHoldVehicles, Parameters().Add(keys));
  if (!rows.ok()) return rows.status();
  for (int i = 0; i < rows->size(); ++i) held.insert(rows->Integer(i, 0));
  return held;
}

// Makes a change of a group in a transaction that holds its row, if the group
// is as expected; returns the revision after it. `prepare` comes before the row
// is locked.
absl::StatusOr<std::uint64_t> WriteGroup(
    PostgresConnection& connection, const std::string& id,
    const std::optional<GroupVersion>& expected,
    const std::function<absl::Status()>& prepare,
    const std::function<absl::Status(const GroupRecord&)>& change) {
  absl::Status status = CheckKeepsGroups(connection);
  if (!status.ok()) return status;
  std::uint64_t revision = 0;
  status = InTransaction(connection, [&] {
    absl::Status done = prepare();
    if (!done.ok()) return done;
    const absl::StatusOr<GroupRecord> group = HoldGroup(connection, id);
    if (!group.ok()) return group.status();
    done = CheckVersion(*group, expected);
    if (!done.ok()) return done;
    revision = group->version.revision + 1;
    return change(*group);
  });
  if (!status.ok()) return status;
  return revision;
}

}  // namespace

absl::StatusOr<std::uint64_t> InsertGroup(PostgresConnection& connection,
                                          const GroupRecord& group) {
  const absl::Status keeps = CheckKeepsGroups(connection);
  if (!keeps.ok()) return keeps;
  const absl::Status status =
      WriteRow(connection, kInsertGroup,
               Parameters()
                   .AddText(group.id)
                   .Add(kSharedRowFormat)
                   .Add(Signed(group.version.revision))
                   .AddText(group.version.uid)
                   .Add(ChecksumOfGroup(kSharedRowFormat, group))
                   .AddText(group.payload),
               GroupExists(group.id));
  if (!status.ok()) return status;
  return group.version.revision;
}

absl::StatusOr<std::uint64_t> ChangeGroupRows(
    PostgresConnection& connection, const std::string& id,
    const std::optional<GroupVersion>& expected,
    const std::vector<GroupChange>& changes) {
  std::set<VehicleKey> held;
  return WriteGroup(
      connection, id, expected,
      [&] {
        auto vehicles = HoldNewMembers(connection, changes);
        if (!vehicles.ok()) return vehicles.status();
        held = *std::move(vehicles);
        return absl::OkStatus();
      },
      [&](const GroupRecord& group) {
        for (const GroupChange& change : changes) {
          absl::Status status =
              std::visit(Changer{connection, group, held}, change);
          if (!status.ok()) return status;
        }
        return connection.Run(kRaiseGroup, Parameters().AddText(id)).status();
      });
}

absl::StatusOr<std::uint64_t> RemoveGroup(
    PostgresConnection& connection, const std::string& id,
    const std::optional<GroupVersion>& expected) {
  return WriteGroup(
      connection, id, expected, [] { return absl::OkStatus(); },
      [&](const GroupRecord&) {
        for (const Statement& remove :
             {kRemoveLinksOfGroup, kRemoveMembersOfGroup, kRemoveGroup}) {
          absl::Status status =
              connection.Run(remove, Parameters().AddText(id)).status();
          if (!status.ok()) return status;
        }
        return absl::OkStatus();
      });
}

absl::Status InsertMemberRow(PostgresConnection& connection,
                             const std::string& group_id,
                             const GroupMemberRecord& member) {
  return WriteRow(connection, kInsertMember, MemberParameters(group_id, member),
                  MemberExists(group_id, member.vehicle));
}

absl::Status InsertLinkRow(PostgresConnection& connection,
                           const std::string& group_id,
                           const GroupLinkRecord& link) {
  return WriteRow(connection, kInsertLink,
                  Parameters()
                      .AddText(group_id)
                      .AddText(link.id)
                      .Add(kSharedRowFormat)
                      .Add(NumberOf(link.state))
                      .Add(link.query.vehicle)
                      .Add(Signed(link.query.sequence))
                      .Add(link.matched.vehicle)
                      .Add(Signed(link.matched.sequence))
                      .Add(ChecksumOfLink(kSharedRowFormat, group_id, link))
                      .AddText(link.payload),
                  LinkExists(link.id));
}

}  // namespace revisit::server
