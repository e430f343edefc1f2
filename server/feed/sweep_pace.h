// When a thread that goes through many things once a period rests between them.
//
// A thousand things that take some microseconds each are a burst of more than
// ten milliseconds, for which whoever else needs that processor waits. So after
// each kBurst of work the thread rests for kRests times as long as it worked,
// until the period is over: behind its time, it rests no more.
//
// Thread-compatible.
#ifndef REVISIT_SERVER_FEED_SWEEP_PACE_H_
#define REVISIT_SERVER_FEED_SWEEP_PACE_H_

#include <algorithm>
#include <chrono>

namespace revisit::server {

class SweepPace {
 public:
  using Nanoseconds = std::chrono::nanoseconds;

  static constexpr Nanoseconds kBurst = std::chrono::microseconds(500);
  static constexpr int kRests = 4;

  // `now`, here and below, never goes back.
  SweepPace(Nanoseconds period, Nanoseconds now)
      : end_(now + period), worked_from_(now) {}

  // How long to rest before the next thing; 0 in most cases. The thread works
  // on when that is over.
  Nanoseconds RestBefore(Nanoseconds now) {
    const Nanoseconds worked = now - worked_from_;
    if (worked < kBurst) return Nanoseconds(0);
    const Nanoseconds rest =
        std::clamp(end_ - now, Nanoseconds(0), kRests * worked);
    worked_from_ = now + rest;
    return rest;
  }

 private:
  const Nanoseconds end_;
  Nanoseconds worked_from_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_FEED_SWEEP_PACE_H_
