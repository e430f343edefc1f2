// How much one call may search: its room among searches, its caller's budget of
// steps.
#ifndef REVISIT_SERVER_SERVICE_SEARCH_ALLOWANCE_H_
#define REVISIT_SERVER_SERVICE_SEARCH_ALLOWANCE_H_

#include <chrono>
#include <cstdint>
#include <optional>
#include <string>

#include "absl/status/status.h"
#include "core/base/mutex.h"
#include "server/connections/admission.h"

namespace revisit::server {

// Refusals are those of Admission. Thread-safe, after Enter().
class SearchAllowance {
 public:
  // `deadline`: that of the call. Admission outlives this.
  SearchAllowance(Admission* admission,
                  std::chrono::system_clock::time_point deadline)
      : admission_(admission), deadline_(deadline) {}

  SearchAllowance(const SearchAllowance&) = delete;
  SearchAllowance& operator=(const SearchAllowance&) = delete;

  // Whose searches these are: the key of the caller's limits, and the budget of
  // steps that its tenant has, if any (Caller). Call first.
  void Enter(const std::string& quota_key,
             std::optional<double> steps_per_second);

  // Names the vehicle that is searched.
  void ChooseVehicle(const std::string& id);

  // Takes room for a search until GiveBack(), or for no time if that has come:
  // a search that waits is then dropped when its turn comes, while the room of
  // its call still bounds how many such there are. After ChooseVehicle().
  absl::Status TakeRoom();
  void GiveBack();

  // OK while the tenant has not used up its budget of steps; SEARCH_QUOTA.
  absl::Status CheckSteps() const;
  // The refusal of a search that has more to search first than one may. After
  // ChooseVehicle().
  absl::Status TooManySteps() const;
  // Notes how long a turn of a search took, without its waits, and how many
  // steps it was to make.
  void Took(std::chrono::steady_clock::duration duration,
            std::int64_t steps) const;

  // Whose searches these are, and the checks of a stream, among those who share
  // the threads of searches.
  std::string search_flow() const { return "calls/" + quota_key_; }
  std::string check_flow() const { return "checks/" + quota_key_; }

 private:
  Admission* const admission_;
  const std::chrono::system_clock::time_point deadline_;
  std::string quota_key_;
  std::optional<double> steps_per_second_;

  mutable Mutex mutex_;
  std::string vehicle_ ABSL_GUARDED_BY(mutex_);
  // Null unless a search has room.
  Permit room_ ABSL_GUARDED_BY(mutex_);
  bool given_back_ ABSL_GUARDED_BY(mutex_) = false;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SERVICE_SEARCH_ALLOWANCE_H_
