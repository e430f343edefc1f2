#include "server/storage/postgres/postgres_check.h"

#include <memory>

#include "server/storage/postgres/connection.h"
#include "server/storage/postgres/postgres_group_reads.h"
#include "server/storage/postgres/postgres_reader.h"
#include "server/storage/storage.h"

namespace revisit::server {
namespace {

constexpr Statement kVehicleIds = {
    "vehicle_ids",
    "SELECT id, key FROM vehicles WHERE id > $1::text ORDER BY id LIMIT 1000"};

constexpr Statement kRevisedCount = {"revised_count",
                                     "SELECT count(*) FROM revised_batches"};

struct LeftOver {
  Statement count;
  const char* what;
};

constexpr LeftOver kLeftOvers[] = {
    {{"batches_left_over",
      "SELECT count(*) FROM batches b WHERE NOT EXISTS (SELECT 1 FROM vehicles "
      "v WHERE v.key = b.vehicle_key) AND NOT EXISTS (SELECT 1 FROM "
      "deleted_vehicles d WHERE d.key = b.vehicle_key)"},
     "batches belong to no vehicle"},
    {{"revisions_left_over",
      "SELECT count(*) FROM revised_batches r WHERE NOT EXISTS (SELECT 1 FROM "
      "batches b WHERE b.vehicle_key = r.vehicle_key AND b.first_sequence = "
      "r.first_sequence) AND NOT EXISTS (SELECT 1 FROM deleted_vehicles d "
      "WHERE d.key = r.vehicle_key)"},
     "revisions belong to no batch"},
    {{"pairs_left_over",
      "SELECT (SELECT count(*) FROM loop_closures p WHERE NOT EXISTS (SELECT 1 "
      "FROM vehicles v WHERE v.key = p.vehicle_key)) + (SELECT count(*) FROM "
      "rejected_candidates p WHERE NOT EXISTS (SELECT 1 FROM vehicles v WHERE "
      "v.key = p.vehicle_key))"},
     "loop closures or rejected candidates belong to no vehicle"},
    {{"heads_left_over",
      "SELECT count(*) FROM heads h WHERE NOT EXISTS (SELECT 1 FROM vehicles v "
      "WHERE v.key = h.key)"},
     "heads belong to no vehicle"},
    {{"deleted_left_over",
      "SELECT count(*) FROM deleted_vehicles d WHERE EXISTS (SELECT 1 FROM "
      "vehicles v WHERE v.key = d.key)"},
     "vehicles are there although they were deleted"},
    {{"snapshots_left_over",
      "SELECT (SELECT count(*) FROM snapshots s WHERE NOT EXISTS (SELECT 1 "
      "FROM "
      "vehicles v WHERE v.key = s.vehicle_key)) + (SELECT count(*) FROM "
      "snapshot_parts p WHERE NOT EXISTS (SELECT 1 FROM snapshots s WHERE "
      "s.key "
      "= p.snapshot_key) AND NOT EXISTS (SELECT 1 FROM deleted_snapshots d "
      "WHERE d.key = p.snapshot_key))"},
     "snapshots or parts of snapshots belong to no vehicle"},
    {{"checks_left_over",
      "SELECT count(*) FROM checks c WHERE NOT EXISTS (SELECT 1 FROM vehicles "
      "v WHERE v.key = c.vehicle_key)"},
     "checks belong to no vehicle"},
    {{"events_beyond",
      "SELECT count(*) FROM events e JOIN heads h ON h.key = e.vehicle_key "
      "WHERE e.number > h.last_event"},
     "events are beyond the last one that their vehicle's head tells of"},
};

// These need tables that have room for groups.
constexpr LeftOver kMembersLeftOver = {
    {"members_left_over",
     "SELECT count(*) FROM group_members m WHERE NOT EXISTS (SELECT 1 FROM "
     "vehicle_groups g WHERE g.id = m.group_id) OR NOT EXISTS (SELECT 1 FROM "
     "vehicles v WHERE v.key = m.vehicle_key)"},
    "members belong to no group or are no vehicle"};
constexpr LeftOver kLinksLeftOver = {
    {"links_left_over",
     "SELECT count(*) FROM group_links l WHERE NOT EXISTS (SELECT 1 FROM "
     "group_members m WHERE m.group_id = l.group_id AND m.vehicle_key = "
     "l.query_vehicle) OR NOT EXISTS (SELECT 1 FROM group_members m WHERE "
     "m.group_id = l.group_id AND m.vehicle_key = l.matched_vehicle)"},
    "loop closures of groups name vehicles that are no members"};

absl::Status CountLeftOver(PostgresConnection& connection,
                           const LeftOver& left_over, StoreReport* report) {
  const auto count = connection.Run(left_over.count);
  if (!count.ok()) return count.status();
  if (count->Integer(0, 0) > 0) {
    report->problems.push_back(std::to_string(count->Integer(0, 0)) + " " +
                               left_over.what);
  }
  return absl::OkStatus();
}

}  // namespace

absl::StatusOr<StoreReport> CheckDatabase(const std::string& conninfo) {
  const auto storage = OpenPostgresStorageToRead(conninfo);
  if (!storage.ok()) return storage.status();
  PostgresConnection::Options options;
  options.conninfo = conninfo;
  const auto connection = PostgresConnection::Open(options);
  if (!connection.ok()) return connection.status();
  StoreReport report;
  std::string after;
  while (true) {
    const auto ids =
        (*connection)->Run(kVehicleIds, Parameters().AddText(after));
    if (!ids.ok()) return ids.status();
    if (ids->size() == 0) break;
    for (int i = 0; i < ids->size(); ++i) {
      after = ids->Bytes(i, 0);
      // A vehicle that is not found was deleted since it was listed; one that
      // is damaged is in the report. A database that went away says nothing of
      // either.
      absl::Status status = ReportVehicle(**storage, after, &report);
      if (absl::IsUnavailable(status)) return status;
      status = ReportSnapshot(**storage, ids->Integer(i, 1), after, &report);
      if (absl::IsUnavailable(status)) return status;
    }
  }
  for (const LeftOver& left_over : kLeftOvers) {
    absl::Status status = CountLeftOver(**connection, left_over, &report);
    if (!status.ok()) return status;
  }
  const absl::Status groups = ReportGroups(**storage, &report);
  if (!groups.ok()) return groups;
  const absl::StatusOr<bool> keeps = KeepsGroups(**connection);
  if (!keeps.ok()) return keeps.status();
  for (const LeftOver& left_over : {kMembersLeftOver, kLinksLeftOver}) {
    if (!*keeps) break;
    absl::Status status = CountLeftOver(**connection, left_over, &report);
    if (!status.ok()) return status;
  }
  const auto revised = (*connection)->Run(kRevisedCount);
  if (!revised.ok()) return revised.status();
  report.revised_batches = revised->Integer(0, 0);
  return report;
}

}  // namespace revisit::server
