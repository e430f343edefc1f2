#include "server/storage/sqlite/link_rows.h"

#include <algorithm>
#include <optional>
#include <utility>

#include "server/storage/group_check.h"
#include "server/storage/record_check.h"
#include "server/storage/record_checksum.h"
#include "server/storage/sqlite/member_rows.h"
#include "server/storage/sqlite/vehicle_rows.h"

namespace revisit::server {
namespace {

#define REVISIT_LINK_COLUMNS                                     \
  "group_id, id, format, state, query_vehicle, query_sequence, " \
  "matched_vehicle, matched_sequence, checksum, payload"

// The columns are those above.
PlacedLink ReadLinkRow(const SqliteStatement& row) {
  PlacedLink placed;
  placed.group = row.Bytes(0);
  GroupLinkRecord& link = placed.link;
  link.id = row.Bytes(1);
  link.query = {row.Integer(4), Unsigned(row.Integer(5))};
  link.matched = {row.Integer(6), Unsigned(row.Integer(7))};
  link.payload = row.Bytes(9);
  CheckLinkRow(row.Integer(2), row.Integer(8), placed.group, row.Integer(3),
               &link);
  return placed;
}

absl::StatusOr<std::optional<GroupLinkRecord>> FindLink(
    SqliteDatabase& database, const std::string& group_id,
    const std::string& id) {
  SqliteStatement row =
      database.Prepare("SELECT " REVISIT_LINK_COLUMNS
                       " FROM group_links WHERE group_id = ?1 AND id = ?2");
  const absl::StatusOr<bool> found =
      row.BindText(1, group_id).BindText(2, id).Step();
  if (!found.ok()) return found.status();
  std::optional<GroupLinkRecord> link;
  if (*found) link = ReadLinkRow(row).link;
  return link;
}

absl::Status WriteLink(SqliteDatabase& database, const std::string& group_id,
                       const GroupLinkRecord& link) {
  return database
      .Prepare("INSERT OR REPLACE INTO group_links (" REVISIT_LINK_COLUMNS
               ") VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7, ?8, ?9, ?10)")
      .BindText(1, group_id)
      .BindText(2, link.id)
      .Bind(3, kStoreFormat)
      .Bind(4, NumberOf(link.state))
      .Bind(5, link.query.vehicle)
      .Bind(6, Signed(link.query.sequence))
      .Bind(7, link.matched.vehicle)
      .Bind(8, Signed(link.matched.sequence))
      .Bind(9, ChecksumOfLink(kStoreFormat, group_id, link))
      .BindBlob(10, link.payload)
      .Run();
}

}  // namespace

absl::Status InsertLink(SqliteDatabase& database, const std::string& group_id,
                        const GroupLinkRecord& link) {
  for (const VehiclePose& end : {link.query, link.matched}) {
    const absl::Status status = CheckIsMember(database, group_id, end.vehicle);
    if (!status.ok()) return status;
  }
  const auto before = FindLink(database, group_id, link.id);
  if (!before.ok()) return before.status();
  if (before->has_value()) return LinkExists(link.id);
  return WriteLink(database, group_id, link);
}

absl::Status ReplaceLink(SqliteDatabase& database, const std::string& group_id,
                         const SetGroupLink& change) {
  auto link = FindLink(database, group_id, change.id);
  if (!link.ok()) return link.status();
  if (!link->has_value()) return NoSuchLink(change.id);
  // A damaged row that is written again would pass for sound.
  if (!(*link)->damage.ok()) return (*link)->damage;
  (*link)->state = change.state;
  (*link)->payload = change.payload;
  return WriteLink(database, group_id, **link);
}

absl::Status RemoveLink(SqliteDatabase& database, const std::string& group_id,
                        const std::string& id) {
  const absl::Status status =
      database
          .Prepare("DELETE FROM group_links WHERE group_id = ?1 AND id = ?2")
          .BindText(1, group_id)
          .BindText(2, id)
          .Run();
  if (!status.ok() || database.Changes() > 0) return status;
  return NoSuchLink(id);
}

absl::Status RemoveLinksOf(SqliteDatabase& database,
                           const std::string& group_id, VehicleKey vehicle) {
  return database
      .Prepare(
          "DELETE FROM group_links WHERE group_id = ?1 AND (query_vehicle = ?2 "
          "OR matched_vehicle = ?2)")
      .BindText(1, group_id)
      .Bind(2, vehicle)
      .Run();
}

absl::Status RemoveAllLinks(SqliteDatabase& database,
                            const std::string& group_id) {
  return database.Prepare("DELETE FROM group_links WHERE group_id = ?1")
      .BindText(1, group_id)
      .Run();
}

absl::StatusOr<std::vector<std::string>> RemoveLinksAfter(
    SqliteDatabase& database, VehicleKey vehicle, std::uint64_t last_sequence) {
#define REVISIT_LINKS_AFTER                            \
  "FROM group_links WHERE (query_vehicle = ?1 AND "    \
  "query_sequence > ?2) OR (matched_vehicle = ?1 AND " \
  "matched_sequence > ?2)"
  std::vector<std::string> groups;
  {
    SqliteStatement row =
        database.Prepare("SELECT DISTINCT group_id " REVISIT_LINKS_AFTER);
    row.Bind(1, vehicle).Bind(2, Signed(last_sequence));
    while (true) {
      const absl::StatusOr<bool> found = row.Step();
      if (!found.ok()) return found.status();
      if (!*found) break;
      groups.push_back(row.Bytes(0));
    }
  }
  const absl::Status status = database.Prepare("DELETE " REVISIT_LINKS_AFTER)
                                  .Bind(1, vehicle)
                                  .Bind(2, Signed(last_sequence))
                                  .Run();
#undef REVISIT_LINKS_AFTER
  if (!status.ok()) return status;
  return groups;
}

absl::StatusOr<std::vector<GroupLinkRecord>> FindLinks(
    SqliteDatabase& database, const std::string& group_id,
    const std::string& after_id, int limit) {
  std::vector<GroupLinkRecord> links;
  SqliteStatement row = database.Prepare(
      "SELECT " REVISIT_LINK_COLUMNS
      " FROM group_links WHERE group_id = ?1 AND id > ?2 ORDER BY id LIMIT ?3");
  row.BindText(1, group_id).BindText(2, after_id).Bind(3, std::max(limit, 0));
  while (true) {
    const absl::StatusOr<bool> found = row.Step();
    if (!found.ok()) return found.status();
    if (!*found) return links;
    links.push_back(ReadLinkRow(row).link);
  }
}

absl::StatusOr<std::vector<PlacedLink>> FindLinksOf(SqliteDatabase& database,
                                                    VehicleKey vehicle,
                                                    const LinkPlace& after,
                                                    int limit) {
  std::vector<PlacedLink> links;
  const absl::Status is_there = VehicleId(database, vehicle).status();
  if (!is_there.ok()) return is_there;
  // Each half goes along an index.
  SqliteStatement row = database.Prepare(
      "SELECT " REVISIT_LINK_COLUMNS
      " FROM group_links WHERE query_vehicle = ?1 AND (group_id, id) > (?2, "
      "?3) UNION ALL SELECT " REVISIT_LINK_COLUMNS
      " FROM group_links WHERE matched_vehicle = ?1 AND query_vehicle <> ?1 "
      "AND (group_id, id) > (?2, ?3) ORDER BY 1, 2 LIMIT ?4");
  row.Bind(1, vehicle).BindText(2, after.group).BindText(3, after.id);
  row.Bind(4, std::max(limit, 0));
  while (true) {
    const absl::StatusOr<bool> found = row.Step();
    if (!found.ok()) return found.status();
    if (!*found) return links;
    links.push_back(ReadLinkRow(row));
  }
}

#undef REVISIT_LINK_COLUMNS

}  // namespace revisit::server
