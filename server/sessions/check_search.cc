#include "server/sessions/check_search.h"

#include "absl/status/statusor.h"

namespace revisit::server {
namespace {

// After a scope was not ready, so that each append does not ask for it.
constexpr std::chrono::seconds kTryAgainAfter{1};

}  // namespace

void CheckSearch::Restart() {
  RestartTurns();
  // The vehicle's own history needs no scope, so it is ready for good.
  if (scope_ == nullptr && ready_for_ == std::string()) return;
  ready_for_.reset();
  scope_.reset();
}

void CheckSearch::RestartTurns() { turns_ = CheckTurns(); }

std::string CheckSearch::Group() const {
  return policy_.scopes == nullptr ? std::string()
                                   : vehicle_->head.config().check_group;
}

bool CheckSearch::MayPost() const { return Clock::now() >= not_before_; }

void CheckSearch::Post(std::function<void()> turn,
                       std::function<void()> not_ready) {
  if (const std::string group = Group(); ready_for_ != group) {
    Restart();
    if (!group.empty()) {
      Prepare(group, std::move(turn), std::move(not_ready));
      return;
    }
    ready_for_ = group;
  }
  queue_->PostSearch(policy_.flow, std::move(turn));
}

void CheckSearch::Prepare(const std::string& group, std::function<void()> turn,
                          std::function<void()> not_ready) {
  policy_.scopes->Prepare({group, vehicle_->id, vehicle_->head.key()},
                          queue_->AnswerOnStrand<CheckScopePtr>(
                              [this, group, turn = std::move(turn),
                               not_ready = std::move(not_ready)](
                                  absl::StatusOr<CheckScopePtr> scope) {
                                if (!scope.ok()) {
                                  not_before_ = Clock::now() + kTryAgainAfter;
                                  not_ready();
                                  return;
                                }
                                ready_for_ = group;
                                scope_ = *std::move(scope);
                                queue_->PostSearch(policy_.flow, turn);
                              }));
}

std::optional<core::CandidateSet> CheckSearch::TakeTurn(core::NodeIndex node) {
  core::SearchOptions options = vehicle_->head.config().drive.search;
  options.max_comparisons = policy_.max_steps;
  return turns_.Take(vehicle_->View(), node, options,
                     scope_ == nullptr ? nullptr : &scope_->search,
                     [this] { return queue_->IsWanted(); });
}

}  // namespace revisit::server
