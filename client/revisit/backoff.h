// How long to wait before trying again.
#ifndef REVISIT_CLIENT_REVISIT_BACKOFF_H_
#define REVISIT_CLIENT_REVISIT_BACKOFF_H_

#include <chrono>
#include <cstdint>
#include <optional>
#include <random>

namespace revisit::client {

struct BackoffOptions {
  std::chrono::milliseconds initial{100};
  std::chrono::milliseconds max{10'000};
  // Each wait is this many times the one before. At least 1.
  double multiplier = 2.0;
  // A wait is drawn evenly from [(1 - jitter) * wait, wait], so that many
  // clients do not come back at once. Range [0, 1].
  double jitter = 0.5;
};

// A seed that differs from call to call and from process to process.
std::uint64_t BackoffSeed();

// Exponential back-off with jitter. Thread-compatible.
class Backoff {
 public:
  Backoff(const BackoffOptions& options, std::uint64_t seed);

  // The next wait: at least `at_least`, where the server asked for it; the
  // jitter then comes on top. Never more than a day, so that it can be added to
  // any time.
  std::chrono::nanoseconds Next(
      std::optional<std::chrono::nanoseconds> at_least);

  // Starts over, after success.
  void Reset();

 private:
  const BackoffOptions options_;
  std::mt19937_64 random_;
  double wait_seconds_;
};

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_REVISIT_BACKOFF_H_
