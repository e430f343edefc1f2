#include "server/sessions/vehicle_queue.h"

namespace revisit::server {
namespace {

bool IsRead(Turn turn) {
  return turn == Turn::kRead || turn == Turn::kSearch ||
         turn == Turn::kReadStored;
}

}  // namespace

VehicleQueue::VehicleQueue(VehicleState* vehicle,
                           const AppendsInFlight* appends, const Lanes& lanes)
    : vehicle_(vehicle), appends_(appends), strand_(Strand::Create(lanes)) {}

void VehicleQueue::Submit(Operation operation) {
  Post([this, operation = std::move(operation)]() mutable {
    Add(std::move(operation));
  });
}

void VehicleQueue::SubmitLong(Operation operation) {
  PostLong([this, operation = std::move(operation)]() mutable {
    Add(std::move(operation));
  });
}

void VehicleQueue::SubmitSearch(Operation operation) {
  const std::string flow = operation.flow;
  PostSearch(flow, [this, operation = std::move(operation)]() mutable {
    Add(std::move(operation));
  });
}

void VehicleQueue::Add(Operation operation) {
  const bool is_known =
      static_cast<bool>(vehicle_->loaded) || vehicle_->gone_status();
  if (IsRead(operation.turn) && is_known && !MustWait(operation.turn)) {
    Start(operation);
    return;
  }
  PushBack(std::move(operation));
  Pump();
}

void VehicleQueue::PushBack(Operation operation) {
  waiting_.push_back(std::move(operation));
}

void VehicleQueue::PushFront(Operation operation) {
  waiting_.push_front(std::move(operation));
}

void VehicleQueue::PumpLater() {
  Post([this] { Pump(); });
}

void VehicleQueue::Pump() {
  if (pumping_) return;
  pumping_ = true;
  while (!waiting_.empty() && MayStart(waiting_.front().turn)) {
    Operation operation = std::move(waiting_.front());
    waiting_.pop_front();
    if (operation.turn == Turn::kReadStored && !vehicle_->gone_status()) {
      SubmitLong(std::move(operation));
      continue;
    }
    if (operation.turn == Turn::kSearch && !vehicle_->gone_status()) {
      SubmitSearch(std::move(operation));
      continue;
    }
    Start(operation);
  }
  pumping_ = false;
}

void VehicleQueue::Start(const Operation& operation) {
  operation.run(vehicle_->gone_status() ? *vehicle_->gone_status()
                                        : CheckMemory(operation.turn));
}

bool VehicleQueue::MayAppendHere() const {
  const bool needs_no_store =
      !vehicle_->gone_status() && !vehicle_->in_doubt() &&
      vehicle_->storage->CheckOwned(vehicle_->head.key()).ok();
  return waiting_.empty() && needs_no_store && MayStart(Turn::kAppend);
}

void VehicleQueue::Release(const std::function<void()>& then) {
  held_ = false;
  pumping_ = true;
  then();
  pumping_ = false;
  Pump();
}

bool VehicleQueue::MayStart(Turn turn) const {
  if (vehicle_->gone_status()) return true;
  if (held_) return false;
  switch (turn) {
    case Turn::kRead:
    case Turn::kSearch:
    case Turn::kReadStored:
      return true;
    case Turn::kAppend:
      return !appends_->failing();
    case Turn::kAlone:
      return !appends_->failing() && appends_->idle();
  }
  return false;
}

bool VehicleQueue::MustWait(Turn turn) const {
  if (vehicle_->gone_status()) return false;
  switch (store_lead_) {
    case StoreLead::kNone:
      return false;
    case StoreLead::kPoses:
      return turn == Turn::kReadStored;
    case StoreLead::kVehicle:
      return true;
  }
  return false;
}

// Nothing else runs on the strand between this and the operation, so an answer
// from memory is as of the moment of the check.
absl::Status VehicleQueue::CheckMemory(Turn turn) {
  const absl::Status owned =
      vehicle_->storage->CheckOwned(vehicle_->head.key());
  // Nobody else may have had the vehicle, as where a server took longer to
  // reach the store than its ownership lasted: then memory is as good as
  // before.
  const bool must_take = absl::IsAborted(owned);
  if (!owned.ok() && !must_take) return owned;
  if (must_take) vehicle_->Doubt();
  const bool must_check = must_take || !IsRead(turn);
  if (!vehicle_->in_doubt() || !must_check) return absl::OkStatus();
  if (!appends_->idle()) return owned;
  return vehicle_->CheckAgainstStore();
}

}  // namespace revisit::server
