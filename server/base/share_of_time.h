// Keeps work that is done again and again to a small share of the time.
//
// Thread-compatible.
#ifndef REVISIT_SERVER_BASE_SHARE_OF_TIME_H_
#define REVISIT_SERVER_BASE_SHARE_OF_TIME_H_

#include <chrono>

namespace revisit::server {

class ShareOfTime {
 public:
  using Nanoseconds = std::chrono::nanoseconds;

  // Times of rest to one of work.
  static constexpr int kRests = 100;

  // `now`, here and below, never goes back.
  bool MayBegin(Nanoseconds now) const { return now >= next_; }
  void Ended(Nanoseconds begin, Nanoseconds now) {
    next_ = now + kRests * (now - begin);
  }

 private:
  Nanoseconds next_{0};
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_BASE_SHARE_OF_TIME_H_
