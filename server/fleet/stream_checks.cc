#include "server/fleet/stream_checks.h"

#include <utility>

#include "core/drive/drive.h"
#include "core/drive/node_index.h"
#include "server/fleet/group_searches.h"

namespace revisit::server {
namespace {

// Nothing if the pose is there no more.
std::optional<core::NodeIndex> NodeOf(const VehicleView& view,
                                      std::uint64_t sequence) {
  const bool is_there =
      sequence <= view.durable_sequence && CheckKept(view, sequence).ok();
  if (!is_there) return std::nullopt;
  return view.drive.graph().NodeAtOrBefore(sequence);
}

}  // namespace

void StreamChecks::Open(std::function<void(const absl::Status&)> then) {
  const MutexLock lock(&mutex_);
  if (given_up_) return;
  // It calls back from another thread, so that the lock may be held.
  searches_->Prepare(scope_, [then = std::move(then)](
                                 const absl::StatusOr<GroupScope>& ready) {
    then(ready.status());
  });
  scope_.allow_partial = true;
}

void StreamChecks::SetMayRead(
    std::function<bool(const std::string&)> may_read) {
  const MutexLock lock(&mutex_);
  scope_.may_read = std::move(may_read);
}

void StreamChecks::Add(const std::vector<std::uint64_t>& sequences) {
  const MutexLock lock(&mutex_);
  if (given_up_) return;
  for (const std::uint64_t sequence : sequences) {
    if (std::exchange(last_added_, sequence) == sequence) continue;
    waiting_.push_back(sequence);
  }
  if (!is_checking_ && !waiting_.empty()) Begin();
}

void StreamChecks::GiveUp() {
  const MutexLock lock(&mutex_);
  given_up_ = true;
  waiting_.clear();
}

bool StreamChecks::idle() const {
  const MutexLock lock(&mutex_);
  return !is_checking_;
}

void StreamChecks::Begin() {
  is_checking_ = true;
  const std::uint64_t sequence = waiting_.front();
  waiting_.pop_front();
  // It calls back from another thread, so that the lock may be held.
  searches_->Prepare(scope_, [self = shared_from_this(),
                              sequence](absl::StatusOr<GroupScope> ready) {
    self->Search(sequence, std::move(ready));
  });
}

void StreamChecks::Search(std::uint64_t sequence,
                          absl::StatusOr<GroupScope> ready) {
  if (given_up_ || !ready.ok()) {
    End(ready.status());
    return;
  }
  const auto check = std::make_shared<Check>();
  check->sequence = sequence;
  check->scope = *std::move(ready);
  session_->Search(order_->flow, [self = shared_from_this(), check](
                                     const absl::StatusOr<VehicleView>& view) {
    return self->TakeTurn(check.get(), view);
  });
}

bool StreamChecks::TakeTurn(Check* check,
                            const absl::StatusOr<VehicleView>& view) {
  std::optional<absl::Status> end;
  if (given_up_) {
    end = absl::OkStatus();
  } else if (!view.ok()) {
    end = view.status();
  } else {
    end = Answer(check, *view);
  }
  if (!end) return false;
  End(*end);
  return true;
}

std::optional<absl::Status> StreamChecks::Answer(Check* check,
                                                 const VehicleView& view) {
  if (!view.damage.ok()) return view.damage;
  const auto options = order_->options(view.config);
  if (!options.ok()) return options.status();
  const auto node = NodeOf(view, check->sequence);
  if (!node) return absl::OkStatus();
  auto found = check->turns.Take(
      view, *node, *options, &check->scope.scope,
      [this] { return session_->is_wanted(); },
      [this] { return given_up_.load(); });
  if (!found) return std::nullopt;
  if (const auto observer = observer_.lock()) {
    observer->OnFound(view, *std::move(found), check->turns.duration(),
                      check->scope);
  }
  return absl::OkStatus();
}

void StreamChecks::End(const absl::Status& status) {
  bool is_idle = false;
  {
    const MutexLock lock(&mutex_);
    if (!status.ok()) given_up_ = true;
    if (given_up_) waiting_.clear();
    is_checking_ = false;
    is_idle = waiting_.empty();
    if (!is_idle) Begin();
  }
  if (!is_idle) return;
  if (const auto observer = observer_.lock()) observer->OnIdle(status);
}

}  // namespace revisit::server
