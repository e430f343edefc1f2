#include "server/service/call_room.h"

#include <utility>

#include "server/base/status.h"

namespace revisit::server {

absl::Status CallRoom::Enter(const std::string& quota_key) {
  const MutexLock lock(&mutex_);
  quota_key_ = quota_key;
  if (!NeedsStore(rule_)) return absl::OkStatus();
  return Hold(rule_->streams ? admission_->Stream(quota_key)
                             : admission_->Call(quota_key));
}

absl::Status CallRoom::ChooseVehicle(const std::string& id) {
  const MutexLock lock(&mutex_);
  vehicle_ = id;
  if (rule_ == nullptr) return absl::OkStatus();
  return Hold(rule_->streams ? admission_->StreamOf(id)
                             : admission_->CallOf(id));
}

absl::Status CallRoom::ChooseGroup(const std::string& id) {
  const MutexLock lock(&mutex_);
  if (rule_ == nullptr) return absl::OkStatus();
  return Hold(admission_->CallOfGroup(id));
}

absl::Status CallRoom::TakeRebuild(std::uint64_t poses) {
  const MutexLock lock(&mutex_);
  return Hold(
      admission_->Rebuild(quota_key_, static_cast<std::int64_t>(poses)));
}

absl::Status CallRoom::TakeBatch(std::size_t bytes) {
  const MutexLock lock(&mutex_);
  return Hold(admission_->Queue(vehicle_, static_cast<std::int64_t>(bytes)));
}

absl::StatusOr<Permit> CallRoom::AdmitBatch(std::size_t bytes) const {
  return admission_->Queue(vehicle(), static_cast<std::int64_t>(bytes));
}

absl::StatusOr<Permit> CallRoom::AdmitDraft(std::int64_t bytes) const {
  return admission_->Draft(vehicle(), bytes);
}

absl::StatusOr<Permit> CallRoom::AdmitExport(std::size_t bytes) const {
  return admission_->Export(vehicle(), static_cast<std::int64_t>(bytes));
}

void CallRoom::GiveBack() {
  const MutexLock lock(&mutex_);
  given_back_ = true;
  permits_.clear();
}

absl::Status CallRoom::Hold(absl::StatusOr<Permit> permit) {
  if (!permit.ok()) return permit.status();
  if (given_back_) return CallerGaveUp();
  permits_.push_back(*std::move(permit));
  return absl::OkStatus();
}

std::string CallRoom::vehicle() const {
  const MutexLock lock(&mutex_);
  return vehicle_;
}

}  // namespace revisit::server
