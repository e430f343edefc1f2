// How many vehicles a server asks others for at a time.
//
// Where callers come to know other servers than before, they may ask one server
// for thousands of vehicles in a moment. All would be handed over within
// seconds, and then wait in its queue of loads, while the owners before, who
// have them in memory, could have gone on serving them. So a server asks for no
// more vehicles than it lately took in one window: whatever its loads cost, the
// last of those that were asked for waits for about as long.
//
// Thread-compatible.
#ifndef REVISIT_SERVER_STORAGE_POSTGRES_ASK_PACING_H_
#define REVISIT_SERVER_STORAGE_POSTGRES_ASK_PACING_H_

#include <algorithm>
#include <chrono>
#include <cstddef>
#include <iterator>
#include <unordered_map>

#include "server/storage/records.h"

namespace revisit::server {

class AskPacing {
 public:
  // Vehicles that are asked for together in any case.
  static constexpr std::size_t kFewest = 64;

  // One that was asked for and has not come after `patience` counts no more.
  AskPacing(std::chrono::nanoseconds window, std::chrono::nanoseconds patience)
      : window_(window), patience_(patience) {}

  // Whether to ask for the vehicle; counts it if so. True for one that was
  // asked for already. `now` never goes back.
  bool MayAsk(VehicleKey key, std::chrono::nanoseconds now) {
    MoveWindow(now);
    if (asked_.count(key) > 0) return true;
    if (asked_.size() >= std::max({kFewest, taken_before_, taken_})) {
      return false;
    }
    asked_.emplace(key, now);
    return true;
  }

  // A vehicle was taken.
  void Taken(VehicleKey key, std::chrono::nanoseconds now) {
    MoveWindow(now);
    ++taken_;
    asked_.erase(key);
  }

 private:
  void MoveWindow(std::chrono::nanoseconds now) {
    if (now - window_start_ < window_) return;
    taken_before_ = now - window_start_ < 2 * window_ ? taken_ : 0;
    taken_ = 0;
    window_start_ = now;
    for (auto i = asked_.begin(); i != asked_.end();) {
      i = now - i->second >= patience_ ? asked_.erase(i) : std::next(i);
    }
  }

  const std::chrono::nanoseconds window_;
  const std::chrono::nanoseconds patience_;
  // When each vehicle that has not come was asked for.
  std::unordered_map<VehicleKey, std::chrono::nanoseconds> asked_;
  std::chrono::nanoseconds window_start_{0};
  // Vehicles taken in the window, and in the one before it.
  std::size_t taken_ = 0;
  std::size_t taken_before_ = 0;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_POSTGRES_ASK_PACING_H_
