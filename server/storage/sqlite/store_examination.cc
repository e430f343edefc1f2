#include "server/storage/sqlite/store_examination.h"

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <memory>
#include <optional>
#include <system_error>
#include <utility>
#include <vector>

#include "server/base/status.h"
#include "server/storage/record_check.h"
#include "server/storage/sqlite/store_files.h"
#include "server/storage/sqlite/store_format.h"
#include "server/storage/sqlite/store_lock.h"
#include "server/storage/sqlite/store_state.h"
#include "server/storage/sqlite/vehicle_rows.h"
#include "server/storage/sqlite/write_ahead_log.h"

namespace revisit::server {
namespace {

constexpr std::size_t kListedNames = 20;

// The state in a database without its log; nothing if it cannot be read as a
// store.
std::optional<StoreState> ReadFileAlone(const std::string& store) {
  const absl::StatusOr<std::unique_ptr<SqliteDatabase>> database =
      SqliteDatabase::Open(store, SqliteDatabase::Mode::kFileOnly, "");
  if (!database.ok()) return std::nullopt;
  const absl::StatusOr<FileFormat> format = ReadFormat(**database);
  if (!format.ok() || !CheckKnownFormat(store, *format).ok()) {
    return std::nullopt;
  }
  const absl::StatusOr<StoreState> state = ReadState(**database);
  if (!state.ok()) return std::nullopt;
  return *state;
}

// Compares the states that the files of a store hold.
class Comparison {
 public:
  Comparison(std::string store, const LogReport& log)
      : store_(std::move(store)),
        log_(log),
        file_(ReadFileAlone(store_)),
        mark_(DurableMark::Read(store_)),
        lock_(StoreLock::Read(store_)) {}

  // Looks for damage that cannot be dropped first.
  StoreExamination Compare() const {
    StoreExamination result;
    result.damage = FindStranger();
    if (result.damage.empty()) result.damage = FindGap();
    if (!result.damage.empty()) return result;
    result.can_be_dropped = true;
    result.damage = FindMissing();
    return result;
  }

 private:
  bool log_is_used() const { return log_.end.frames > 0; }
  // The last commit that SQLite will see.
  std::optional<StoreState> end() const {
    return log_.states.empty() ? file_ : log_.states.back();
  }

  std::string FindStranger() const {
    struct Known {
      std::string file;
      std::optional<StoreState> state;
    };
    const std::vector<Known> all = {
        {store_, file_},
        {LogOf(store_), log_.states.empty()
                            ? std::nullopt
                            : std::optional(log_.states.front())},
        {store_ + ".mark", mark_},
        {store_ + ".lock", lock_}};
    const Known* first = nullptr;
    for (const Known& known : all) {
      if (!known.state) continue;
      if (first == nullptr) first = &known;
      if (known.state->id != first->state->id) {
        return known.file + " is of another store than " + first->file + ": " +
               ToText(*known.state) + " and " + ToText(*first->state);
      }
    }
    return "";
  }

  // Whether the log, if there is one, goes on from the database's last commit.
  std::string FindGap() const {
    if (!file_ || !log_is_used()) return "";
    if (log_.states.empty()) {
      return "the log " + LogOf(store_) +
             " is of another store, or older than the database";
    }
    const StoreState& first = log_.states.front();
    const StoreState& last = log_.states.back();
    const std::uint64_t reached = file_->commit;
    const std::string but = ": the database holds commits up to " +
                            std::to_string(reached) + ", the log " +
                            std::to_string(first.commit) + " to " +
                            std::to_string(last.commit);
    if (reached + 1 < first.commit) {
      return "the database " + store_ + " is older than its log" + but;
    }
    if (reached > last.commit) {
      return "the log " + LogOf(store_) + " is older than the database" + but;
    }
    const bool fits = reached + 1 == first.commit
                          ? first.previous_run == file_->run
                          : std::any_of(log_.states.begin(), log_.states.end(),
                                        [&](const StoreState& state) {
                                          return IsSameCommit(state, *file_);
                                        });
    if (fits) return "";
    return "the log " + LogOf(store_) +
           " is of a copy of the store that went its own way" + but;
  }

  // Whether the files hold everything that was flushed.
  std::string FindMissing() const {
    if (!file_ && log_.states.empty()) return "";
    const std::uint64_t reached = end() ? end()->commit : 0;
    for (const std::optional<StoreState>& known : {mark_, lock_}) {
      if (!known) continue;
      if (known->commit > reached) {
        return "the log " + LogOf(store_) +
               (log_is_used() ? " is damaged: it ends with commit "
                              : " is missing, or the database is older: that "
                                "ends with commit ") +
               std::to_string(reached) + ", but commit " +
               std::to_string(known->commit) + " was flushed";
      }
      if (known->commit == reached && known->run != end()->run) {
        return "the log " + LogOf(store_) +
               " is of a copy of the store that went its own way from commit " +
               std::to_string(reached) + " on";
      }
    }
    // A database in use has a log, except for a moment in which the mark says
    // that none is needed.
    if (!log_.has_header && file_ && !file_->is_closed &&
        !(mark_ && IsSameCommit(*mark_, *file_))) {
      return "the log " + LogOf(store_) +
             " is missing or empty, but the database was in use";
    }
    return "";
  }

  const std::string store_;
  const LogReport& log_;
  const std::optional<StoreState> file_;
  const std::optional<StoreState> mark_;
  const std::optional<StoreState> lock_;
};

// Vehicles with rows that are only in the unreadable part of the log.
absl::StatusOr<std::set<std::string>> VehiclesBehind(const std::string& store,
                                                     const LogReport& log) {
  absl::StatusOr<std::unique_ptr<SqliteDatabase>> database =
      SqliteDatabase::Open(store, ReadingMode(log.end.frames == 0), "");
  if (!database.ok()) return database.status();
  std::set<std::string> names;
  absl::Status failure;
  const absl::Status visited =
      VisitRowsBehind(LogOf(store), log, [&](const LoggedRow& row) {
        SqliteStatement found =
            row.table == LoggedRow::Table::kVehicles
                ? (*database)->Prepare(
                      "SELECT 1 FROM vehicles WHERE id = ?2 AND checksum = ?4")
            : row.table == LoggedRow::Table::kBatches
                ? (*database)->Prepare(
                      "SELECT 1 FROM batches WHERE vehicle_key = ?1 AND "
                      "first_sequence = ?3 AND checksum = ?4 UNION ALL "
                      "SELECT 1 FROM revised_batches WHERE vehicle_key = ?1 "
                      "AND first_sequence = ?3 AND checksum = ?4")
                : (*database)->Prepare(
                      "SELECT 1 FROM loop_closures WHERE vehicle_key = ?1 AND "
                      "id = ?2 AND checksum = ?4 UNION ALL SELECT 1 FROM "
                      "rejected_candidates WHERE vehicle_key = ?1 AND id = ?2 "
                      "AND checksum = ?4");
        if (row.table != LoggedRow::Table::kVehicles) {
          found.Bind(1, row.vehicle_key);
        }
        if (row.table != LoggedRow::Table::kBatches) found.BindText(2, row.id);
        if (row.table == LoggedRow::Table::kBatches) {
          found.Bind(3, row.first_sequence);
        }
        const absl::StatusOr<bool> is_there =
            found.Bind(4, row.checksum).Step();
        if (!is_there.ok()) {
          failure = is_there.status();
        } else if (!*is_there && row.table == LoggedRow::Table::kVehicles) {
          names.insert(Printable(row.id));
        } else if (!*is_there) {
          const absl::StatusOr<std::string> id =
              VehicleId(**database, row.vehicle_key);
          // A vehicle that was created there is named by its own row.
          if (id.ok()) names.insert(*id);
        }
      });
  if (!visited.ok()) return visited;
  if (!failure.ok() && names.empty()) return failure;
  return names;
}

std::string LostIn(const StoreExamination& examination) {
  return examination.vehicles.empty() ? "cannot be told"
                                      : Listed(examination.vehicles);
}

}  // namespace

std::string Listed(const std::set<std::string>& names) {
  std::string text;
  std::size_t listed = 0;
  for (const std::string& name : names) {
    if (listed == kListedNames) {
      return text + " and " + std::to_string(names.size() - listed) + " more";
    }
    text += (listed++ == 0 ? "" : ", ") + name;
  }
  return text;
}

absl::Status CheckDatabaseIsThere(const std::string& store) {
  std::error_code error;
  const std::uintmax_t bytes = std::filesystem::file_size(store, error);
  if (!error && bytes > 0) return absl::OkStatus();
  const bool is_there = std::filesystem::exists(store, error);
  const std::vector<std::string> others = FilesBeside(store);
  if (!is_there && others.empty()) {
    return absl::NotFoundError(("there is no store at " + store).c_str());
  }
  std::string beside;
  for (const std::string& file : others) {
    beside += (beside.empty() ? ", beside " : " and ") + file;
  }
  return Corrupt("the database " + store + " is " +
                     (is_there ? "empty" : "missing") + beside +
                     ": put it back, or restore a backup into a new directory",
                 {});
}

absl::StatusOr<StoreExamination> ExamineStore(const std::string& store) {
  const absl::Status is_there = CheckDatabaseIsThere(store);
  if (!is_there.ok()) return is_there;
  const absl::StatusOr<LogReport> log = ReadLog(LogOf(store));
  if (!log.ok()) return log.status();
  StoreExamination examination = Comparison(store, *log).Compare();
  examination.has_unfinished_tail = log->has_unfinished_tail;
  examination.has_no_log = log->end.frames == 0;
  if (!log->damage.empty() &&
      (examination.damage.empty() || examination.can_be_dropped)) {
    examination.damage =
        "the log " + LogOf(store) + " is damaged: " + log->damage;
    examination.can_be_dropped = true;
  }
  if (examination.damage.empty() || !examination.can_be_dropped) {
    return examination;
  }
  absl::StatusOr<std::set<std::string>> vehicles = VehiclesBehind(store, *log);
  if (vehicles.ok()) examination.vehicles = *std::move(vehicles);
  return examination;
}

absl::Status DamageOf(const StoreExamination& examination) {
  return Corrupt(examination.damage +
                     "; vehicles with lost changes: " + LostIn(examination),
                 {{"vehicles", LostIn(examination)}});
}

absl::Status CheckStoreFiles(
    const std::string& store, bool drop_damaged_log,
    const std::function<void(const std::string&)>& warn, DurableMark* mark) {
  const auto tell = [&](const std::string& message) {
    if (warn) warn(message);
  };
  const absl::StatusOr<StoreExamination> found = ExamineStore(store);
  if (!found.ok()) return found.status();
  if (found->damage.empty()) {
    if (found->has_unfinished_tail) {
      tell("the log " + LogOf(store) +
           " ends in an unfinished write, which was not acknowledged; it is "
           "left out");
    }
    return absl::OkStatus();
  }
  const absl::Status damage = DamageOf(*found);
  if (!drop_damaged_log || !found->can_be_dropped) return damage;
  tell(std::string(damage.message()) + "; dropped as told");
  return mark->Clear();
}

}  // namespace revisit::server
