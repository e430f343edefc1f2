#include "client/revisit/backoff.h"

#include <algorithm>
#include <atomic>

namespace revisit::client {
namespace {

constexpr double kLongestSeconds = 86'400.0;

// Without nanoseconds on the way, which hold 292 years only.
double Seconds(std::chrono::duration<double> duration) {
  return duration.count();
}

}  // namespace

std::uint64_t BackoffSeed() {
  static std::atomic<std::uint64_t> calls{0};
  const auto now = std::chrono::steady_clock::now().time_since_epoch();
  return static_cast<std::uint64_t>(now.count()) ^
         reinterpret_cast<std::uintptr_t>(&calls) ^
         (calls.fetch_add(1) * 0x9E3779B97F4A7C15u);
}

Backoff::Backoff(const BackoffOptions& options, std::uint64_t seed)
    : options_(options),
      random_(seed),
      wait_seconds_(Seconds(options.initial)) {}

std::chrono::nanoseconds Backoff::Next(
    std::optional<std::chrono::nanoseconds> at_least) {
  const double longest = std::min(wait_seconds_, Seconds(options_.max));
  const double shortest = (1.0 - options_.jitter) * longest;
  std::uniform_real_distribution<double> draw(0.0, 1.0);
  const double own = shortest + (longest - shortest) * draw(random_);
  wait_seconds_ = std::min(wait_seconds_ * std::max(options_.multiplier, 1.0),
                           Seconds(options_.max));
  const double asked = at_least.has_value() ? Seconds(*at_least) : 0.0;
  const double wait = asked <= own ? own : asked + (own - shortest);
  return std::chrono::duration_cast<std::chrono::nanoseconds>(
      std::chrono::duration<double>(std::min(wait, kLongestSeconds)));
}

void Backoff::Reset() { wait_seconds_ = Seconds(options_.initial); }

}  // namespace revisit::client
