// A watch of stored candidates that survives the connection.
//
// Every change of a candidate comes as an event, one at a time, with the cursor
// behind it. The cursor moves on once the callback has returned OK, so an event
// whose work was not done comes again, to this watch or to the next one that
// begins at the cursor: nothing is missed, whatever dies.
//
//   CandidateWatchOptions options;
//   options.cursor = ...;  // what `moved` was told last, by an earlier watch
//   CandidateWatch watch(channel, options, {work_off, keep_cursor});
//   absl::Status why = watch.Run();  // until Cancel(), or an error
//
// Order and repetition: events of a vehicle come in the order of their numbers.
// One that the server tells again, as after a break, is dropped: within a
// watch, no vehicle_uid has a number that is not greater than the one before. A
// watch that begins at the cursor of an earlier one may be told again what that
// one was just working at.
//
// Reconnecting: after UNAVAILABLE, ABORTED, DEADLINE_EXCEEDED,
// RESOURCE_EXHAUSTED with a RetryInfo or for not reading (SLOW_CONSUMER), a cut
// on the way (IsCut() in status.h), an end that was not asked for, or silence
// longer than answer_timeout, with exponential back-off that starts over after
// a message. There is no end to it: a server may be away for long. So it is
// with a token that has expired, once the server has answered. Any other status
// ends the watch.
//
// Resynchronising: where the server cannot go on from the cursor (OUT_OF_RANGE
// with CURSOR_TOO_OLD or CURSOR_UNKNOWN), events are lost. The watch says so
// once, lists the stored checks, tells their candidates that match the filter
// as events that are marked, and goes on from the cursor of the list. What
// changed while the list was read may come in both, since nothing in a list
// tells the number of the last event. Numbers that were told before count no
// longer: a store that was restored from a backup gives them once more.
//
// Memory: one message, a page of the list while it is read, and some 100 bytes
// for each vehicle of which something was told.
#ifndef REVISIT_CLIENT_REVISIT_CANDIDATE_WATCH_H_
#define REVISIT_CLIENT_REVISIT_CANDIDATE_WATCH_H_

#include <chrono>
#include <functional>
#include <memory>
#include <string>

#include "absl/status/status.h"
#include "client/revisit/backoff.h"
#include "revisit/v1/pose_graph_service.pb.h"

namespace grpc {
class ChannelInterface;
}

namespace revisit::client {

struct CandidateWatchOptions {
  // Candidates to tell of.
  v1::CandidateFilter filter;
  // Where to go on: cursor() of an earlier watch, or
  // ListChecksResponse.watch_cursor. If empty, the watch begins now.
  std::string cursor;
  // Without a cursor, tells what there is already before what changes: as when
  // it resynchronises, but only what is OPEN, unless the filter names states.
  bool begin_with_list = false;
  BackoffOptions backoff;
  // A connection on which nothing has come for so long is given up for a new
  // one; the server says something every 10 s or so. Time spent in callbacks
  // does not count.
  std::chrono::milliseconds answer_timeout{60'000};
};

struct WatchedEvent {
  // Has a candidate or a vehicle that was deleted, and the cursor behind it.
  v1::WatchCandidatesResponse message;
  // It is of a list of checks. The candidate is as it was stored then:
  // `message.cursor` is empty, `number` is that of the last event about it, and
  // `event_time` is when it came into its state.
  bool resynchronised = false;
};

// Called one at a time, on the thread of Run(), without locks held. They may
// call Cancel() and cursor(). All but `event` may be empty.
struct CandidateWatchCallbacks {
  // Works off an event. A status but OK ends the watch, which returns it, and
  // the cursor stays before the event.
  std::function<absl::Status(const WatchedEvent&)> event;
  // The cursor has moved: behind an event that was worked off, with a beat of
  // the server, or to that of a list of which all was worked off. Whoever keeps
  // it keeps it here, or with the work of the event in one step. A status but
  // OK ends the watch, which returns it.
  std::function<absl::Status(const std::string& cursor)> moved;
  // Events are lost, for this reason. What is stored is told next.
  std::function<void(const absl::Status&)> resynchronised;
  // The connection was lost and will be made again after the wait.
  std::function<void(const absl::Status&, std::chrono::nanoseconds wait)>
      disconnected;
};

class CandidateWatch {
 public:
  // Does not connect yet. The channel may be shared.
  CandidateWatch(const std::shared_ptr<grpc::ChannelInterface>& channel,
                 const CandidateWatchOptions& options,
                 const CandidateWatchCallbacks& callbacks);
  // REQUIRES: no Run() goes on.
  ~CandidateWatch();

  CandidateWatch(const CandidateWatch&) = delete;
  CandidateWatch& operator=(const CandidateWatch&) = delete;

  // Watches until Cancel(), which makes it CANCELLED, an error of the server
  // after which another attempt makes no sense, or a callback's. Call it once.
  absl::Status Run();

  // Ends Run() once the callback that is called at the moment has returned, and
  // counts if that says OK. Does not wait. Thread-safe.
  void Cancel();

  // Behind all that was worked off. Thread-safe.
  std::string cursor() const;

 private:
  class Connection;
  struct Rep;
  const std::unique_ptr<Rep> rep_;
};

// Returns what the last search that found CANDIDATE found of it, with its
// alignment and gate: of CHECK's latest search where that found it, or else of
// its first one. Null where neither did, as of a candidate that only a search
// between these found.
const v1::Candidate* EvidenceOf(const v1::Check& check,
                                const v1::CheckCandidate& candidate);

// Returns what the first search of CHECK found of CANDIDATE; null where only a
// later one found it.
const v1::Candidate* FirstEvidenceOf(const v1::Check& check,
                                     const v1::CheckCandidate& candidate);

// Whether a candidate of a check matches, as the server sees it: a list of
// checks has all candidates of each. One without a probability counts as
// improbable. Its probability and its verdict are those of EvidenceOf().
bool Matches(const v1::CandidateFilter& filter, const v1::Check& check,
             const v1::CheckCandidate& candidate);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_REVISIT_CANDIDATE_WATCH_H_
