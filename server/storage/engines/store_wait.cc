#include "server/storage/engines/store_wait.h"

#include <algorithm>
#include <thread>
#include <utility>

namespace revisit::server {
namespace {

constexpr std::chrono::milliseconds kFirstPause{100};
constexpr std::chrono::milliseconds kLongestPause{2'000};

}  // namespace

StoreWait::StoreWait(std::chrono::milliseconds longest,
                     std::function<void(const std::string&)> warn)
    : end_(Clock::now() + longest),
      warn_(std::move(warn)),
      pause_(kFirstPause) {}

bool StoreWait::Pause(const absl::Status& failure) {
  const auto left = end_ - Clock::now();
  if (left <= Clock::duration::zero()) return false;
  std::string why(failure.message());
  if (why != told_) {
    warn_("waiting for the store: " + why);
    told_ = std::move(why);
  }
  std::this_thread::sleep_for(std::min<Clock::duration>(pause_, left));
  pause_ = std::min(2 * pause_, kLongestPause);
  return true;
}

}  // namespace revisit::server
