#include "server/storage/postgres/postgres_writer.h"

#include <pthread.h>

#include <algorithm>
#include <unordered_map>
#include <utility>

#include "server/base/status.h"
#include "server/storage/free_space.h"
#include "server/storage/postgres/postgres_changes.h"
#include "server/storage/postgres/postgres_snapshots.h"

namespace revisit::server {
namespace {

using absl::StatusCode;

// How long purging rests after it has failed.
constexpr std::chrono::seconds kPurgeDelay{5};
// How long a full disk is taken to be full if nothing is written.
constexpr std::chrono::seconds kFullTime{5};

// The right to connect is all that it needs.
constexpr Statement kDatabaseSize = {
    "database_size", "SELECT pg_database_size(current_database())"};

// Whether a statement failed because of a row of one vehicle.
bool IsFaultOfRow(const absl::Status& status) {
  return absl::IsInternal(status) || absl::IsDataLoss(status);
}

bool Follows(const PendingWrite& before, const PendingWrite& row) {
  return row.claim == before.claim &&
         row.first_sequence() == before.last_sequence() + 1;
}

}  // namespace

PostgresWriter::PostgresWriter(const Options& options, Ownership* ownership)
    : options_(options),
      ownership_(ownership),
      queue_(options),
      thread_([this] { Run(); }) {
  pthread_setname_np(thread_.native_handle(), "store-writer");
}

PostgresWriter::~PostgresWriter() {
  Stop();
  thread_.join();
}

void PostgresWriter::Stop() { queue_.Stop(); }

bool PostgresWriter::AwaitEnd(std::chrono::steady_clock::time_point latest) {
  const MutexLock lock(&mutex_);
  while (!ended_) {
    if (has_ended_.WaitUntil(&mutex_, latest)) return ended_;
  }
  return true;
}

void PostgresWriter::Append(VehicleKey key, std::vector<BatchRecord> batches,
                            Storage::Done done) {
  PendingWrite write;
  for (const BatchRecord& batch : batches) write.bytes += batch.payload.size();
  write.key = key;
  write.rows = std::move(batches);
  write.claim = ownership_->Find(key);
  write.done.push_back(std::move(done));
  queue_.SubmitAppend(std::move(write));
}

void PostgresWriter::Submit(VehicleKey key, std::size_t bytes, Write apply,
                            Storage::Done done) {
  PendingWrite write;
  write.bytes = bytes;
  write.key = key;
  write.claim = ownership_->Find(key);
  write.apply = [this, fence = Fence{key, write.claim},
                 apply = std::move(apply)] {
    return apply(*connection_, fence);
  };
  write.done.push_back(std::move(done));
  queue_.Submit(std::move(write));
}

void PostgresWriter::PurgeSoon() { purge_due_ = Clock::now(); }

absl::Status PostgresWriter::CheckWritable() const {
  const Clock::rep full_at = full_at_;
  if (full_at != 0 &&
      Clock::now().time_since_epoch() - Clock::duration(full_at) <= kFullTime) {
    return StorageFull("the database's disk is full");
  }
  return CheckReplicated(ownership_->durability());
}

void PostgresWriter::Run() {
  if (options_.purges_first) PurgeSoon();
  if (options_.size_period.count() > 0) size_due_ = Clock::now();
  while (auto group = queue_.Take(NextDue(), commit_time_)) {
    if (!group->empty()) {
      const Clock::time_point start = Clock::now();
      Commit(*group);
      const Clock::duration taken = Clock::now() - start;
      // A moving mean follows the device, and soon forgets a single slow flush.
      commit_time_ += (taken - commit_time_) / 8;
      commit_seconds_.Observe(taken);
      // Destroys the callbacks, and what they hold, before the next is taken.
      group->clear();
    }
    if (purge_due_ && Clock::now() >= *purge_due_) Purge();
    if (size_due_ && Clock::now() >= *size_due_) AskSize();
  }
  connection_.reset();
  const MutexLock lock(&mutex_);
  ended_ = true;
  has_ended_.NotifyAll();
}

void PostgresWriter::Commit(const std::vector<PendingWrite>& group) {
  Rounds rounds;
  // Where the next row of a vehicle may go.
  struct Place {
    std::size_t round;
    std::size_t run;
  };
  std::unordered_map<VehicleKey, Place> places;
  for (const PendingWrite& write : group) {
    if (!write.apply) {
      const auto found = places.find(write.key);
      if (found != places.end()) {
        AppendRun& run = rounds[found->second.round][found->second.run];
        if (Follows(*run.back(), write)) {
          run.push_back(&write);
          continue;
        }
      }
      const std::size_t round =
          found == places.end() ? 0 : found->second.round + 1;
      if (round == rounds.size()) rounds.emplace_back();
      places[write.key] = {round, rounds[round].size()};
      rounds[round].push_back({&write});
      continue;
    }
    // It may be of a vehicle whose rows wait.
    AppendGathered(&rounds);
    places.clear();
    absl::Status status = EnsureConnection();
    if (status.ok()) status = write.apply();
    if (status.ok()) ++commits_;
    Answer(write, status);
  }
  AppendGathered(&rounds);
}

void PostgresWriter::AppendGathered(Rounds* rounds) {
  for (const std::vector<AppendRun>& runs : *rounds) AppendRound(runs);
  rounds->clear();
}

void PostgresWriter::AppendRound(const std::vector<AppendRun>& runs) {
  std::vector<absl::Status> results;
  absl::Status status = EnsureConnection();
  if (status.ok()) status = AppendRuns(*connection_, runs, &results);
  if (!status.ok() && IsFaultOfRow(status) && runs.size() > 1) {
    for (const AppendRun& run : runs) AppendRound({run});
    return;
  }
  if (status.ok()) {
    ++commits_;
  } else {
    results.assign(runs.size(), status);
  }
  for (std::size_t i = 0; i < runs.size(); ++i) {
    // A row after the first may follow what is stored although that one does
    // not.
    if (absl::IsFailedPrecondition(results[i]) && runs[i].size() > 1) {
      for (const PendingWrite* row : runs[i]) AppendRound({{row}});
      continue;
    }
    for (const PendingWrite* row : runs[i]) Answer(*row, results[i]);
  }
}

void PostgresWriter::Answer(const PendingWrite& write,
                            const absl::Status& status) {
  if (status.ok()) {
    full_at_ = 0;
    writes_ += write.done.size();
  } else if (absl::IsUnavailable(status) || absl::IsAborted(status)) {
    if (write.claim != nullptr) {
      ownership_->Forget(write.key, write.claim.get(),
                         /*lost=*/absl::IsAborted(status));
    }
  } else if (absl::IsResourceExhausted(status)) {
    full_at_ = Clock::now().time_since_epoch().count();
  }
  for (const Storage::Done& done : write.done) done(status);
}

absl::Status PostgresWriter::Connect() {
  if (connection_ != nullptr && connection_->IsAlive()) return absl::OkStatus();
  connection_.reset();
  if (give_up_) {
    return Error(StatusCode::kUnavailable, "STORE_UNAVAILABLE",
                 "the server ends, and the database does not answer");
  }
  PostgresConnection::Options options;
  options.conninfo = options_.conninfo;
  options.writes = true;
  options.give_up = &give_up_;
  auto opened = PostgresConnection::Open(options);
  if (!opened.ok()) return opened.status();
  connection_ = *std::move(opened);
  return absl::OkStatus();
}

absl::Status PostgresWriter::EnsureConnection() {
  absl::Status status = Connect();
  if (status.ok()) status = CheckReplicated(connection_->durability());
  return status.ok() ? CheckReplicated(ownership_->durability()) : status;
}

absl::Status PostgresWriter::CheckReplicated(
    const Durability& durability) const {
  if (!options_.require_replicated ||
      durability.level == Durability::Level::kReplicated) {
    return absl::OkStatus();
  }
  return Error(StatusCode::kUnavailable, "STORE_UNAVAILABLE",
               "writes are refused, because the database does not replicate "
               "them before it acknowledges: " +
                   durability.details);
}

void PostgresWriter::Purge() {
  absl::Status status = EnsureConnection();
  bool more = false;
  if (status.ok()) {
    absl::StatusOr<bool> purged = PurgeSome(*connection_);
    if (purged.ok() && !*purged) purged = PurgeSnapshots(*connection_);
    status = purged.status();
    more = purged.ok() && *purged;
  }
  if (!status.ok()) {
    purge_due_ = Clock::now() + kPurgeDelay;
  } else if (more) {
    purge_due_ = Clock::now();
  } else {
    purge_due_.reset();
  }
}

void PostgresWriter::AskSize() {
  std::int64_t bytes = -1;
  if (Connect().ok()) {
    const auto rows = connection_->Run(kDatabaseSize);
    if (rows.ok()) bytes = rows->Integer(0, 0);
  }
  database_bytes_ = bytes;
  size_due_ = Clock::now() + options_.size_period;
}

std::optional<std::chrono::steady_clock::time_point> PostgresWriter::NextDue()
    const {
  if (!purge_due_ || !size_due_) return purge_due_ ? purge_due_ : size_due_;
  return std::min(*purge_due_, *size_due_);
}

std::optional<std::int64_t> PostgresWriter::DatabaseBytes() const {
  const std::int64_t bytes = database_bytes_;
  return bytes < 0 ? std::nullopt : std::make_optional(bytes);
}

}  // namespace revisit::server
