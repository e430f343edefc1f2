#include "server/sessions/vehicle_state.h"

#include <algorithm>
#include <cstddef>
#include <tuple>

#include "absl/strings/str_cat.h"
#include "core/drive/pose_graph.h"
#include "core/geometry/pose.h"

namespace revisit::server {

using absl::StatusCode;
using absl::StrCat;

namespace {

bool AreOf(const BatchRecord& batch, const DecodedPoses& poses) {
  if (poses.dropped) {
    return poses.dropped->first_sequence == batch.first_sequence &&
           poses.dropped->last_sequence ==
               batch.first_sequence + batch.count - 1;
  }
  const std::vector<core::PoseSample>& samples = poses.samples;
  bool fits = samples.size() == batch.count;
  for (std::size_t i = 0; fits && i < samples.size(); ++i) {
    fits = samples[i].sequence == batch.first_sequence + i;
  }
  return fits;
}

}  // namespace

core::NodeIndex NextLookAt(core::NodeIndex nodes) {
  core::NodeIndex look = kLeastLookedAt;
  while (look <= nodes) look += look / 10;
  return look;
}

absl::Status ShuttingDown() {
  return Error(StatusCode::kUnavailable, "SERVER_DRAINING",
               "the server is shutting down");
}

VehicleView VehicleState::View() const {
  return VehicleView{id,
                     config,
                     *drive,
                     key,
                     durable_sequence,
                     revision,
                     static_cast<std::int64_t>(loop_closures.size()),
                     &loop_closures,
                     &rejections,
                     damage,
                     config_is_known,
                     search.get()};
}

void VehicleState::Report() const {
  if (census == nullptr) return;
  using State = VehicleCensus::State;
  census->Found(key, !damage.ok()       ? State::kDamaged
                     : config.data_loss ? State::kDataLoss
                                        : State::kActive);
}

void VehicleState::Take(std::unique_ptr<core::Drive> another) {
  drive = std::move(another);
  ++drive_series;
  search = std::make_unique<core::Search>(drive.get());
  look_at_nodes = NextLookAt(drive->graph().size());
}

void VehicleState::Adopt(const VehicleConfig& new_config,
                         std::uint64_t new_revision) {
  config = new_config;
  revision = new_revision;
  staged = {config, durable_sequence, revision};
}

std::vector<std::pair<PairKind, const PosePairRecord*>>
VehicleState::PairsAsAdded() {
  std::vector<std::pair<PairKind, const PosePairRecord*>> added;
  for (const PairKind kind : kPairKinds) {
    for (const auto& entry : Pairs(kind)) {
      added.emplace_back(kind, &entry.second);
    }
  }
  std::sort(added.begin(), added.end(), [](const auto& a, const auto& b) {
    return std::tie(a.second->create_time_ns, a.second->id, a.first) <
           std::tie(b.second->create_time_ns, b.second->id, b.first);
  });
  return added;
}

void VehicleState::FindLatestPair() {
  latest_pair_ns.reset();
  for (const PosePairs* of_kind : {&loop_closures, &rejections}) {
    for (const auto& [pair_id, pair] : *of_kind) {
      latest_pair_ns = std::max(latest_pair_ns.value_or(pair.create_time_ns),
                                pair.create_time_ns);
    }
  }
}

std::vector<core::Jump> VehicleState::JumpsAt(std::uint64_t first,
                                              std::uint64_t last) const {
  const auto begin =
      std::lower_bound(jumps.begin(), jumps.end(), first,
                       [](const core::Jump& jump, std::uint64_t sequence) {
                         return jump.sequence < sequence;
                       });
  const auto end =
      std::upper_bound(begin, jumps.end(), last,
                       [](std::uint64_t sequence, const core::Jump& jump) {
                         return sequence < jump.sequence;
                       });
  return {begin, end};
}

void VehicleState::NoteResidency(const core::Drive* in_the_making) {
  std::int64_t nodes = 0;
  std::int64_t bytes = 0;
  for (const core::Drive* const each :
       {static_cast<const core::Drive*>(drive.get()), in_the_making}) {
    if (each == nullptr) continue;
    nodes += each->graph().size();
    bytes += static_cast<std::int64_t>(each->bytes());
  }
  resident_nodes.store(nodes);
  resident_bytes.store(bytes);
  if (drive) {
    const std::uint64_t poses = drive->last_sequence();
    const bool is_worth_it =
        static_cast<double>(drive->graph().size()) <=
        snapshot_policy.most_nodes_per_pose * static_cast<double>(poses);
    poses_since_snapshot = is_worth_it ? poses - snapshot_sequence : 0;
  }
}

void VehicleState::NoteSnapshot(std::uint64_t sequence) {
  snapshot_sequence = sequence;
  NoteResidency();
}

void VehicleState::Leave(const absl::Status& status) {
  gone_status = status;
  is_gone.store(true);
}

void VehicleState::NoteFailedWrite(const absl::Status& status) {
  in_doubt = true;
  if (absl::IsAborted(status) && !gone_status) Leave(status);
}

absl::Status VehicleState::CheckAgainstStore() {
  const absl::StatusOr<VehicleRecord> record = storage->TakeVehicle(id);
  if (!record.ok()) {
    if (absl::IsNotFound(record.status())) Leave(VehicleNotFound(id));
    if (ReasonOf(record.status()) == "NOT_OWNER") Leave(record.status());
    return record.status();
  }
  // Where this server had the vehicle under the epoch that is known here,
  // nobody else has had it since.
  if (record->key != key || record->previous_epoch != epoch ||
      record->durable_sequence != durable_sequence ||
      record->revision != revision ||
      record->loop_closure_count !=
          static_cast<std::int64_t>(loop_closures.size()) ||
      record->rejected_candidate_count !=
          static_cast<std::int64_t>(rejections.size()) ||
      !record->damage.ok() || !damage.ok()) {
    Leave(OutOfStep());
    return *gone_status;
  }
  epoch = record->epoch;
  in_doubt = false;
  return absl::OkStatus();
}

absl::StatusOr<DecodedBatch> VehicleState::DecodeStored(
    const BatchRecord& batch, const VehicleConfig& with_config) const {
  absl::StatusOr<DecodedBatch> decoded =
      codec->DecodeBatch(batch.payload, with_config);
  if (!decoded.ok()) return decoded;
  if (decoded->fingerprints.size() != decoded->samples.size() ||
      !AreOf(batch, *decoded)) {
    return HoldsOthers(batch);
  }
  return decoded;
}

absl::StatusOr<DecodedPoses> VehicleState::DecodeStoredPoses(
    const BatchRecord& batch, const VehicleConfig& with_config) const {
  absl::StatusOr<DecodedPoses> poses =
      codec->DecodePoses(batch.payload, with_config);
  if (poses.ok() && !AreOf(batch, *poses)) return HoldsOthers(batch);
  return poses;
}

absl::Status VehicleState::HoldsOthers(const BatchRecord& batch) const {
  return Corrupt(StrCat("stored batch of ", batch.count,
                        " poses from sequence ", batch.first_sequence,
                        " holds others than these"));
}

absl::Status VehicleState::Writable() const {
  if (!damage.ok()) return damage;
  return config.data_loss ? DataLoss({}) : absl::OkStatus();
}

absl::Status VehicleState::HandedOver() const {
  return Error(StatusCode::kAborted, "EPOCH_FENCED",
               StrCat("vehicle '", id,
                      "' is handed over to another server; nothing was "
                      "changed, try again"));
}

absl::Status VehicleState::OutOfStep() const {
  return Error(StatusCode::kUnavailable, "STORE_UNAVAILABLE",
               StrCat("vehicle '", id,
                      "' has to be loaded anew, since it and the store "
                      "disagree; try again"));
}

absl::Status VehicleState::Corrupt(const std::string& cause) const {
  return server::Corrupt(StrCat("vehicle '", id, "': ", cause),
                         {{"vehicle", id}});
}

absl::Status VehicleState::Regressed(const std::string& cause,
                                     ErrorMetadata metadata) const {
  metadata.emplace_back("durable_sequence", StrCat(durable_sequence));
  return Error(StatusCode::kDataLoss, "DURABLE_SEQUENCE_REGRESSED",
               StrCat("vehicle '", id, "': ", cause), metadata);
}

absl::Status VehicleState::DataLoss(const ErrorMetadata& metadata) const {
  return Regressed(
      StrCat("a client held an acknowledgement for more than the ",
             durable_sequence,
             " poses that are stored; writes are refused until an operator "
             "accepts the loss (AcceptDataLoss with durable_sequence ",
             durable_sequence, ")"),
      metadata);
}

}  // namespace revisit::server
