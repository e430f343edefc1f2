#include "tests/server/storage_testing.h"

#include <functional>
#include <optional>
#include <sstream>
#include <utility>

#include "tests/server/waiting.h"

namespace revisit::server {
namespace {

using Write = std::function<void(Storage::Done)>;

absl::Status Blocking(const Write& write) {
  const Answer<absl::Status> answer;
  write(answer.Setter());
  return answer.Get();
}

}  // namespace

void AppendBatch(Storage& storage, VehicleKey key, BatchRecord batch,
                 std::optional<std::string> vehicle_payload,
                 Storage::Done done) {
  std::vector<BatchRecord> one;
  one.push_back(std::move(batch));
  storage.AppendBatches(key, std::move(one), std::move(vehicle_payload),
                        std::move(done));
}

absl::StatusOr<VehicleKey> BlockingWrites::Create(const std::string& id,
                                                  const std::string& payload,
                                                  std::uint64_t revision) {
  VehicleRecord record;
  record.id = id;
  record.payload = payload;
  record.revision = revision;
  const Answer<absl::StatusOr<VehicleKey>> answer;
  storage_->CreateVehicle(record, answer.Setter());
  const absl::StatusOr<VehicleKey> key = answer.Get();
  if (!key.ok()) return key;
  const absl::StatusOr<VehicleRecord> taken = storage_->TakeVehicle(id);
  return taken.ok() ? key : taken.status();
}

absl::Status BlockingWrites::PutSnapshotPart(VehicleKey key,
                                             std::uint32_t number,
                                             const std::string& part) {
  return Blocking([&](Storage::Done done) {
    storage_->PutSnapshotPart(key, number, part, std::move(done));
  });
}

absl::Status BlockingWrites::PutSnapshot(VehicleKey key,
                                         const SnapshotRecord& snapshot) {
  return Blocking([&](Storage::Done done) {
    storage_->PutSnapshot(key, snapshot, std::move(done));
  });
}

absl::Status BlockingWrites::DropSnapshot(VehicleKey key) {
  return Blocking([&](Storage::Done done) {
    storage_->DropSnapshot(key, std::move(done));
  });
}

absl::Status BlockingWrites::PutMarks(VehicleKey key,
                                      const std::string& marks) {
  return Blocking([&](Storage::Done done) {
    storage_->PutMarks(key, marks, std::move(done));
  });
}

absl::Status BlockingWrites::Confirm(VehicleKey key) {
  return Blocking([&](Storage::Done done) {
    storage_->ConfirmOwned(key, std::move(done));
  });
}

std::string SnapshotOf(Storage& storage, VehicleKey key) {
  const auto snapshot = storage.GetSnapshot(key);
  if (!snapshot.ok()) return "damaged";
  if (!*snapshot) return "none";
  std::string text = "to " + std::to_string((*snapshot)->last_sequence) + ":";
  const absl::Status read = storage.ReadSnapshotParts(
      key, 0, (*snapshot)->part_count, [&](absl::string_view part) {
        text += " " + std::string(part);
        return true;
      });
  return read.ok() ? text + ", '" + (*snapshot)->payload + "'" : "part damaged";
}

std::string MarksOf(Storage& storage, VehicleKey key) {
  const auto marks = storage.GetMarks(key);
  if (!marks.ok()) return "damaged";
  return marks->value_or("none");
}

absl::Status BlockingWrites::Update(VehicleKey key, const std::string& payload,
                                    std::uint64_t revision) {
  return Blocking([&](Storage::Done done) {
    storage_->UpdateVehicle(key, payload, revision, std::move(done));
  });
}

absl::Status BlockingWrites::Delete(VehicleKey key,
                                    const EventRecord& farewell) {
  return Blocking([&](Storage::Done done) {
    storage_->DeleteVehicle(key, farewell, std::move(done));
  });
}

absl::Status BlockingWrites::PutChecks(VehicleKey key,
                                       const ChecksWrite& checks) {
  return Blocking([&](Storage::Done done) {
    storage_->PutChecks(key, checks, std::move(done));
  });
}

absl::Status BlockingWrites::DropEvents(std::int64_t before_ns, int most) {
  return Blocking([&](Storage::Done done) {
    storage_->DropEvents(before_ns, most, std::move(done));
  });
}

absl::Status BlockingWrites::Append(VehicleKey key, const BatchRecord& batch) {
  return Blocking([&](Storage::Done done) {
    AppendBatch(*storage_, key, batch, std::nullopt, std::move(done));
  });
}

absl::Status BlockingWrites::AppendAll(
    VehicleKey key, const std::vector<BatchRecord>& batches,
    const std::optional<std::string>& vehicle_payload) {
  return Blocking([&](Storage::Done done) {
    storage_->AppendBatches(key, batches, vehicle_payload, std::move(done));
  });
}

absl::Status BlockingWrites::AppendWithVehicle(
    VehicleKey key, const BatchRecord& batch,
    const std::string& vehicle_payload) {
  return Blocking([&](Storage::Done done) {
    AppendBatch(*storage_, key, batch, vehicle_payload, std::move(done));
  });
}

BatchSource BatchesOf(std::vector<BatchRecord> batches) {
  return [batches = std::move(batches)](
             const std::function<absl::Status(const BatchRecord&)>& take) {
    for (const BatchRecord& batch : batches) {
      if (absl::Status status = take(batch); !status.ok()) return status;
    }
    return absl::OkStatus();
  };
}

absl::Status BlockingWrites::Revise(VehicleKey key,
                                    const std::vector<BatchRecord>& batches,
                                    std::uint64_t revision) {
  return Blocking([&](Storage::Done done) {
    storage_->ReviseBatches(key, BatchesOf(batches), revision, std::move(done));
  });
}

absl::Status BlockingWrites::Replace(VehicleKey key,
                                     const std::vector<BatchVersions>& batches,
                                     std::uint64_t revision) {
  return Blocking([&](Storage::Done done) {
    storage_->ReplaceBatches(key, batches, revision, std::move(done));
  });
}

absl::Status BlockingWrites::AddPair(VehicleKey key, PairKind kind,
                                     const PosePairRecord& pair,
                                     std::uint64_t revision,
                                     const std::optional<ChecksWrite>& checks) {
  return Blocking([&](Storage::Done done) {
    storage_->AddPosePair(key, kind, pair, checks, revision, std::move(done));
  });
}

absl::Status BlockingWrites::DropDamaged(VehicleKey key,
                                         std::uint64_t last_sequence,
                                         const std::string& payload,
                                         std::uint64_t revision) {
  return Blocking([&](Storage::Done done) {
    storage_->DropDamaged(key, last_sequence, payload, revision,
                          std::move(done));
  });
}

absl::Status BlockingWrites::DeletePair(VehicleKey key, PairKind kind,
                                        const std::string& id,
                                        std::uint64_t revision) {
  DeletedPairRecord deleted;
  deleted.kind = kind;
  deleted.pair.id = id;
  return DeletePair(key, deleted, revision);
}

absl::Status BlockingWrites::DeletePair(
    VehicleKey key, const DeletedPairRecord& deleted, std::uint64_t revision,
    const std::optional<ChecksWrite>& checks) {
  return Blocking([&](Storage::Done done) {
    storage_->DeletePosePair(key, deleted, checks, revision, std::move(done));
  });
}

absl::StatusOr<std::vector<BatchRecord>> ReadAll(Storage& storage,
                                                 VehicleKey key,
                                                 std::uint64_t first,
                                                 std::uint64_t last,
                                                 BatchVersion version) {
  std::vector<BatchRecord> batches;
  const absl::Status status =
      storage.ReadBatches(key, first, last, version, [&](BatchRecord batch) {
        batches.push_back(std::move(batch));
        return true;
      });
  if (!status.ok()) return status;
  return batches;
}

std::string ToText(const VehicleRecord& record) {
  std::ostringstream text;
  text << record.id << " " << record.key << ": " << record.loop_closure_count
       << " closures, " << record.rejected_candidate_count << " rejected, to "
       << record.durable_sequence << ", revision " << record.revision << ", '"
       << record.payload << "'";
  if (record.checks != ChecksHead()) {
    text << ", checks " << (record.checks.stores ? "stored" : "not stored")
         << " to " << record.checks.checked_sequence << ", event "
         << record.checks.last_event;
  }
  return text.str();
}

std::string ToText(const CheckRecord& record) {
  std::ostringstream text;
  text << record.sequence << ": " << record.open_count << " open, revision "
       << record.revision << ", " << record.create_time_ns << " ns, '"
       << record.payload << "'";
  return text.str();
}

std::string ToText(const EventRecord& record) {
  std::ostringstream text;
  text << record.number << ": " << record.time_ns << " ns, '" << record.payload
       << "'";
  return text.str();
}

std::string ToText(const BatchRecord& record) {
  std::ostringstream text;
  text << record.first_sequence << "+" << record.count << ", revision "
       << record.revision << ", '" << record.payload << "'";
  return text.str();
}

std::string ToText(const PosePairRecord& record) {
  std::ostringstream text;
  text << record.id << ": " << record.query_sequence << " at "
       << record.matched_sequence << ", " << record.create_time_ns << " ns";
  if (!record.payload.empty()) text << ", '" << record.payload << "'";
  return text.str();
}

std::string ToText(const DeletedPairRecord& record) {
  const std::string number = std::to_string(record.number);
  if (!record.pair.damage.ok()) return number + ", damaged";
  return number + ", " +
         (record.kind == PairKind::kLoopClosure ? "closure " : "rejected ") +
         ToText(record.pair) + ", deleted at " +
         std::to_string(record.delete_time_ns) + " ns";
}

absl::StatusOr<std::uint64_t> BlockingGroupWrites::Create(
    const std::string& id, const std::string& payload, const std::string& uid) {
  GroupRecord group;
  group.id = id;
  group.version = {uid, 77};  // The revision is not read.
  group.payload = payload;
  const Answer<absl::StatusOr<std::uint64_t>> answer;
  groups_.CreateGroup(group, answer.Setter());
  return answer.Get();
}

absl::StatusOr<std::uint64_t> BlockingGroupWrites::Change(
    const std::string& id, const std::vector<GroupChange>& changes,
    const std::optional<GroupVersion>& expected) {
  const Answer<absl::StatusOr<std::uint64_t>> answer;
  groups_.ChangeGroup(id, expected, changes, answer.Setter());
  return answer.Get();
}

absl::StatusOr<std::uint64_t> BlockingGroupWrites::Delete(
    const std::string& id, const std::optional<GroupVersion>& expected) {
  const Answer<absl::StatusOr<std::uint64_t>> answer;
  groups_.DeleteGroup(id, expected, answer.Setter());
  return answer.Get();
}

std::string ToText(const GroupRecord& record) {
  std::ostringstream text;
  text << record.id << " " << record.version.uid << ": revision "
       << record.version.revision << ", '" << record.payload << "'";
  if (!record.damage.ok()) text << ", damaged";
  return text.str();
}

std::string ToText(const GroupMemberRecord& record) {
  std::ostringstream text;
  text << record.vehicle_id << ": '" << record.payload << "'";
  if (!record.damage.ok()) text << ", damaged";
  return text.str();
}

std::string ToText(const GroupLinkRecord& record) {
  std::ostringstream text;
  text << record.id;
  if (!record.damage.ok()) {
    text << ", damaged";
    return text.str();
  }
  text << (record.state == LinkState::kConfirmed   ? ", confirmed: "
           : record.state == LinkState::kTentative ? ", tentative: "
           : record.state == LinkState::kRejected  ? ", rejected: "
                                                   : ", suspect: ")
       << record.query.sequence << " of " << record.query.vehicle << " at "
       << record.matched.sequence << " of " << record.matched.vehicle << ", '"
       << record.payload << "'";
  return text.str();
}

std::string ToText(const PlacedLink& record) {
  return record.group + "/" + ToText(record.link);
}

}  // namespace revisit::server
