// The findings in a store that was read whole.
#ifndef REVISIT_SERVER_STORAGE_STORE_REPORT_H_
#define REVISIT_SERVER_STORAGE_STORE_REPORT_H_

#include <cstdint>
#include <functional>
#include <set>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "server/storage/group_records.h"
#include "server/storage/records.h"

namespace revisit::server {

class Storage;

struct StoreReport {
  std::int64_t vehicles = 0;
  std::int64_t batches = 0;
  std::int64_t poses = 0;
  std::int64_t revised_batches = 0;
  std::int64_t loop_closures = 0;
  std::int64_t rejected_candidates = 0;
  std::int64_t deleted_pairs = 0;
  std::int64_t checks = 0;
  std::int64_t snapshots = 0;
  std::int64_t groups = 0;
  std::int64_t members = 0;
  // Loop closures between members of groups.
  std::int64_t links = 0;
  // Problems for people to read, each in one line.
  std::vector<std::string> problems;
  // Ids of vehicles that cannot be read whole, or that have changes in the
  // damaged part of a log, as far as they are known.
  std::set<std::string> damaged_vehicles;
  // Snapshots that are damaged, each in one line: nothing is lost with them,
  // since they are made again.
  std::vector<std::string> damaged_snapshots;
};

// Whether both count the same.
bool HoldTheSame(const StoreReport& a, const StoreReport& b);

// Visits all pairs of a kind, by id, until `visit` refuses; returns its own
// failure or that of `visit`. DATA_LOSS (STORE_CORRUPT) for a damaged pair.
absl::Status VisitPosePairs(
    Storage& storage, VehicleKey key, PairKind kind,
    const std::function<absl::Status(const PosePairRecord&)>& visit);
// The same of the pairs that were deleted, the last one first.
absl::Status VisitDeletedPairs(
    Storage& storage, VehicleKey key,
    const std::function<absl::Status(const DeletedPairRecord&)>& visit);
// The same of the checks, by sequence, some at a time.
absl::Status VisitChecks(
    Storage& storage, VehicleKey key,
    const std::function<absl::Status(const std::vector<CheckRecord>&)>& visit);

// The same of groups, by id; of the members of a group, by vehicle; and of its
// links, by id.
absl::Status VisitGroups(
    Storage& storage,
    const std::function<absl::Status(const GroupRecord&)>& visit);
absl::Status VisitMembers(
    Storage& storage, const std::string& group_id,
    const std::function<absl::Status(const GroupMemberRecord&)>& visit);
absl::Status VisitLinks(
    Storage& storage, const std::string& group_id,
    const std::function<absl::Status(const GroupLinkRecord&)>& visit);

// Reads all of a vehicle, both versions of its batches, and adds what there is
// to the report's counts, or, if it cannot be read, to its problems. A vehicle
// that does not exist is NOT_FOUND and leaves the report alone.
absl::Status ReportVehicle(Storage& storage, const std::string& id,
                           StoreReport* report);

// Reads all groups with their members and links, and adds them to the report's
// counts, and each that is damaged to its problems. Fails where the storage
// cannot be read.
absl::Status ReportGroups(Storage& storage, StoreReport* report);

// Reads a vehicle's snapshot whole, and its marks, and adds it to the report's
// counts, or to its damaged ones. A server may replace or remove it meanwhile.
// Answers why it is damaged; OK if it is not.
absl::Status ReportSnapshot(Storage& storage, VehicleKey key,
                            const std::string& id, StoreReport* report);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_STORE_REPORT_H_
