#include "server/sessions/vehicle_queue.h"

#include "server/sessions/appends.h"

namespace revisit::server {
namespace {

bool IsRead(Turn turn) {
  return turn == Turn::kRead || turn == Turn::kReadStored;
}

}  // namespace

VehicleQueue::VehicleQueue(VehicleState* vehicle, const Appends* appends,
                           const Lanes& lanes)
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
  PostSearch([this, operation = std::move(operation)]() mutable {
    Add(std::move(operation));
  });
}

void VehicleQueue::Add(Operation operation) {
  const bool is_known = vehicle_->engine != nullptr || vehicle_->gone_status;
  if (IsRead(operation.turn) && is_known && !MustWait(operation.turn)) {
    operation.run(vehicle_->gone_status.value_or(absl::OkStatus()));
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
    if (operation.turn == Turn::kReadStored && !vehicle_->gone_status) {
      SubmitLong(std::move(operation));
      continue;
    }
    absl::Status status = vehicle_->gone_status.value_or(absl::OkStatus());
    if (status.ok() && !IsRead(operation.turn)) status = ClearDoubt();
    operation.run(status);
  }
  pumping_ = false;
}

bool VehicleQueue::MayAppendHere() const {
  const bool needs_no_store = !vehicle_->gone_status && !vehicle_->in_doubt;
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
  if (vehicle_->gone_status) return true;
  if (held_) return false;
  switch (turn) {
    case Turn::kRead:
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
  if (vehicle_->gone_status) return false;
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

absl::Status VehicleQueue::ClearDoubt() {
  if (!vehicle_->in_doubt || !appends_->idle()) return absl::OkStatus();
  return vehicle_->CheckAgainstStore();
}

}  // namespace revisit::server
