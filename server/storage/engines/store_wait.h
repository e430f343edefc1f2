// Waiting for a database that is not there yet, or ends sessions as it comes.
#ifndef REVISIT_SERVER_STORAGE_ENGINES_STORE_WAIT_H_
#define REVISIT_SERVER_STORAGE_ENGINES_STORE_WAIT_H_

#include <chrono>
#include <functional>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"

namespace revisit::server {

// The time that the opening of a store may be tried again. For one thread.
class StoreWait {
 public:
  // The time begins now. `warn` is told why the store cannot be opened, each
  // reason once as long as it lasts.
  StoreWait(std::chrono::milliseconds longest,
            std::function<void(const std::string&)> warn);

  // Calls `attempt()`, which answers a StatusOr and has no effect if it fails,
  // until it answers anything but UNAVAILABLE or the time is over. What passes
  // by itself is UNAVAILABLE: a database that cannot be reached, starts,
  // recovers, takes no writes, or has ended the session. So is, since nothing
  // tells them apart, an address or a password that is wrong.
  template <typename Attempt>
  auto Until(const Attempt& attempt) -> decltype(attempt()) {
    for (;;) {
      auto answer = attempt();
      if (!absl::IsUnavailable(answer.status()) || !Pause(answer.status())) {
        return answer;
      }
    }
  }

 private:
  using Clock = std::chrono::steady_clock;

  // Whether there is time for another attempt; waits before it.
  bool Pause(const absl::Status& failure);

  const Clock::time_point end_;
  const std::function<void(const std::string&)> warn_;
  std::chrono::milliseconds pause_;
  std::string told_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_ENGINES_STORE_WAIT_H_
