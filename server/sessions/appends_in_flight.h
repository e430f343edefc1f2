// How far the appends of one vehicle have come, as far as others wait for them.
#ifndef REVISIT_SERVER_SESSIONS_APPENDS_IN_FLIGHT_H_
#define REVISIT_SERVER_SESSIONS_APPENDS_IN_FLIGHT_H_

#include <cstddef>
#include <optional>

#include "absl/status/status.h"

namespace revisit::server {

// An append is in flight from its being taken on, or refused, until it is
// answered. Appends writes this and the queue reads it, so that neither needs
// the other. Belongs to the strand.
class AppendsInFlight {
 public:
  // Whether there is none, the checks of those that landed included.
  bool idle() const { return count_ == 0 && !checking_; }
  // Whether one has failed: those behind it fail too, and no other may start.
  bool failing() const { return failure_.has_value(); }
  // Why the first of them failed that did. REQUIRES: failing().
  const absl::Status& failure() const { return *failure_; }
  // Whether the checks of an append that has landed are still to be run.
  // Appends behind it land after them.
  bool checking() const { return checking_; }

  void Add() { ++count_; }
  void Remove() { --count_; }
  void Fail(const absl::Status& status) { failure_ = status; }
  void Recover() { failure_.reset(); }
  void set_checking(bool checking) { checking_ = checking; }

 private:
  std::size_t count_ = 0;
  std::optional<absl::Status> failure_;
  bool checking_ = false;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SESSIONS_APPENDS_IN_FLIGHT_H_
