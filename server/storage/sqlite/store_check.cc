#include "server/storage/sqlite/store_check.h"

#include <sys/stat.h>

#include <cstdint>
#include <filesystem>
#include <memory>
#include <system_error>
#include <utility>

#include "server/storage/record_check.h"
#include "server/storage/sqlite/sqlite_reader.h"
#include "server/storage/sqlite/store_files.h"
#include "server/storage/sqlite/store_lock.h"
#include "server/storage/sqlite/store_reading.h"
#include "server/storage/sqlite/write_ahead_log.h"
#include "server/storage/storage.h"

namespace revisit::server {
namespace {

// A text of the database's size and times, which changes when anybody writes to
// it.
std::string LooksOf(const std::string& path) {
  struct stat status;
  if (stat(path.c_str(), &status) != 0) return "";
  return std::to_string(status.st_ino) + " " + std::to_string(status.st_size) +
         " " + std::to_string(status.st_mtim.tv_sec) + " " +
         std::to_string(status.st_mtim.tv_nsec);
}

class Checker {
 public:
  Checker(std::string path, StoreUse use, SqliteDatabase* database,
          Storage* storage)
      : path_(std::move(path)),
        use_(use),
        database_(database),
        storage_(storage) {}

  StoreReport Check() {
    const absl::StatusOr<std::vector<std::string>> structure =
        FindStructuralDamage(*database_, use_, path_);
    if (!structure.ok()) {
      Note(structure.status());
    } else {
      for (const std::string& problem : *structure) Note(problem);
    }
    for (const auto& [key, id] : Vehicles()) CheckVehicle(key, id);
    const absl::Status groups = ReportGroups(*storage_, &report_);
    if (!groups.ok()) Note(groups);
    CheckNoneIsLeftOver();
    return std::move(report_);
  }

 private:
  void Note(const std::string& problem) { report_.problems.push_back(problem); }
  void Note(const absl::Status& status) { Note(std::string(status.message())); }

  std::vector<std::pair<VehicleKey, std::string>> Vehicles() {
    std::vector<std::pair<VehicleKey, std::string>> vehicles;
    // Reads the table itself, because a damaged index may hide rows.
    SqliteStatement row =
        database_->Prepare("SELECT key, id FROM vehicles NOT INDEXED");
    while (true) {
      const absl::StatusOr<bool> found = row.Step();
      if (!found.ok()) Note(found.status());
      if (!found.ok() || !*found) return vehicles;
      vehicles.emplace_back(row.Integer(0), row.Bytes(1));
    }
  }

  // Whether a vehicle that was listed is not in the table any more.
  bool IsDeleted(VehicleKey key) {
    SqliteStatement row =
        database_->Prepare("SELECT 1 FROM vehicles NOT INDEXED WHERE key = ?1");
    const absl::StatusOr<bool> found = row.Bind(1, key).Step();
    return found.ok() && !*found;
  }

  void CheckVehicle(VehicleKey key, const std::string& id) {
    const absl::Status status = ReportVehicle(*storage_, id, &report_);
    if (!absl::IsNotFound(status)) {
      ReportSnapshot(*storage_, key, id, &report_).IgnoreError();
      return;
    }
    // The server may have deleted the vehicle since it was listed.
    if (use_ == StoreUse::kServed && IsDeleted(key)) return;
    ++report_.vehicles;
    Note("vehicle '" + Printable(id) + "': " + std::string(status.message()));
    report_.damaged_vehicles.insert(Printable(id));
  }

  void CheckNoneIsLeftOver() {
    struct Query {
      const char* sql;
      const char* what;
    };
    for (const Query& query : {
             Query{"SELECT count(*) FROM batches WHERE vehicle_key NOT IN "
                   "(SELECT key FROM vehicles UNION ALL SELECT key FROM "
                   "deleted_vehicles)",
                   "batches belong to no vehicle"},
             Query{"SELECT count(*) FROM revised_batches AS r WHERE NOT EXISTS "
                   "(SELECT 1 FROM batches AS b WHERE b.vehicle_key = "
                   "r.vehicle_key AND b.first_sequence = r.first_sequence) AND "
                   "vehicle_key NOT IN (SELECT key FROM deleted_vehicles)",
                   "revisions belong to no batch"},
             Query{"SELECT (SELECT count(*) FROM loop_closures WHERE "
                   "vehicle_key NOT IN (SELECT key FROM vehicles)) + (SELECT "
                   "count(*) FROM rejected_candidates WHERE vehicle_key NOT IN "
                   "(SELECT key FROM vehicles))",
                   "loop closures or rejected candidates belong to no vehicle"},
             Query{"SELECT count(*) FROM deleted_pose_pairs WHERE vehicle_key "
                   "NOT IN (SELECT key FROM vehicles)",
                   "deletions belong to no vehicle"},
             Query{"SELECT (SELECT count(*) FROM snapshots WHERE vehicle_key "
                   "NOT IN (SELECT key FROM vehicles)) + (SELECT count(*) FROM "
                   "snapshot_parts WHERE snapshot_key NOT IN (SELECT key FROM "
                   "snapshots UNION ALL SELECT key FROM deleted_snapshots))",
                   "snapshots or parts of snapshots belong to no vehicle"},
             Query{"SELECT (SELECT count(*) FROM check_heads WHERE vehicle_key "
                   "NOT IN (SELECT key FROM vehicles)) + (SELECT count(*) FROM "
                   "checks WHERE vehicle_key NOT IN (SELECT key FROM "
                   "vehicles))",
                   "checks or heads of checks belong to no vehicle"},
             Query{"SELECT count(*) FROM group_members WHERE group_id NOT IN "
                   "(SELECT id FROM vehicle_groups) OR vehicle_key NOT IN "
                   "(SELECT key FROM vehicles)",
                   "members belong to no group or are no vehicle"},
             Query{"SELECT count(*) FROM group_links AS l WHERE NOT EXISTS "
                   "(SELECT 1 FROM group_members AS m WHERE m.group_id = "
                   "l.group_id AND m.vehicle_key = l.query_vehicle) OR NOT "
                   "EXISTS (SELECT 1 FROM group_members AS m WHERE m.group_id "
                   "= l.group_id AND m.vehicle_key = l.matched_vehicle)",
                   "loop closures of groups name vehicles that are no members"},
             Query{"SELECT count(*) FROM deleted_vehicles WHERE key IN (SELECT "
                   "key FROM vehicles)",
                   "vehicles are there although they were deleted"},
         }) {
      const absl::StatusOr<std::int64_t> count =
          database_->QueryInteger(query.sql);
      if (!count.ok()) {
        Note(count.status());
      } else if (*count != 0) {
        Note(std::to_string(*count) + " " + query.what);
      }
    }
    const absl::StatusOr<std::int64_t> revised =
        database_->QueryInteger("SELECT count(*) FROM revised_batches");
    if (revised.ok()) report_.revised_batches = *revised;
  }

  const std::string path_;
  const StoreUse use_;
  SqliteDatabase* const database_;
  Storage* const storage_;
  StoreReport report_;
};

// Whether the log holds a page, so that it does not matter what the file has in
// its place: a full disk, or a crash, may stop the copying of the log in the
// middle of a page.
bool IsInLog(const std::string& path, std::uintmax_t page) {
  const absl::StatusOr<LogReport> log = ReadLog(LogOf(path));
  if (!log.ok()) return false;
  const auto pages = PagesIn(LogOf(path), *log);
  return pages.ok() && pages->count(static_cast<std::uint32_t>(page)) > 0;
}

}  // namespace

absl::StatusOr<std::vector<std::string>> FindStructuralDamage(
    SqliteDatabase& database, StoreUse use, const std::string& path) {
  std::vector<std::string> problems;
  // SQLite takes a page that was cut for one that ends in zeros.
  const absl::StatusOr<std::int64_t> page_bytes =
      database.QueryInteger("PRAGMA page_size");
  if (!page_bytes.ok()) return page_bytes.status();
  std::error_code error;
  const std::uintmax_t bytes = std::filesystem::file_size(path, error);
  const auto page_size = static_cast<std::uintmax_t>(*page_bytes);
  if (use == StoreUse::kIdle && !error && bytes % page_size != 0 &&
      !IsInLog(path, bytes / page_size + 1)) {
    problems.push_back("the file has " + std::to_string(bytes) +
                       " bytes, which is no whole number of pages");
  }
  SqliteStatement row = database.Prepare("PRAGMA integrity_check(10)");
  while (true) {
    const absl::StatusOr<bool> found = row.Step();
    if (!found.ok()) return found.status();
    if (!*found) return problems;
    const std::string line = Printable(row.Bytes(0));
    if (line != "ok") problems.push_back(line);
  }
}

absl::StatusOr<StoreToRead> LookAtStore(const std::string& path, StoreUse use) {
  StoreToRead store{path, use, SqliteDatabase::Mode::kReadOnly, {}, {}};
  const absl::Status is_there = CheckDatabaseIsThere(path);
  if (!is_there.ok()) return is_there;
  if (use == StoreUse::kServed) return store;
  store.looks = LooksOf(path);
  absl::StatusOr<StoreExamination> examination = ExamineStore(path);
  if (!examination.ok()) return examination.status();
  store.mode = ReadingMode(examination->has_no_log);
  store.files = *std::move(examination);
  return store;
}

bool HasChanged(const StoreToRead& store) {
  return store.use == StoreUse::kIdle &&
         (StoreLock::IsHeld(store.path) || LooksOf(store.path) != store.looks);
}

absl::StatusOr<StoreReport> CheckStore(const std::string& path, StoreUse use) {
  const absl::StatusOr<StoreToRead> store = LookAtStore(path, use);
  if (!store.ok()) return store.status();
  // SQLite would combine files that do not belong together.
  const StoreExamination& files = store->files;
  if (!files.damage.empty() && !files.can_be_dropped) return DamageOf(files);
  absl::StatusOr<StoreReport> report = [&]() -> absl::StatusOr<StoreReport> {
    absl::StatusOr<std::unique_ptr<SqliteDatabase>> database =
        OpenDatabaseToRead(path, store->mode);
    if (!database.ok()) return database.status();
    absl::StatusOr<std::unique_ptr<Storage>> storage =
        OpenSqliteStorageToRead(path, store->mode);
    if (!storage.ok()) return storage.status();
    return Checker(path, use, database->get(), storage->get()).Check();
  }();
  if (HasChanged(*store)) return CheckStore(path, StoreUse::kServed);
  if (report.ok() && !files.damage.empty()) {
    report->problems.emplace_back(DamageOf(files).message());
    report->damaged_vehicles.insert(files.vehicles.begin(),
                                    files.vehicles.end());
  }
  return report;
}

}  // namespace revisit::server
