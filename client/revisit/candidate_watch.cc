#include "client/revisit/candidate_watch.h"

#include <algorithm>
#include <cstdint>
#include <optional>
#include <unordered_map>
#include <utility>

#include "absl/status/statusor.h"
#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "client/revisit/printable_text.h"
#include "client/revisit/status.h"
#include "client/revisit/status_from_grpc.h"
#include "core/base/mutex.h"
#include "grpcpp/client_context.h"
#include "grpcpp/support/client_callback.h"
#include "revisit/v1/pose_graph_service.grpc.pb.h"

namespace revisit::client {
namespace {

using Clock = std::chrono::steady_clock;

constexpr char kEveryVehicle[] = "vehicles/-";
// The most that the server answers on a page.
constexpr int kPageChecks = 1000;
// For a page of a list.
constexpr std::chrono::seconds kPageDeadline{30};

bool IsLost(const absl::Status& status) {
  if (!absl::IsOutOfRange(status)) return false;
  const std::string reason = DetailsOf(status).reason;
  return reason == "CURSOR_TOO_OLD" || reason == "CURSOR_UNKNOWN";
}

bool WorthAnotherAttempt(const absl::Status& status, bool was_answered) {
  const ErrorDetails details = DetailsOf(status);
  // Whoever renews tokens may be late.
  if (was_answered && absl::IsUnauthenticated(status) &&
      details.reason == "TOKEN_EXPIRED") {
    return true;
  }
  return absl::IsUnavailable(status) || absl::IsAborted(status) ||
         absl::IsDeadlineExceeded(status) || IsCut(status) ||
         (absl::IsResourceExhausted(status) &&
          (details.retry_delay.has_value() ||
           details.reason == "SLOW_CONSUMER"));
}

// By what a list of checks is ordered.
struct Place {
  std::string vehicle;
  std::uint64_t sequence = 0;

  explicit Place(const std::string& name) {
    constexpr char kBelow[] = "/checks/";
    const std::size_t at = name.rfind(kBelow);
    vehicle = name.substr(0, at);
    if (at != std::string::npos &&
        !absl::SimpleAtoi(name.substr(at + sizeof(kBelow) - 1), &sequence)) {
      sequence = 0;
    }
  }

  bool IsAfter(const Place& other) const {
    return vehicle != other.vehicle ? vehicle > other.vehicle
                                    : sequence > other.sequence;
  }
};

// Null if none has this rank. Ranks begin with 1; 0 stands for none.
const v1::Candidate* OfRank(const v1::CandidateSet& set, int rank) {
  if (rank == 0) return nullptr;
  for (const v1::Candidate& found : set.candidates()) {
    if (found.rank() == rank) return &found;
  }
  return nullptr;
}

// The event that would have told what a list says of a candidate.
WatchedEvent Listed(const v1::Check& check,
                    const v1::CheckCandidate& candidate) {
  WatchedEvent event;
  event.resynchronised = true;
  v1::CandidateEvent* const told = event.message.mutable_candidate();
  told->set_check(check.name());
  told->set_vehicle_uid(check.vehicle_uid());
  told->set_number(candidate.event_number());
  *told->mutable_candidate() = candidate;
  if (const v1::Candidate* const evidence = EvidenceOf(check, candidate)) {
    *told->mutable_evidence() = *evidence;
  }
  told->set_revision(candidate.latest_rank() > 0
                         ? check.latest().revision()
                         : check.candidates().revision());
  *told->mutable_event_time() = candidate.update_time();
  return event;
}

}  // namespace

// The caller's thread, in Run(), makes the calls one after the other and calls
// back; gRPC's threads bring the messages in.
struct CandidateWatch::Rep {
  Rep(const std::shared_ptr<grpc::ChannelInterface>& channel,
      const CandidateWatchOptions& watch_options,
      const CandidateWatchCallbacks& watch_callbacks)
      : stub(v1::PoseGraphService::NewStub(channel)),
        options(watch_options),
        callbacks(watch_callbacks),
        cursor(watch_options.cursor) {}

  // The state of a listing of checks that is read page by page.
  struct Listing {
    v1::ListChecksRequest request;
    // The watch cursor of the first page.
    std::string cursor;
    std::optional<Place> last;
  };

  // How an attempt ended: `own` if by a callback or Cancel(), so that there is
  // no other one.
  struct End {
    absl::Status status;
    bool own = false;
  };

  absl::Status Run();
  void BeginListing(bool open_only);
  // Reads the list to its end. OK if all of it was worked off.
  End RunListing();
  absl::StatusOr<v1::ListChecksResponse> ReadPage();
  // OK if all candidates of the page were worked off.
  absl::Status WorkOff(const v1::ListChecksResponse& page);
  // The list is in order, so it ends some time.
  absl::Status Follow(const v1::Check& check);
  // Holds a connection until it is over. Never OK.
  End RunConnection();
  // Works off a message. OK if the watch goes on.
  absl::Status Take(const v1::WatchCandidatesResponse& message);
  absl::Status Tell(const v1::WatchCandidatesResponse& message);
  absl::Status MoveTo(const std::string& behind);
  // Returns whether the watch goes on.
  bool Wait(std::chrono::nanoseconds wait);

  bool IsCancelled() {
    const MutexLock lock(&mutex);
    return cancelled;
  }
  static absl::Status Cancelled() {
    return absl::CancelledError("the watch was cancelled");
  }

  // Constant after construction.
  const std::unique_ptr<v1::PoseGraphService::Stub> stub;
  const CandidateWatchOptions options;
  const CandidateWatchCallbacks callbacks;

  // Members that only the thread of Run() uses.
  std::optional<Listing> listing;
  // By vehicle_uid: the number of the last event.
  std::unordered_map<std::string, std::uint64_t> last_numbers;
  // Whether a server has answered anything but an error.
  bool was_answered = false;
  // Whether this attempt, or one since the last wait, brought the watch on.
  bool progressed = false;

  mutable Mutex mutex;
  CondVar changed;
  std::string cursor ABSL_GUARDED_BY(mutex);
  bool cancelled ABSL_GUARDED_BY(mutex) = false;
  // The call for a page, while there is one.
  grpc::ClientContext* page_context ABSL_GUARDED_BY(mutex) = nullptr;

  // The connection of the moment.
  bool has_message ABSL_GUARDED_BY(mutex) = false;
  bool read_closed ABSL_GUARDED_BY(mutex) = false;
  bool done ABSL_GUARDED_BY(mutex) = false;
  grpc::Status connection_status ABSL_GUARDED_BY(mutex);
};

class CandidateWatch::Connection final
    : public grpc::ClientReadReactor<v1::WatchCandidatesResponse> {
 public:
  explicit Connection(Rep* rep) : rep_(rep) {}

  grpc::ClientContext* context() { return &context_; }
  v1::WatchCandidatesRequest* request() { return &request_; }
  // The message that was read last.
  const v1::WatchCandidatesResponse& message() const { return message_; }

  void Start() {
    rep_->stub->async()->WatchCandidates(&context_, &request_, this);
    // Reads are started from outside the reactions.
    AddHold();
    StartRead(&message_);
    StartCall();
  }

  void ReadNext() { StartRead(&message_); }

  void OnReadDone(bool ok) override {
    const MutexLock lock(&rep_->mutex);
    (ok ? rep_->has_message : rep_->read_closed) = true;
    rep_->changed.NotifyAll();
  }

  void OnDone(const grpc::Status& status) override {
    const MutexLock lock(&rep_->mutex);
    rep_->connection_status = status;
    rep_->done = true;
    rep_->changed.NotifyAll();
  }

 private:
  Rep* const rep_;
  grpc::ClientContext context_;
  v1::WatchCandidatesRequest request_;
  v1::WatchCandidatesResponse message_;
};

absl::Status CandidateWatch::Rep::MoveTo(const std::string& behind) {
  // An empty one would begin the next connection now, and leave a gap.
  if (behind.empty()) return absl::OkStatus();
  {
    const MutexLock lock(&mutex);
    if (behind == cursor) return absl::OkStatus();
    cursor = behind;
  }
  return callbacks.moved ? callbacks.moved(behind) : absl::OkStatus();
}

absl::Status CandidateWatch::Rep::Tell(
    const v1::WatchCandidatesResponse& message) {
  if (!message.has_candidate() && !message.has_vehicle_deleted()) {
    return absl::OkStatus();
  }
  const bool deleted = message.has_vehicle_deleted();
  const std::string& uid = deleted ? message.vehicle_deleted().vehicle_uid()
                                   : message.candidate().vehicle_uid();
  const std::uint64_t number = deleted ? message.vehicle_deleted().number()
                                       : message.candidate().number();
  const auto last = last_numbers.find(uid);
  if (last != last_numbers.end() && number <= last->second) {
    return absl::OkStatus();
  }
  if (absl::Status worked_off = callbacks.event({message, false});
      !worked_off.ok()) {
    return worked_off;
  }
  last_numbers[uid] = number;
  return absl::OkStatus();
}

absl::Status CandidateWatch::Rep::Take(
    const v1::WatchCandidatesResponse& message) {
  was_answered = progressed = true;
  if (absl::Status told = Tell(message); !told.ok()) return told;
  return MoveTo(message.cursor());
}

CandidateWatch::Rep::End CandidateWatch::Rep::RunConnection() {
  Connection connection(this);
  *connection.request()->mutable_filter() = options.filter;
  MutexLock lock(&mutex);
  if (cancelled) return {Cancelled(), true};
  has_message = read_closed = done = false;
  connection.request()->set_cursor(cursor);
  lock.Unlock();
  connection.Start();
  lock.Lock();
  std::optional<End> own_end;
  Clock::time_point quiet_since = Clock::now();
  while (!own_end.has_value() && !read_closed) {
    if (cancelled) {
      own_end = {Cancelled(), true};
    } else if (has_message) {
      has_message = false;
      lock.Unlock();
      if (absl::Status taken = Take(connection.message()); !taken.ok()) {
        own_end = {taken, true};
      } else {
        connection.ReadNext();
      }
      lock.Lock();
      quiet_since = Clock::now();
    } else if (const auto deadline = quiet_since + options.answer_timeout;
               Clock::now() < deadline) {
      changed.WaitUntil(&mutex, deadline);
    } else {
      own_end = {absl::UnavailableError(absl::StrCat(
                     "no answer for ", options.answer_timeout.count(), " ms")),
                 false};
    }
  }
  lock.Unlock();
  // Not under the lock: gRPC may run reactions before it returns.
  if (own_end.has_value()) connection.context()->TryCancel();
  connection.RemoveHold();
  lock.Lock();
  while (!done) changed.Wait(&mutex);
  if (own_end.has_value()) return *own_end;
  if (!connection_status.ok()) return {FromGrpc(connection_status)};
  return {absl::UnavailableError("the server ended the watch")};
}

void CandidateWatch::Rep::BeginListing(bool open_only) {
  listing.emplace();
  listing->request.set_parent(kEveryVehicle);
  listing->request.set_page_size(kPageChecks);
  *listing->request.mutable_filter() = options.filter;
  if (open_only && options.filter.states().empty()) {
    listing->request.mutable_filter()->add_states(v1::CANDIDATE_STATE_OPEN);
  }
}

absl::StatusOr<v1::ListChecksResponse> CandidateWatch::Rep::ReadPage() {
  grpc::ClientContext context;
  context.set_deadline(std::chrono::system_clock::now() + kPageDeadline);
  {
    const MutexLock lock(&mutex);
    if (cancelled) return Cancelled();
    page_context = &context;
  }
  v1::ListChecksResponse page;
  const absl::Status read =
      FromGrpc(stub->ListChecks(&context, listing->request, &page));
  {
    const MutexLock lock(&mutex);
    page_context = nullptr;
  }
  if (!read.ok()) return read;
  return page;
}

absl::Status CandidateWatch::Rep::Follow(const v1::Check& check) {
  Place place(check.name());
  if (listing->last.has_value() && !place.IsAfter(*listing->last)) {
    return absl::InternalError(absl::StrCat(
        "the server's list does not go on: ", Printable(check.name()),
        " comes after check ", listing->last->sequence, " of ",
        Printable(listing->last->vehicle)));
  }
  listing->last = std::move(place);
  return absl::OkStatus();
}

absl::Status CandidateWatch::Rep::WorkOff(const v1::ListChecksResponse& page) {
  for (const v1::Check& check : page.checks()) {
    if (absl::Status in_order = Follow(check); !in_order.ok()) return in_order;
    for (const v1::CheckCandidate& candidate : check.states()) {
      if (!Matches(listing->request.filter(), check, candidate)) continue;
      if (IsCancelled()) return Cancelled();
      if (absl::Status worked_off = callbacks.event(Listed(check, candidate));
          !worked_off.ok()) {
        return worked_off;
      }
    }
  }
  return absl::OkStatus();
}

CandidateWatch::Rep::End CandidateWatch::Rep::RunListing() {
  for (;;) {
    const auto page = ReadPage();
    if (IsCancelled()) return {Cancelled(), true};
    if (!page.ok()) return {page.status()};
    was_answered = progressed = true;
    if (listing->request.page_token().empty()) {
      listing->cursor = page->watch_cursor();
    }
    if (absl::Status worked_off = WorkOff(*page); !worked_off.ok()) {
      return {worked_off, true};
    }
    if (page->next_page_token().empty()) break;
    listing->request.set_page_token(page->next_page_token());
  }
  const std::string behind = listing->cursor;
  listing.reset();
  if (behind.empty()) {
    return {
        absl::InternalError("the server's list of checks has no watch_cursor"),
        true};
  }
  if (absl::Status moved = MoveTo(behind); !moved.ok()) return {moved, true};
  return {};
}

bool CandidateWatch::Rep::Wait(std::chrono::nanoseconds wait) {
  const auto end = Clock::now() + wait;
  MutexLock lock(&mutex);
  while (!cancelled && Clock::now() < end) changed.WaitUntil(&mutex, end);
  return !cancelled;
}

absl::Status CandidateWatch::Rep::Run() {
  Backoff backoff(options.backoff, BackoffSeed());
  if (options.cursor.empty() && options.begin_with_list) BeginListing(true);
  // Whether nothing has come since a list was read: where the cursor of that
  // list is lost as well, the next one would not do better at once.
  bool just_listed = false;
  for (;;) {
    End end;
    if (listing.has_value()) {
      end = RunListing();
      if (end.status.ok()) {
        just_listed = true;
        progressed = false;
        continue;
      }
    } else {
      end = RunConnection();
    }
    if (end.own) return end.status;
    if (progressed) {
      just_listed = false;
      backoff.Reset();
    }
    progressed = false;
    if (!listing.has_value() && IsLost(end.status)) {
      if (callbacks.resynchronised) callbacks.resynchronised(end.status);
      last_numbers.clear();
      BeginListing(false);
      if (!just_listed) continue;
    } else if (!WorthAnotherAttempt(end.status, was_answered)) {
      return end.status;
    }
    const auto wait = backoff.Next(DetailsOf(end.status).retry_delay);
    if (callbacks.disconnected) callbacks.disconnected(end.status, wait);
    if (!Wait(wait)) return Cancelled();
  }
}

CandidateWatch::CandidateWatch(
    const std::shared_ptr<grpc::ChannelInterface>& channel,
    const CandidateWatchOptions& options,
    const CandidateWatchCallbacks& callbacks)
    : rep_(std::make_unique<Rep>(channel, options, callbacks)) {}

CandidateWatch::~CandidateWatch() = default;

absl::Status CandidateWatch::Run() { return rep_->Run(); }

void CandidateWatch::Cancel() {
  const MutexLock lock(&rep_->mutex);
  rep_->cancelled = true;
  if (rep_->page_context != nullptr) rep_->page_context->TryCancel();
  rep_->changed.NotifyAll();
}

std::string CandidateWatch::cursor() const {
  const MutexLock lock(&rep_->mutex);
  return rep_->cursor;
}

const v1::Candidate* EvidenceOf(const v1::Check& check,
                                const v1::CheckCandidate& candidate) {
  return candidate.latest_rank() > 0
             ? OfRank(check.latest(), candidate.latest_rank())
             : FirstEvidenceOf(check, candidate);
}

const v1::Candidate* FirstEvidenceOf(const v1::Check& check,
                                     const v1::CheckCandidate& candidate) {
  return OfRank(check.candidates(), candidate.rank());
}

bool Matches(const v1::CandidateFilter& filter, const v1::Check& check,
             const v1::CheckCandidate& candidate) {
  const auto is_one_of = [](const auto& allowed, const auto& value) {
    return allowed.empty() ||
           std::find(allowed.begin(), allowed.end(), value) != allowed.end();
  };
  const v1::Candidate* const evidence = EvidenceOf(check, candidate);
  return is_one_of(filter.vehicles(), Place(check.name()).vehicle) &&
         is_one_of(filter.states(), candidate.state()) &&
         is_one_of(filter.verdicts(), evidence == nullptr
                                          ? v1::VERDICT_UNSPECIFIED
                                          : evidence->verdict()) &&
         (evidence == nullptr ? 0.0 : evidence->probability()) >=
             filter.least_probability() &&
         candidate.value_square_meters() >= filter.least_value_square_meters();
}

}  // namespace revisit::client
