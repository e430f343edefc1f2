#include "tests/server/memory_storage.h"

#include <algorithm>
#include <utility>

#include "server/base/status.h"
#include "server/storage/record_checksum.h"

namespace revisit::server {
namespace {

using absl::StatusCode;

absl::Status UnknownVehicle() {
  return Error(StatusCode::kNotFound, "VEHICLE_NOT_FOUND", "no such vehicle");
}

absl::Status NoPart() {
  return Error(StatusCode::kFailedPrecondition, "INTERNAL", "no such part");
}

absl::Status Damage(const std::string& what) {
  return Error(StatusCode::kDataLoss, "STORE_CORRUPT", what + " is damaged");
}

}  // namespace

MemoryStorage::Vehicle& MemoryStorage::Find(const std::string& id) {
  return std::find_if(vehicles_.begin(), vehicles_.end(),
                      [&](const auto& vehicle) {
                        return vehicle.second.record.id == id;
                      })
      ->second;
}

std::optional<std::string> MemoryStorage::IdOf(VehicleKey key) const {
  const auto found = vehicles_.find(key);
  if (found == vehicles_.end()) return std::nullopt;
  return found->second.record.id;
}

void MemoryStorage::DamageVehicle(const std::string& id) {
  const std::lock_guard<std::mutex> guard(mutex_);
  VehicleRecord& record = Find(id).record;
  record.payload.clear();
  record.damage = Damage("vehicle");
}

void MemoryStorage::DamagePose(const std::string& id, std::uint64_t sequence) {
  const std::lock_guard<std::mutex> guard(mutex_);
  for (Batch& batch : Find(id).batches) {
    const BatchRecord& record = batch.as_sent;
    if (record.first_sequence <= sequence &&
        sequence < record.first_sequence + record.count) {
      batch.is_damaged = true;
    }
  }
}

void MemoryStorage::DamagePair(const std::string& id, PairKind kind,
                               const std::string& pair_id) {
  const std::lock_guard<std::mutex> guard(mutex_);
  Find(id).pairs[kind].at(pair_id).damage = Damage("pair " + pair_id);
}

void MemoryStorage::DamageDeletedPair(const std::string& id) {
  const std::lock_guard<std::mutex> guard(mutex_);
  Find(id).deleted_pairs.at(0).pair.damage = Damage("deletion");
}

void MemoryStorage::DropDamaged(VehicleKey key, std::uint64_t last_sequence,
                                std::string payload, std::uint64_t revision,
                                Done done) {
  done(Change(key, revision, [&](Vehicle& vehicle) {
    if (!vehicle.record.damage.ok()) return vehicle.record.damage;
    auto& batches = vehicle.batches;
    while (!batches.empty() &&
           batches.back().as_sent.first_sequence > last_sequence) {
      vehicle.DropSnapshot();
      batches.pop_back();
    }
    if (Complete(vehicle).durable_sequence != last_sequence) {
      return Error(StatusCode::kFailedPrecondition, "INTERNAL",
                   "no batch ends there");
    }
    vehicle.record.payload = payload;
    for (auto& [kind, pairs] : vehicle.pairs) {
      for (auto i = pairs.begin(); i != pairs.end();) {
        const PosePairRecord& pair = i->second;
        const bool goes = !pair.damage.ok() ||
                          pair.query_sequence > last_sequence ||
                          pair.matched_sequence > last_sequence;
        i = goes ? pairs.erase(i) : std::next(i);
      }
    }
    auto& deleted = vehicle.deleted_pairs;
    deleted.erase(std::remove_if(deleted.begin(), deleted.end(),
                                 [](const DeletedPairRecord& one) {
                                   return !one.pair.damage.ok();
                                 }),
                  deleted.end());
    ChecksHead& head = vehicle.record.checks;
    head.checked_sequence = std::min(head.checked_sequence, last_sequence);
    vehicle.checks.erase(vehicle.checks.upper_bound(last_sequence),
                         vehicle.checks.end());
    groups_.Cut(key, last_sequence);
    return absl::OkStatus();
  }));
}

absl::Status MemoryStorage::Change(
    VehicleKey key, std::uint64_t revision,
    const std::function<absl::Status(Vehicle&)>& change) {
  const std::lock_guard<std::mutex> guard(mutex_);
  const auto found = vehicles_.find(key);
  if (found == vehicles_.end()) return UnknownVehicle();
  Vehicle changed = found->second;
  const absl::Status status = change(changed);
  if (!status.ok()) return status;
  changed.record.revision = std::max(changed.record.revision, revision);
  found->second = std::move(changed);
  return absl::OkStatus();
}

VehicleRecord MemoryStorage::Complete(const Vehicle& vehicle) {
  VehicleRecord record = vehicle.record;
  if (!vehicle.batches.empty()) {
    const BatchRecord& last = vehicle.batches.back().as_sent;
    record.durable_sequence = last.first_sequence + last.count - 1;
    if (vehicle.batches.back().is_damaged) {
      if (record.damage.ok()) record.damage = Damage("last batch");
    }
  }
  const auto count = [&](PairKind kind) {
    const auto found = vehicle.pairs.find(kind);
    return found == vehicle.pairs.end()
               ? std::int64_t{0}
               : static_cast<std::int64_t>(found->second.size());
  };
  record.loop_closure_count = count(PairKind::kLoopClosure);
  record.rejected_candidate_count = count(PairKind::kRejectedCandidate);
  return record;
}

void MemoryStorage::CreateVehicle(
    VehicleRecord record,
    std::function<void(absl::StatusOr<VehicleKey>)> done) {
  absl::StatusOr<VehicleKey> result =
      Error(StatusCode::kAlreadyExists, "VEHICLE_EXISTS", "exists already");
  {
    const std::lock_guard<std::mutex> guard(mutex_);
    if (std::none_of(vehicles_.begin(), vehicles_.end(),
                     [&](const auto& vehicle) {
                       return vehicle.second.record.id == record.id;
                     })) {
      Vehicle vehicle;
      vehicle.record.key = ++last_key_;
      vehicle.record.id = record.id;
      vehicle.record.payload = record.payload;
      vehicle.record.revision = record.revision;
      vehicles_.emplace(last_key_, std::move(vehicle));
      result = last_key_;
    }
  }
  done(std::move(result));
}

void MemoryStorage::UpdateVehicle(VehicleKey key, std::string payload,
                                  std::uint64_t revision, Done done) {
  done(Change(key, revision, [&](Vehicle& vehicle) {
    vehicle.record.payload = payload;
    return absl::OkStatus();
  }));
}

void MemoryStorage::DeleteVehicle(VehicleKey key, EventRecord farewell,
                                  Done done) {
  std::size_t erased = 0;
  {
    const std::lock_guard<std::mutex> guard(mutex_);
    const auto found = vehicles_.find(key);
    farewell.number = found == vehicles_.end()
                          ? 0
                          : found->second.record.checks.last_event + 1;
    groups_.Leave(key);
    erased = vehicles_.erase(key);
    for (EventRecord& event : events_) {
      if (event.position.key == key) event.payload.clear();
    }
    if (farewell.number > 1) AddEvent(key, std::move(farewell));
  }
  done(erased == 0 ? UnknownVehicle() : absl::OkStatus());
}

void MemoryStorage::AppendBatches(VehicleKey key,
                                  std::vector<BatchRecord> batches,
                                  std::optional<std::string> vehicle_payload,
                                  Done done) {
  done(Change(key, batches.back().revision, [&](Vehicle& vehicle) {
    const std::uint64_t expected = Complete(vehicle).durable_sequence + 1;
    if (batches.front().first_sequence != expected) {
      return Error(StatusCode::kFailedPrecondition, "SEQUENCE_GAP", "gap",
                   {{"expected_sequence", std::to_string(expected)}});
    }
    for (const BatchRecord& batch : batches) {
      vehicle.batches.push_back({batch, batch});
    }
    if (vehicle_payload) vehicle.record.payload = *vehicle_payload;
    return absl::OkStatus();
  }));
}

void MemoryStorage::ReviseBatches(VehicleKey key, BatchSource batches,
                                  std::uint64_t revision, Done done) {
  done(Change(key, revision, [&](Vehicle& vehicle) {
    return batches([&](const BatchRecord& revised) {
      vehicle.DropSnapshot();
      const auto found = std::find_if(
          vehicle.batches.begin(), vehicle.batches.end(),
          [&](const Batch& batch) {
            return batch.as_sent.first_sequence == revised.first_sequence &&
                   batch.as_sent.count == revised.count;
          });
      if (found == vehicle.batches.end()) {
        return Error(StatusCode::kFailedPrecondition, "INTERNAL",
                     "no such batch");
      }
      found->current = revised;
      found->current.revision = revision;
      return absl::OkStatus();
    });
  }));
}

void MemoryStorage::ReplaceBatches(VehicleKey key,
                                   std::vector<BatchVersions> batches,
                                   std::uint64_t revision, Done done) {
  done(Change(key, revision, [&](Vehicle& vehicle) {
    vehicle.DropSnapshot();
    const std::uint64_t begin = batches.front().as_sent.first_sequence;
    const std::uint64_t end =
        batches.back().as_sent.first_sequence + batches.back().as_sent.count;
    std::vector<Batch>& stored = vehicle.batches;
    const auto first =
        std::find_if(stored.begin(), stored.end(), [&](const Batch& batch) {
          return batch.as_sent.first_sequence == begin;
        });
    std::uint64_t next = begin;
    auto last = first;
    for (; last != stored.end() && next < end; ++last) {
      next += last->as_sent.count;
    }
    if (first == stored.end() || next != end) {
      return Error(StatusCode::kFailedPrecondition, "INTERNAL",
                   "no such batches");
    }
    std::vector<Batch> replaced;
    for (const BatchVersions& batch : batches) {
      replaced.push_back({batch.as_sent, batch.revised.value_or(batch.as_sent),
                          /*is_damaged=*/false});
    }
    const auto at = stored.erase(first, last);
    stored.insert(at, replaced.begin(), replaced.end());
    return absl::OkStatus();
  }));
}

void MemoryStorage::AddPosePair(VehicleKey key, PairKind kind,
                                PosePairRecord pair,
                                std::optional<ChecksWrite> checks,
                                std::uint64_t revision, Done done) {
  done(Change(key, revision, [&](Vehicle& vehicle) {
    if (!vehicle.pairs[kind].emplace(pair.id, pair).second) {
      return Error(StatusCode::kAlreadyExists, WordsOf(kind).exists,
                   "exists already");
    }
    return checks ? Store(key, *checks, &vehicle) : absl::OkStatus();
  }));
}

absl::Status MemoryStorage::Store(VehicleKey key, const ChecksWrite& write,
                                  Vehicle* vehicle) {
  if (vehicle->record.checks != write.before) {
    return Error(StatusCode::kFailedPrecondition, "INTERNAL",
                 "another head of checks");
  }
  vehicle->record.checks = write.after;
  for (const std::uint64_t sequence : write.removed) {
    vehicle->checks.erase(sequence);
  }
  for (const CheckRecord& check : write.checks) {
    vehicle->checks[check.sequence] = check;
  }
  std::uint64_t number = write.before.last_event;
  for (EventRecord event : write.events) {
    event.number = ++number;
    AddEvent(key, std::move(event));
  }
  return absl::OkStatus();
}

void MemoryStorage::AddEvent(VehicleKey key, EventRecord event) {
  event.position = {++last_order_, key, event.number,
                    ChecksumOfEvent(kStoreFormat, key, event)};
  events_.push_back(std::move(event));
}

void MemoryStorage::PutChecks(VehicleKey key, ChecksWrite checks, Done done) {
  done(Change(key, 0,
              [&](Vehicle& vehicle) { return Store(key, checks, &vehicle); }));
}

void MemoryStorage::DropEvents(std::int64_t before_ns, int most, Done done) {
  {
    const std::lock_guard<std::mutex> guard(mutex_);
    for (; most > 0 && !events_.empty() && events_.front().time_ns < before_ns;
         --most) {
      dropped_ = events_.front().position;
      events_.erase(events_.begin());
    }
  }
  done(absl::OkStatus());
}

void MemoryStorage::DeletePosePair(VehicleKey key, DeletedPairRecord deleted,
                                   std::optional<ChecksWrite> checks,
                                   std::uint64_t revision, Done done) {
  done(Change(key, revision, [&](Vehicle& vehicle) {
    if (vehicle.pairs[deleted.kind].erase(deleted.pair.id) == 0) {
      return Error(StatusCode::kNotFound, WordsOf(deleted.kind).not_found,
                   "no such pair");
    }
    auto& kept = vehicle.deleted_pairs;
    deleted.number = kept.empty() ? 1 : kept.front().number + 1;
    kept.push_front(deleted);
    if (kept.size() > kMostDeletedPairs) kept.pop_back();
    return checks ? Store(key, *checks, &vehicle) : absl::OkStatus();
  }));
}

void MemoryStorage::PutSnapshotPart(VehicleKey key, std::uint32_t number,
                                    std::string part, Done done) {
  done(Change(key, 0, [&](Vehicle& vehicle) {
    if (number == 0) vehicle.DropSnapshot();
    auto& parts = vehicle.snapshot_parts;
    if (number > parts.size()) return NoPart();
    if (number == parts.size()) parts.emplace_back();
    parts[number] = part;
    return absl::OkStatus();
  }));
}

void MemoryStorage::PutSnapshot(VehicleKey key, SnapshotRecord snapshot,
                                Done done) {
  done(Change(key, 0, [&](Vehicle& vehicle) {
    if (snapshot.part_count > vehicle.snapshot_parts.size()) return NoPart();
    vehicle.snapshot = snapshot;
    return absl::OkStatus();
  }));
}

void MemoryStorage::DropSnapshot(VehicleKey key, Done done) {
  done(Change(key, 0, [&](Vehicle& vehicle) {
    vehicle.DropSnapshot();
    return absl::OkStatus();
  }));
}

absl::StatusOr<std::optional<SnapshotRecord>> MemoryStorage::GetSnapshot(
    VehicleKey key) {
  const std::lock_guard<std::mutex> guard(mutex_);
  const auto found = vehicles_.find(key);
  if (found == vehicles_.end()) return std::optional<SnapshotRecord>();
  return found->second.snapshot;
}

absl::Status MemoryStorage::ReadSnapshotParts(
    VehicleKey key, std::uint32_t first, std::uint32_t end,
    const std::function<bool(absl::string_view)>& visit) {
  std::vector<std::string> parts;
  {
    const std::lock_guard<std::mutex> guard(mutex_);
    const auto found = vehicles_.find(key);
    if (found != vehicles_.end()) parts = found->second.snapshot_parts;
  }
  for (std::uint32_t number = first; number < end; ++number) {
    if (number >= parts.size()) return Damage("snapshot");
    if (!visit(parts[number])) break;
  }
  return absl::OkStatus();
}

void MemoryStorage::PutMarks(VehicleKey key, std::string marks, Done done) {
  done(Change(key, 0, [&](Vehicle& vehicle) {
    vehicle.marks = marks;
    return absl::OkStatus();
  }));
}

absl::StatusOr<std::optional<std::string>> MemoryStorage::GetMarks(
    VehicleKey key) {
  const std::lock_guard<std::mutex> guard(mutex_);
  const auto found = vehicles_.find(key);
  if (found == vehicles_.end()) return std::optional<std::string>();
  return found->second.marks;
}

absl::StatusOr<VehicleRecord> MemoryStorage::GetVehicle(const std::string& id) {
  const std::lock_guard<std::mutex> guard(mutex_);
  for (const auto& [key, vehicle] : vehicles_) {
    if (vehicle.record.id == id) return Complete(vehicle);
  }
  return UnknownVehicle();
}

absl::StatusOr<std::vector<VehicleRecord>> MemoryStorage::GetVehicles(
    const std::set<std::string>& ids) {
  std::vector<VehicleRecord> records;
  for (const std::string& id : ids) {
    absl::StatusOr<VehicleRecord> record = MemoryStorage::GetVehicle(id);
    if (record.ok()) records.push_back(*std::move(record));
  }
  return records;
}

absl::StatusOr<std::vector<VehicleRecord>> MemoryStorage::ListVehicleRows(
    VehicleKey after_key, int limit) {
  const std::lock_guard<std::mutex> guard(mutex_);
  std::vector<VehicleRecord> rows;
  for (auto i = vehicles_.upper_bound(after_key);
       i != vehicles_.end() && static_cast<int>(rows.size()) < limit; ++i) {
    VehicleRecord row;
    row.key = i->first;
    row.id = i->second.record.id;
    row.payload = i->second.record.payload;
    row.damage = i->second.record.damage;
    rows.push_back(std::move(row));
  }
  return rows;
}

absl::StatusOr<std::vector<VehicleRecord>> MemoryStorage::ListVehicles(
    const std::string& after_id, const std::string& prefix, int limit) {
  std::map<std::string, VehicleRecord> sorted;
  {
    const std::lock_guard<std::mutex> guard(mutex_);
    for (const auto& [key, vehicle] : vehicles_) {
      sorted.emplace(vehicle.record.id, Complete(vehicle));
    }
  }
  std::vector<VehicleRecord> result;
  for (auto i = sorted.upper_bound(after_id);
       i != sorted.end() && static_cast<int>(result.size()) < limit; ++i) {
    if (i->first.compare(0, prefix.size(), prefix) == 0) {
      result.push_back(i->second);
    }
  }
  return result;
}

absl::Status MemoryStorage::ReadBatches(
    VehicleKey key, std::uint64_t first_sequence, std::uint64_t last_sequence,
    BatchVersion version, const std::function<bool(BatchRecord)>& visit) {
  std::vector<Batch> batches;
  {
    const std::lock_guard<std::mutex> guard(mutex_);
    const auto found = vehicles_.find(key);
    if (found == vehicles_.end()) return UnknownVehicle();
    batches = found->second.batches;
  }
  std::uint64_t expected = first_sequence;
  for (const Batch& batch : batches) {
    const std::uint64_t end =
        batch.as_sent.first_sequence + batch.as_sent.count;
    if (end <= first_sequence) continue;
    if (expected > last_sequence) return absl::OkStatus();
    if (batch.is_damaged) return Damage("batch");
    expected = end;
    if (!visit(version == BatchVersion::kAsSent ? batch.as_sent
                                                : batch.current)) {
      return absl::OkStatus();
    }
  }
  return expected > last_sequence
             ? absl::OkStatus()
             : Error(StatusCode::kDataLoss, "STORE_CORRUPT", "missing");
}

absl::StatusOr<std::vector<PosePairRecord>> MemoryStorage::ListPosePairs(
    VehicleKey key, PairKind kind, const std::string& after_id, int limit) {
  const std::lock_guard<std::mutex> guard(mutex_);
  const auto found = vehicles_.find(key);
  if (found == vehicles_.end()) return UnknownVehicle();
  std::vector<PosePairRecord> result;
  const auto& pairs = found->second.pairs[kind];
  for (auto i = pairs.upper_bound(after_id);
       i != pairs.end() && static_cast<int>(result.size()) < limit; ++i) {
    result.push_back(i->second);
  }
  return result;
}

absl::StatusOr<std::vector<DeletedPairRecord>> MemoryStorage::ListDeletedPairs(
    VehicleKey key) {
  const std::lock_guard<std::mutex> guard(mutex_);
  const auto found = vehicles_.find(key);
  if (found == vehicles_.end()) return UnknownVehicle();
  const auto& kept = found->second.deleted_pairs;
  return std::vector<DeletedPairRecord>(kept.begin(), kept.end());
}

absl::StatusOr<std::vector<CheckRecord>> MemoryStorage::ListChecks(
    VehicleKey key, std::uint64_t first_sequence, std::uint64_t last_sequence,
    bool open_only, int limit) {
  const std::lock_guard<std::mutex> guard(mutex_);
  const auto found = vehicles_.find(key);
  if (found == vehicles_.end()) return UnknownVehicle();
  std::vector<CheckRecord> result;
  for (const auto& [sequence, check] : found->second.checks) {
    if (static_cast<int>(result.size()) == limit) break;
    if (sequence < first_sequence || sequence > last_sequence) continue;
    if (open_only && check.open_count == 0) continue;
    result.push_back(check);
  }
  return result;
}

absl::StatusOr<std::vector<VehicleRecord>> MemoryStorage::ListUnchecked(
    VehicleKey after_key, int limit) {
  const std::lock_guard<std::mutex> guard(mutex_);
  std::vector<VehicleRecord> result;
  for (auto i = vehicles_.upper_bound(after_key);
       i != vehicles_.end() && static_cast<int>(result.size()) < limit; ++i) {
    const VehicleRecord complete = Complete(i->second);
    if (!complete.checks.stores ||
        complete.checks.checked_sequence >= complete.durable_sequence) {
      continue;
    }
    VehicleRecord record;
    record.key = i->first;
    record.id = complete.id;
    record.checks = complete.checks;
    result.push_back(std::move(record));
  }
  return result;
}

absl::StatusOr<std::vector<EventRecord>> MemoryStorage::ReadEvents(
    const EventPosition& after, int limit) {
  const std::lock_guard<std::mutex> guard(mutex_);
  auto next = events_.begin();
  if (!(after == dropped_)) {
    next = std::find_if(
        events_.begin(), events_.end(),
        [&](const EventRecord& event) { return event.position == after; });
    if (next == events_.end()) {
      return Error(
          StatusCode::kOutOfRange,
          after.order < dropped_.order ? "CURSOR_TOO_OLD" : "CURSOR_UNKNOWN",
          "no event at the cursor");
    }
    ++next;
  }
  std::vector<EventRecord> result;
  for (; next != events_.end() && static_cast<int>(result.size()) < limit;
       ++next) {
    result.push_back(*next);
  }
  return result;
}

absl::StatusOr<EventPosition> MemoryStorage::LastEvent() {
  const std::lock_guard<std::mutex> guard(mutex_);
  return events_.empty() ? dropped_ : events_.back().position;
}

}  // namespace revisit::server
