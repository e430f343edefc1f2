#include "server/storage/postgres/postgres_group_reads.h"

#include <algorithm>
#include <cstdint>
#include <utility>

#include "server/base/status.h"
#include "server/storage/group_check.h"
#include "server/storage/postgres/postgres_reads.h"
#include "server/storage/record_check.h"

namespace revisit::server {
namespace {

constexpr Statement kKeepsGroups = {
    "keeps_groups", "SELECT to_regclass('vehicle_groups') IS NOT NULL"};

#define REVISIT_SELECT_GROUP \
  "SELECT id, format, revision, uid, checksum, payload FROM vehicle_groups "
constexpr Statement kFindGroup = {"find_group",
                                  REVISIT_SELECT_GROUP "WHERE id = $1::text"};
constexpr Statement kHoldGroup = {
    "hold_group", REVISIT_SELECT_GROUP "WHERE id = $1::text FOR UPDATE"};
constexpr Statement kFindGroups = {
    "find_groups", REVISIT_SELECT_GROUP
    "WHERE id > $1::text AND id >= $2::text AND id < $3::text ORDER BY id "
    "LIMIT $4::int8"};
#undef REVISIT_SELECT_GROUP
constexpr Statement kAllVersions = {
    "group_versions",
    "SELECT id, uid, revision FROM vehicle_groups ORDER BY id"};
constexpr Statement kVersionsOf = {
    "group_versions_of",
    "SELECT id, uid, revision FROM vehicle_groups WHERE id = ANY($1::text[]) "
    "ORDER BY id"};

constexpr Statement kListMembers = {
    "list_members",
    "SELECT m.vehicle_key, v.id, m.format, m.checksum, m.payload FROM "
    "group_members m JOIN vehicles v ON v.key = m.vehicle_key WHERE m.group_id "
    "= $1::text AND v.id > $2::text ORDER BY v.id LIMIT $3::int8"};
constexpr Statement kGroupsOf = {
    "groups_of",
    "SELECT group_id FROM group_members WHERE vehicle_key = $1::int8 ORDER BY "
    "group_id"};

#define REVISIT_SELECT_LINK                                             \
  "SELECT group_id, id, format, state, query_vehicle, query_sequence, " \
  "matched_vehicle, matched_sequence, checksum, payload FROM group_links "
constexpr Statement kFindLink = {"find_link", REVISIT_SELECT_LINK
                                 "WHERE group_id = $1::text AND id = $2::text"};
constexpr Statement kListLinks = {
    "list_links", REVISIT_SELECT_LINK
    "WHERE group_id = $1::text AND id > $2::text ORDER BY id LIMIT $3::int8"};
// Each half goes along an index.
constexpr Statement kLinksOf = {
    "links_of",
    "(" REVISIT_SELECT_LINK
    "WHERE query_vehicle = $1::int8 AND (group_id, id) > ($2::text, $3::text) "
    "ORDER BY group_id, id LIMIT $4::int8) UNION ALL (" REVISIT_SELECT_LINK
    "WHERE matched_vehicle = $1::int8 AND query_vehicle <> $1::int8 AND "
    "(group_id, id) > ($2::text, $3::text) ORDER BY group_id, id "
    "LIMIT $4::int8) ORDER BY 1, 2 LIMIT $4::int8"};
#undef REVISIT_SELECT_LINK

GroupRecord GroupAt(const PostgresRows& rows, int row) {
  GroupRecord group;
  group.id = rows.Bytes(row, 0);
  group.version = {rows.Bytes(row, 3), Unsigned(rows.Integer(row, 2))};
  group.payload = rows.Bytes(row, 5);
  CheckGroupRow(rows.Integer(row, 1), rows.Integer(row, 4), &group);
  return group;
}

PlacedLink LinkAt(const PostgresRows& rows, int row) {
  PlacedLink placed;
  placed.group = rows.Bytes(row, 0);
  GroupLinkRecord& link = placed.link;
  link.id = rows.Bytes(row, 1);
  link.query = {rows.Integer(row, 4), Unsigned(rows.Integer(row, 5))};
  link.matched = {rows.Integer(row, 6), Unsigned(rows.Integer(row, 7))};
  link.payload = rows.Bytes(row, 9);
  CheckLinkRow(rows.Integer(row, 2), rows.Integer(row, 8), placed.group,
               rows.Integer(row, 3), &link);
  return placed;
}

Parameters& AddLimit(int limit, Parameters* parameters) {
  return parameters->Add(std::int64_t{std::max(limit, 0)});
}

absl::StatusOr<GroupRecord> ReadGroup(PostgresConnection& connection,
                                      const Statement& statement,
                                      const std::string& id) {
  const auto rows = connection.Run(statement, Parameters().AddText(id));
  if (!rows.ok()) return rows.status();
  if (rows->size() == 0) return NoSuchGroup(id);
  return GroupAt(*rows, 0);
}

}  // namespace

absl::StatusOr<bool> KeepsGroups(PostgresConnection& connection) {
  const auto rows = connection.Run(kKeepsGroups);
  if (!rows.ok()) return rows.status();
  return rows->Integer(0, 0) != 0;
}

absl::Status CheckKeepsGroups(PostgresConnection& connection) {
  const absl::StatusOr<bool> keeps = KeepsGroups(connection);
  if (!keeps.ok()) return keeps.status();
  if (*keeps) return absl::OkStatus();
  return Error(absl::StatusCode::kFailedPrecondition, "STORE_UNAVAILABLE",
               "the database's tables have no room for groups: run `revisitd "
               "migrate --store URL`");
}

absl::StatusOr<GroupRecord> HoldGroup(PostgresConnection& connection,
                                      const std::string& id) {
  return ReadGroup(connection, kHoldGroup, id);
}

absl::StatusOr<GroupLinkRecord> FindLink(PostgresConnection& connection,
                                         const std::string& group_id,
                                         const std::string& id) {
  const auto rows =
      connection.Run(kFindLink, Parameters().AddText(group_id).AddText(id));
  if (!rows.ok()) return rows.status();
  if (rows->size() == 0) return NoSuchLink(id);
  return LinkAt(*rows, 0).link;
}

absl::StatusOr<GroupRecord> FindGroup(PostgresConnection& connection,
                                      const std::string& id) {
  const absl::StatusOr<bool> keeps = KeepsGroups(connection);
  if (!keeps.ok()) return keeps.status();
  if (!*keeps) return NoSuchGroup(id);
  return ReadGroup(connection, kFindGroup, id);
}

absl::StatusOr<std::vector<GroupRecord>> FindGroups(
    PostgresConnection& connection, const std::string& after_id,
    const std::string& prefix, int limit) {
  std::vector<GroupRecord> groups;
  const absl::StatusOr<bool> keeps = KeepsGroups(connection);
  if (!keeps.ok()) return keeps.status();
  if (!*keeps) return groups;
  Parameters parameters;
  parameters.AddText(after_id).AddText(prefix).AddText(BeyondPrefix(prefix));
  const auto rows = connection.Run(kFindGroups, AddLimit(limit, &parameters));
  if (!rows.ok()) return rows.status();
  for (int i = 0; i < rows->size(); ++i) groups.push_back(GroupAt(*rows, i));
  return groups;
}

absl::StatusOr<std::vector<GroupRecord>> FindGroupVersions(
    PostgresConnection& connection,
    const std::optional<std::vector<std::string>>& ids) {
  std::vector<GroupRecord> groups;
  const absl::StatusOr<bool> keeps = KeepsGroups(connection);
  if (!keeps.ok()) return keeps.status();
  if (!*keeps) return groups;
  Parameters parameters;
  if (ids) {
    std::vector<const std::string*> texts;
    for (const std::string& id : *ids) texts.push_back(&id);
    parameters.AddTexts(texts);
  }
  const auto rows =
      connection.Run(ids ? kVersionsOf : kAllVersions, parameters);
  if (!rows.ok()) return rows.status();
  for (int i = 0; i < rows->size(); ++i) {
    GroupRecord& group = groups.emplace_back();
    group.id = rows->Bytes(i, 0);
    group.version = {rows->Bytes(i, 1), Unsigned(rows->Integer(i, 2))};
  }
  return groups;
}

absl::StatusOr<std::vector<GroupMemberRecord>> FindMembers(
    PostgresConnection& connection, const std::string& group_id,
    const std::string& after_vehicle_id, int limit) {
  const absl::Status group = FindGroup(connection, group_id).status();
  if (!group.ok()) return group;
  Parameters parameters;
  parameters.AddText(group_id).AddText(after_vehicle_id);
  const auto rows = connection.Run(kListMembers, AddLimit(limit, &parameters));
  if (!rows.ok()) return rows.status();
  std::vector<GroupMemberRecord> members;
  for (int i = 0; i < rows->size(); ++i) {
    GroupMemberRecord& member = members.emplace_back();
    member.vehicle = rows->Integer(i, 0);
    member.vehicle_id = rows->Bytes(i, 1);
    member.payload = rows->Bytes(i, 4);
    CheckMemberRow(rows->Integer(i, 2), rows->Integer(i, 3), group_id, &member);
  }
  return members;
}

absl::StatusOr<std::vector<std::string>> FindGroupsOf(
    PostgresConnection& connection, VehicleKey vehicle) {
  std::vector<std::string> ids;
  const absl::Status is_vehicle = VehicleId(connection, vehicle).status();
  if (!is_vehicle.ok()) return is_vehicle;
  const absl::StatusOr<bool> keeps = KeepsGroups(connection);
  if (!keeps.ok()) return keeps.status();
  if (!*keeps) return ids;
  const auto rows = connection.Run(kGroupsOf, Parameters().Add(vehicle));
  if (!rows.ok()) return rows.status();
  for (int i = 0; i < rows->size(); ++i) ids.push_back(rows->Bytes(i, 0));
  return ids;
}

absl::StatusOr<std::vector<GroupLinkRecord>> FindLinks(
    PostgresConnection& connection, const std::string& group_id,
    const std::string& after_id, int limit) {
  const absl::Status group = FindGroup(connection, group_id).status();
  if (!group.ok()) return group;
  Parameters parameters;
  parameters.AddText(group_id).AddText(after_id);
  const auto rows = connection.Run(kListLinks, AddLimit(limit, &parameters));
  if (!rows.ok()) return rows.status();
  std::vector<GroupLinkRecord> links;
  for (int i = 0; i < rows->size(); ++i) {
    links.push_back(LinkAt(*rows, i).link);
  }
  return links;
}

absl::StatusOr<std::vector<PlacedLink>> FindLinksOf(
    PostgresConnection& connection, VehicleKey vehicle, const LinkPlace& after,
    int limit) {
  std::vector<PlacedLink> links;
  const absl::Status is_vehicle = VehicleId(connection, vehicle).status();
  if (!is_vehicle.ok()) return is_vehicle;
  const absl::StatusOr<bool> keeps = KeepsGroups(connection);
  if (!keeps.ok()) return keeps.status();
  if (!*keeps) return links;
  Parameters parameters;
  parameters.Add(vehicle).AddText(after.group).AddText(after.id);
  const auto rows = connection.Run(kLinksOf, AddLimit(limit, &parameters));
  if (!rows.ok()) return rows.status();
  for (int i = 0; i < rows->size(); ++i) links.push_back(LinkAt(*rows, i));
  return links;
}

}  // namespace revisit::server
