#include "server/storage/store_report.h"

#include <optional>

#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "server/storage/record_check.h"
#include "server/storage/storage.h"

namespace revisit::server {
namespace {

// Pairs of poses, and checks, that are read at a time.
constexpr int kPairsPerRead = 1000;
constexpr int kChecksPerRead = 200;
// Groups, members or links.
constexpr int kOfGroupsPerRead = 500;

absl::Status CountVehicle(Storage& storage, const std::string& id,
                          StoreReport* counts) {
  const absl::StatusOr<VehicleRecord> record = storage.GetVehicle(id);
  if (!record.ok()) return record.status();
  if (!record->damage.ok()) return record->damage;
  for (const BatchVersion version :
       {BatchVersion::kAsSent, BatchVersion::kCurrent}) {
    const absl::Status read =
        storage.ReadBatches(record->key, 1, record->durable_sequence, version,
                            [&](const BatchRecord& batch) {
                              if (version == BatchVersion::kAsSent) {
                                ++counts->batches;
                                counts->poses += batch.count;
                              }
                              return true;
                            });
    if (!read.ok()) return read;
  }
  for (const PairKind kind : kPairKinds) {
    std::int64_t& count = kind == PairKind::kLoopClosure
                              ? counts->loop_closures
                              : counts->rejected_candidates;
    const absl::Status read =
        VisitPosePairs(storage, record->key, kind, [&](const PosePairRecord&) {
          ++count;
          return absl::OkStatus();
        });
    if (!read.ok()) return read;
  }
  const absl::Status read =
      VisitDeletedPairs(storage, record->key, [&](const DeletedPairRecord&) {
        ++counts->deleted_pairs;
        return absl::OkStatus();
      });
  if (!read.ok()) return read;
  return VisitChecks(
      storage, record->key, [&](const std::vector<CheckRecord>& checks) {
        counts->checks += static_cast<std::int64_t>(checks.size());
        return absl::OkStatus();
      });
}

// Whether the snapshot is the one that was read before.
bool IsSame(Storage& storage, VehicleKey key,
            const absl::StatusOr<std::optional<SnapshotRecord>>& before) {
  const auto now = storage.GetSnapshot(key);
  if (!now.ok() || !before.ok()) return now.status() == before.status();
  return now->has_value() == before->has_value() &&
         (!*now || (*now)->last_sequence == (*before)->last_sequence);
}

// Visits the records of all pages, damaged ones too, until `visit` refuses.
// `read` answers the page behind an id, which is the records' member `id`.
template <typename Record>
absl::Status VisitPages(
    const std::function<
        absl::StatusOr<std::vector<Record>>(const std::string& after)>& read,
    std::string Record::*id,
    const std::function<absl::Status(const Record&)>& visit) {
  std::string after;
  while (true) {
    const absl::StatusOr<std::vector<Record>> page = read(after);
    if (!page.ok()) return page.status();
    if (page->empty()) return absl::OkStatus();
    for (const Record& record : *page) {
      if (absl::Status status = visit(record); !status.ok()) return status;
    }
    after = page->back().*id;
  }
}

using VisitGroup = std::function<absl::Status(const GroupRecord&)>;
using VisitMember = std::function<absl::Status(const GroupMemberRecord&)>;
using VisitLink = std::function<absl::Status(const GroupLinkRecord&)>;

absl::Status VisitAllGroups(Storage& storage, const VisitGroup& visit) {
  return VisitPages<GroupRecord>(
      [&](const std::string& after) {
        return storage.Groups().ListGroups(after, "", kOfGroupsPerRead);
      },
      &GroupRecord::id, visit);
}

absl::Status VisitAllMembers(Storage& storage, const std::string& group_id,
                             const VisitMember& visit) {
  return VisitPages<GroupMemberRecord>(
      [&](const std::string& after) {
        return storage.Groups().ListMembers(group_id, after, kOfGroupsPerRead);
      },
      &GroupMemberRecord::vehicle_id, visit);
}

absl::Status VisitAllLinks(Storage& storage, const std::string& group_id,
                           const VisitLink& visit) {
  return VisitPages<GroupLinkRecord>(
      [&](const std::string& after) {
        return storage.Groups().ListLinks(group_id, after, kOfGroupsPerRead);
      },
      &GroupLinkRecord::id, visit);
}

// Returns a visit of sound records only, which fails with the damage of others.
// `visit` outlives it.
template <typename Record>
std::function<absl::Status(const Record&)> OnlySound(
    const std::function<absl::Status(const Record&)>& visit) {
  return [&visit](const Record& record) {
    return record.damage.ok() ? visit(record) : record.damage;
  };
}

// Returns a visit that counts records, and notes the damage of each.
template <typename Record>
std::function<absl::Status(const Record&)> Counted(std::int64_t* count,
                                                   StoreReport* report) {
  return [count, report](const Record& record) {
    ++*count;
    if (!record.damage.ok()) {
      report->problems.emplace_back(record.damage.message());
    }
    return absl::OkStatus();
  };
}

}  // namespace

bool HoldTheSame(const StoreReport& a, const StoreReport& b) {
  return a.vehicles == b.vehicles && a.batches == b.batches &&
         a.poses == b.poses && a.revised_batches == b.revised_batches &&
         a.loop_closures == b.loop_closures &&
         a.rejected_candidates == b.rejected_candidates &&
         a.deleted_pairs == b.deleted_pairs && a.checks == b.checks &&
         a.groups == b.groups && a.members == b.members && a.links == b.links;
}

absl::Status VisitPosePairs(
    Storage& storage, VehicleKey key, PairKind kind,
    const std::function<absl::Status(const PosePairRecord&)>& visit) {
  std::string after;
  while (true) {
    const absl::StatusOr<std::vector<PosePairRecord>> page =
        storage.ListPosePairs(key, kind, after, kPairsPerRead);
    if (!page.ok()) return page.status();
    if (page->empty()) return absl::OkStatus();
    for (const PosePairRecord& pair : *page) {
      if (!pair.damage.ok()) return pair.damage;
      if (absl::Status status = visit(pair); !status.ok()) return status;
    }
    after = page->back().id;
  }
}

absl::Status VisitDeletedPairs(
    Storage& storage, VehicleKey key,
    const std::function<absl::Status(const DeletedPairRecord&)>& visit) {
  const auto all = storage.ListDeletedPairs(key);
  if (!all.ok()) return all.status();
  for (const DeletedPairRecord& deleted : *all) {
    if (!deleted.pair.damage.ok()) return deleted.pair.damage;
    if (absl::Status status = visit(deleted); !status.ok()) return status;
  }
  return absl::OkStatus();
}

absl::Status VisitChecks(
    Storage& storage, VehicleKey key,
    const std::function<absl::Status(const std::vector<CheckRecord>&)>& visit) {
  std::uint64_t first = 1;
  while (true) {
    const absl::StatusOr<std::vector<CheckRecord>> page = storage.ListChecks(
        key, first, kLastSequence, /*open_only=*/false, kChecksPerRead);
    if (!page.ok()) return page.status();
    if (page->empty()) return absl::OkStatus();
    for (const CheckRecord& check : *page) {
      if (!check.damage.ok()) return check.damage;
    }
    if (absl::Status status = visit(*page); !status.ok()) return status;
    first = page->back().sequence + 1;
  }
}

absl::Status VisitGroups(Storage& storage, const VisitGroup& visit) {
  return VisitAllGroups(storage, OnlySound(visit));
}

absl::Status VisitMembers(Storage& storage, const std::string& group_id,
                          const VisitMember& visit) {
  return VisitAllMembers(storage, group_id, OnlySound(visit));
}

absl::Status VisitLinks(Storage& storage, const std::string& group_id,
                        const VisitLink& visit) {
  return VisitAllLinks(storage, group_id, OnlySound(visit));
}

absl::Status ReportGroups(Storage& storage, StoreReport* report) {
  const auto count_group = Counted<GroupRecord>(&report->groups, report);
  return VisitAllGroups(storage, [&](const GroupRecord& group) {
    absl::Status status = count_group(group);
    if (status.ok()) {
      status =
          VisitAllMembers(storage, group.id,
                          Counted<GroupMemberRecord>(&report->members, report));
    }
    if (status.ok()) {
      status = VisitAllLinks(storage, group.id,
                             Counted<GroupLinkRecord>(&report->links, report));
    }
    // A group may be deleted since it was listed.
    return absl::IsNotFound(status) ? absl::OkStatus() : status;
  });
}

absl::Status ReportVehicle(Storage& storage, const std::string& id,
                           StoreReport* report) {
  StoreReport counts;
  absl::Status status = CountVehicle(storage, id, &counts);
  if (absl::IsNotFound(status)) return status;
  ++report->vehicles;
  report->batches += counts.batches;
  report->poses += counts.poses;
  report->loop_closures += counts.loop_closures;
  report->rejected_candidates += counts.rejected_candidates;
  report->deleted_pairs += counts.deleted_pairs;
  report->checks += counts.checks;
  if (!status.ok()) {
    report->problems.push_back("vehicle '" + Printable(id) +
                               "': " + std::string(status.message()));
    report->damaged_vehicles.insert(Printable(id));
  }
  return status;
}

absl::Status ReportSnapshot(Storage& storage, VehicleKey key,
                            const std::string& id, StoreReport* report) {
  const auto snapshot = storage.GetSnapshot(key);
  absl::Status status = snapshot.status();
  if (status.ok() && *snapshot) {
    ++report->snapshots;
    status = storage.ReadSnapshotParts(key, 0, (*snapshot)->part_count,
                                       [](absl::string_view) { return true; });
  }
  if (status.ok()) status = storage.GetMarks(key).status();
  if (status.ok() || !IsSame(storage, key, snapshot)) return absl::OkStatus();
  report->damaged_snapshots.push_back("vehicle '" + Printable(id) +
                                      "': " + std::string(status.message()));
  return status;
}

}  // namespace revisit::server
