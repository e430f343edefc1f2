#include "server/service/watch_candidates.h"

#include <chrono>
#include <cstdint>
#include <deque>
#include <memory>
#include <optional>
#include <string>
#include <utility>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/base/mutex.h"
#include "revisit/v1/pose_graph_service.pb.h"
#include "server/base/status.h"
#include "server/conversion/stored_checks_codec.h"
#include "server/feed/event_feed.h"
#include "server/fields/field_violations.h"
#include "server/service/message_bytes.h"
#include "server/service/streaming_call.h"
#include "server/sessions/executor.h"
#include "server/storage/storage.h"

namespace revisit::server {
namespace {

// Events that are taken from memory, or read from the store, at a time.
constexpr int kEventsAtOnce = 64;
constexpr int kEventsPerRead = 200;
// After so long without a message, or so many events that were not wanted, a
// beat moves the caller's cursor on.
constexpr std::chrono::seconds kBeatPeriod{10};
constexpr int kMostUnwanted = 1000;

// Tells events one after the other: the next one is looked for when the last
// has gone out, so that a watch holds little but its place.
//
// A caller that takes nothing for slow_consumer_seconds gets no more: its call
// ends with SLOW_CONSUMER once it has read what was written, and is cut off if
// it does not for as long again.
class CandidateWatch final : public WritingCall<CandidateWatch> {
 public:
  // The bytes of the request live until Start() returns.
  CandidateWatch(grpc::CallbackServerContext* call,
                 const ServiceContext& context, const grpc::ByteBuffer* request)
      : WritingCall<CandidateWatch>(call, "WatchCandidates", context),
        context_(context),
        request_bytes_(request),
        patience_(static_cast<std::int64_t>(
            context.limits.slow_consumer_seconds * 1000.0)) {}

 private:
  using Clock = std::chrono::steady_clock;

  void OnStart() override {
    const absl::Status status = Begin();
    if (!status.ok()) End(status);
  }

  void OnDrain(const Drain::End& end)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) override {
    EndOnceWritten(end.status);
  }

  void OnRightsLost(const absl::Status& reason)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) override {
    EndOnceWritten(reason);
  }

  void OnRightsKept() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) override {
    caller_ = rights().Now();
  }

  void OnGivenUp() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) override {
    EndOnceWritten(GivenUpStatus());
  }

  void OnEnd(const absl::Status&)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) override {
    if (watch_) context_.feed->Unwatch(*watch_);
    read_.clear();
  }

  void OnWritten() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) override {
    Continue();
  }

  absl::Status Begin() {
    v1::WatchCandidatesRequest request;
    if (absl::Status status = ParseMessage(request_bytes_, &request);
        !status.ok()) {
      return status;
    }
    absl::StatusOr<CandidateFilter> filter =
        DecodeFilter(request.filter(), FieldPath().Field("filter"));
    if (!filter.ok()) return filter.status();
    std::optional<EventPosition> after;
    if (!request.cursor().empty()) {
      const absl::StatusOr<EventPosition> parsed =
          ParseCursor(request.cursor(), FieldPath().Field("cursor"));
      if (!parsed.ok()) return parsed.status();
      after = *parsed;
    }
    const MutexLock lock(&mutex_);
    if (ended_) return absl::OkStatus();
    caller_ = rights().Now();
    for (const std::string& id : filter->vehicles) {
      if (!caller_->May(Verb::kRead, id)) return VehicleNotFound(id);
    }
    filter_ = *std::move(filter);
    WatchRights();
    fetching_ = true;
    context_.executor->Post(
        [self = shared_from_this(), after] { self->FindBeginning(after); });
    return absl::OkStatus();
  }

  void FindBeginning(const std::optional<EventPosition>& after)
      ABSL_LOCKS_EXCLUDED(mutex_) {
    absl::StatusOr<EventPosition> begin = EventPosition();
    if (after) {
      // The store has to know the cursor.
      const auto read = context_.feed->Read(*after, 1);
      begin = read.ok() ? absl::StatusOr<EventPosition>(*after) : read.status();
    } else {
      begin = context_.storage->LastEvent();
    }
    const MutexLock lock(&mutex_);
    fetching_ = false;
    if (ended_) return;
    if (!begin.ok()) {
      EndLocked(begin.status());
      return;
    }
    position_ = *begin;
    watch_ = context_.feed->Watch([weak = weak_from_this()] {
      if (const auto self = weak.lock()) self->Look();
    });
    WriteBeat();
  }

  // There may be new events, or time has passed.
  void Look() ABSL_LOCKS_EXCLUDED(mutex_) {
    const MutexLock lock(&mutex_);
    if (ended_) return;
    if (writing_ && Clock::now() - write_start_ > patience_) {
      if (!last_status_) {
        EndOnceWritten(SlowConsumer());
        write_start_ = Clock::now();
      } else {
        // OnCancel() and OnWriteDone() follow.
        grpc_context_->TryCancel();
      }
      return;
    }
    Continue();
  }

  void EndOnceWritten(const absl::Status& status)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    if (!last_status_) last_status_ = status;
    if (!writing_) EndLocked(*last_status_);
  }

  void Continue() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    if (writing_ || fetching_) return;
    if (last_status_) {
      EndLocked(*last_status_);
      return;
    }
    if (given_up()) {
      EndLocked(GivenUpStatus());
      return;
    }
    while (true) {
      if (read_.empty() && !TakeNewest()) return;
      const FeedEventPtr event = std::move(read_.front());
      read_.pop_front();
      position_ = event->position;
      if (IsWanted(*event)) {
        v1::WatchCandidatesResponse message = event->message;
        Tell(&message);
        return;
      }
      if (++unwanted_ >= kMostUnwanted) {
        WriteBeat();
        return;
      }
    }
  }

  // Takes the next events from memory. Returns false if there are none, or the
  // store has to be read for them.
  bool TakeNewest() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    while (true) {
      const std::optional<NewEvents> newest = context_.feed->Newest(
          position_, filter_.vehicles,
          [&](const FeedEvent& event)
              ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) { return IsWanted(event); },
          kEventsAtOnce);
      if (!newest) {
        Fetch();
        return false;
      }
      if (!newest->events.empty()) {
        read_.assign(newest->events.begin(), newest->events.end());
        return true;
      }
      position_ = newest->up_to;
      unwanted_ += newest->passed;
      if (unwanted_ >= kMostUnwanted ||
          Clock::now() - write_start_ >= kBeatPeriod) {
        WriteBeat();
        return false;
      }
      if (newest->passed == 0) return false;
    }
  }

  bool IsWanted(const FeedEvent& event) const
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    if (event.vehicle_id.empty()) return false;
    if (!filter_.vehicles.empty() &&
        filter_.vehicles.count(event.vehicle_id) == 0) {
      return false;
    }
    if (!caller_->May(Verb::kRead, event.vehicle_id)) return false;
    if (!event.matched_vehicle_id.empty() &&
        !caller_->May(Verb::kRead, event.matched_vehicle_id)) {
      return false;
    }
    if (!event.message.has_candidate()) return true;
    const v1::CandidateEvent& candidate = event.message.candidate();
    return Matches(filter_, candidate.candidate(), candidate.evidence());
  }

  // Reads events that are no longer in memory.
  void Fetch() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    fetching_ = true;
    context_.executor->Post([self = shared_from_this(), after = position_] {
      self->TakeRead(self->context_.feed->Read(after, kEventsPerRead));
    });
  }

  void TakeRead(const absl::StatusOr<std::vector<FeedEventPtr>>& events)
      ABSL_LOCKS_EXCLUDED(mutex_) {
    const MutexLock lock(&mutex_);
    fetching_ = false;
    if (ended_) return;
    if (!events.ok()) {
      EndOnceWritten(events.status());
      return;
    }
    read_.assign(events->begin(), events->end());
    // Otherwise the feed's next look goes on: memory does not cover the end
    // yet.
    if (!read_.empty()) Continue();
  }

  void WriteBeat() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    v1::WatchCandidatesResponse message;
    message.mutable_beat();
    Tell(&message);
  }

  void Tell(v1::WatchCandidatesResponse* message)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    message->set_cursor(MakeCursor(position_));
    unwanted_ = 0;
    writing_ = true;
    write_start_ = Clock::now();
    Write(*message);
  }

  absl::Status SlowConsumer() const {
    const std::string limit = std::to_string(patience_.count());
    return Error(absl::StatusCode::kResourceExhausted, "SLOW_CONSUMER",
                 "the client took nothing of the watch for " + limit +
                     " milliseconds, which is the limit; watch again from the "
                     "last cursor",
                 {{"limit", limit}});
  }

  const ServiceContext context_;
  const grpc::ByteBuffer* const request_bytes_;
  const std::chrono::milliseconds patience_;

  CandidateFilter filter_ ABSL_GUARDED_BY(mutex_);
  // With the present rights.
  std::shared_ptr<const Caller> caller_ ABSL_GUARDED_BY(mutex_);
  std::optional<EventFeed::WatchId> watch_ ABSL_GUARDED_BY(mutex_);
  // Up to which events were told or are not wanted.
  EventPosition position_ ABSL_GUARDED_BY(mutex_);
  // The next events.
  std::deque<FeedEventPtr> read_ ABSL_GUARDED_BY(mutex_);
  // Whether the store is being read.
  bool fetching_ ABSL_GUARDED_BY(mutex_) = false;
  std::int64_t unwanted_ ABSL_GUARDED_BY(mutex_) = 0;
  Clock::time_point write_start_ ABSL_GUARDED_BY(mutex_);
  // The status that the call ends with, as soon as no message is being written.
  std::optional<absl::Status> last_status_ ABSL_GUARDED_BY(mutex_);
};

}  // namespace

grpc::ServerWriteReactor<grpc::ByteBuffer>* StartWatch(
    grpc::CallbackServerContext* call, const ServiceContext& context,
    const grpc::ByteBuffer* request) {
  const auto watch = std::make_shared<CandidateWatch>(call, context, request);
  watch->Start();
  return watch.get();
}

}  // namespace revisit::server
