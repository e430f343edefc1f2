#include "server/sessions/vehicle_state.h"

#include "absl/strings/str_cat.h"
#include "server/storage/storage.h"

namespace revisit::server {

using absl::StatusCode;
using absl::StrCat;

absl::Status ShuttingDown() {
  return Error(StatusCode::kUnavailable, "SERVER_DRAINING",
               "the server is shutting down");
}

VehicleView VehicleState::View() const {
  return VehicleView{id,
                     head.config(),
                     *loaded,
                     head.key(),
                     head.durable_sequence(),
                     head.revision(),
                     static_cast<std::int64_t>(pairs.loop_closures().size()),
                     &pairs.loop_closures(),
                     &pairs.rejections(),
                     head.damage(),
                     head.config_is_known(),
                     loaded.search(),
                     loaded.nodes_id(),
                     head.checks()};
}

void VehicleState::NoteSearched() {
  if (loaded) loaded.NoteSearched();
}

void VehicleState::Report() const {
  if (census == nullptr) return;
  using State = VehicleCensus::State;
  census->Found(head.key(), !head.damage().ok()       ? State::kDamaged
                            : head.config().data_loss ? State::kDataLoss
                                                      : State::kActive);
}

void VehicleState::Leave(const absl::Status& status) {
  gone_status_ = status;
  is_gone_.store(true);
}

void VehicleState::NoteFailedWrite(const absl::Status& status) {
  in_doubt_ = true;
  if (absl::IsAborted(status) && !gone_status_) Leave(status);
}

absl::Status VehicleState::CheckAgainstStore() {
  const absl::StatusOr<VehicleRecord> record = storage->TakeVehicle(id);
  if (!record.ok()) {
    if (absl::IsNotFound(record.status())) Leave(VehicleNotFound(id));
    if (ReasonOf(record.status()) == "NOT_OWNER") Leave(record.status());
    return record.status();
  }
  if (!Agrees(*record)) {
    Leave(OutOfStep());
    return *gone_status_;
  }
  head.set_epoch(record->epoch);
  // A write of checks changes nothing that memory holds, so that either outcome
  // agrees with it.
  head.set_checks(record->checks);
  in_doubt_ = false;
  return absl::OkStatus();
}

// Where this server had the vehicle under the epoch that is known here, nobody
// else has had it since.
bool VehicleState::Agrees(const VehicleRecord& record) const {
  const auto count = [this](PairKind kind) {
    return static_cast<std::int64_t>(pairs.Of(kind).size());
  };
  return record.key == head.key() && record.previous_epoch == head.epoch() &&
         record.durable_sequence == head.durable_sequence() &&
         record.revision == head.revision() &&
         record.loop_closure_count == count(PairKind::kLoopClosure) &&
         record.rejected_candidate_count ==
             count(PairKind::kRejectedCandidate) &&
         record.damage.ok() && head.damage().ok();
}

absl::Status VehicleState::Writable() const {
  if (!head.damage().ok()) return head.damage();
  return head.config().data_loss ? DataLoss({}) : absl::OkStatus();
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

absl::Status VehicleState::Regressed(const std::string& cause,
                                     ErrorMetadata metadata) const {
  metadata.emplace_back("durable_sequence", StrCat(head.durable_sequence()));
  return Error(StatusCode::kDataLoss, "DURABLE_SEQUENCE_REGRESSED",
               StrCat("vehicle '", id, "': ", cause), metadata);
}

absl::Status VehicleState::DataLoss(const ErrorMetadata& metadata) const {
  return Regressed(
      StrCat("a client held an acknowledgement for more than the ",
             head.durable_sequence(),
             " poses that are stored; writes are refused until an operator "
             "accepts the loss (AcceptDataLoss with durable_sequence ",
             head.durable_sequence(), ")"),
      metadata);
}

}  // namespace revisit::server
