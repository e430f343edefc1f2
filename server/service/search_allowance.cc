#include "server/service/search_allowance.h"

#include <algorithm>
#include <utility>

#include "absl/status/statusor.h"

namespace revisit::server {
namespace {

// The remaining time of callers without a deadline, short enough to be added to
// other times.
constexpr std::chrono::hours kEndless{24};

}  // namespace

void SearchAllowance::Enter(const std::string& quota_key,
                            std::optional<double> steps_per_second) {
  quota_key_ = quota_key;
  steps_per_second_ = steps_per_second;
}

void SearchAllowance::ChooseVehicle(const std::string& id) {
  const MutexLock lock(&mutex_);
  vehicle_ = id;
}

absl::Status SearchAllowance::TakeRoom() {
  const auto now = std::chrono::system_clock::now();
  const auto latest = std::min(deadline_, now + kEndless);
  if (absl::Status status = CheckSteps(); !status.ok()) return status;
  const MutexLock lock(&mutex_);
  absl::StatusOr<Permit> room =
      admission_->Search(vehicle_, quota_key_, latest - now);
  if (!room.ok()) return room.status();
  if (!given_back_) room_ = *std::move(room);
  return absl::OkStatus();
}

void SearchAllowance::GiveBack() {
  const MutexLock lock(&mutex_);
  given_back_ = true;
  room_.reset();
}

absl::Status SearchAllowance::CheckSteps() const {
  if (!steps_per_second_) return absl::OkStatus();
  return admission_->CheckSteps(quota_key_, *steps_per_second_);
}

absl::Status SearchAllowance::TooManySteps() const {
  const MutexLock lock(&mutex_);
  return admission_->TooManySteps(vehicle_);
}

void SearchAllowance::Took(std::chrono::steady_clock::duration duration,
                           std::int64_t steps) const {
  admission_->SearchTook(quota_key_, duration);
  if (!steps_per_second_) return;
  admission_->UseSteps(quota_key_, *steps_per_second_, steps);
}

}  // namespace revisit::server
