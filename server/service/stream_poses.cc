#include "server/service/stream_poses.h"

#include <atomic>
#include <chrono>
#include <cstdint>
#include <deque>
#include <memory>
#include <optional>
#include <random>
#include <string>
#include <utility>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/base/mutex.h"
#include "core/geometry/pose.h"
#include "core/settings.h"
#include "google/protobuf/arena.h"
#include "grpcpp/alarm.h"
#include "server/base/sequences.h"
#include "server/base/status.h"
#include "server/connections/drain.h"
#include "server/conversion/answers.h"
#include "server/conversion/field_violations.h"
#include "server/conversion/names.h"
#include "server/conversion/pose_inspection.h"
#include "server/conversion/poses.h"
#include "server/conversion/vehicle_settings.h"
#include "server/service/call.h"
#include "server/sessions/fleet.h"
#include "server/sessions/vehicle_session.h"
#include "server/telemetry/service_counters.h"

namespace revisit::server {
namespace {

using Request = v1::StreamPosesRequest;
using Response = v1::StreamPosesResponse;

// Memory that an idle stream keeps for its next message. A batch takes more, in
// blocks of up to the second size, and gives them back when it is staged: most
// streams are idle at any time, and the memory that they keep adds up.
constexpr std::size_t kRequestBlockBytes = std::size_t{4} << 10;
constexpr std::size_t kMostRequestBlockBytes = std::size_t{64} << 10;

google::protobuf::ArenaOptions RequestArenaOptions(char* first_block) {
  google::protobuf::ArenaOptions options;
  options.initial_block = first_block;
  options.initial_block_size = kRequestBlockBytes;
  options.max_block_size = kMostRequestBlockBytes;
  return options;
}

// How long the client of a stream that has its age is to wait: there is nothing
// to wait for, since such streams end one by one.
constexpr std::chrono::milliseconds kOldAgeDelay{100};

// The age at which one stream ends.
std::chrono::milliseconds DrawnAge(double limit_seconds) {
  thread_local std::minstd_rand random(std::random_device{}());
  std::uniform_real_distribution<double> share(0.9, 1.0);
  return std::chrono::milliseconds(
      static_cast<std::int64_t>(limit_seconds * 1000.0 * share(random)));
}

absl::Status OldAge() {
  return WithRetryDelay(
      kOldAgeDelay, Error(absl::StatusCode::kUnavailable, "STREAM_AGE",
                          "the stream is as old as this server lets one get; "
                          "reconnect and resume"));
}

// Messages go: read, staged (decoded and taken on by the session), durable (its
// acknowledgement is queued), checked (its candidates are queued), written.
//
// Flow control: the next message is read once the last is staged, for they
// share one request object, as long as the batches that are not durable and the
// responses that are not written come to less than max_batches_in_flight, and
// the batches that are not durable to less than max_bytes_in_flight.
// So the transport's own flow control reaches the client.
//
// A client that sends poses but does not read the candidates of their checks is
// cut off at max_unread_bytes: candidates, unlike acknowledgements, are not
// bounded by the batches in flight.
//
// Ending: whatever ends the stream (half-close, failure, age, drain), batches
// that the session has taken run to their end and their answers are written
// first. Only a stream whose caller is gone skips that, and one whose store is
// out of reach: what was acknowledged by then is written, and what becomes of
// the rest its client learns from whoever has the vehicle when it resumes.
//
// Lifetime: gRPC may destroy its side as soon as OnDone() has run, and sessions
// call back from their own threads at any time. So the stream is held by a
// shared_ptr: `self_`, dropped in OnDone(), and one in every callback given to
// a session. After OnDone() `finished_` is set, and a late callback touches
// only the stream's own members.
//
// Nothing is started after Finish(): that waits until no thread is starting an
// operation.
class PoseStream final : public grpc::ServerBidiReactor<Request, Response>,
                         public std::enable_shared_from_this<PoseStream> {
 public:
  PoseStream(grpc::CallbackServerContext* call, const ServiceContext& context)
      : grpc_context_(call),
        context_(context),
        call_(call, "StreamPoses", context),
        request_block_(new char[kRequestBlockBytes]),
        arena_(RequestArenaOptions(request_block_.get())),
        request_(google::protobuf::Arena::CreateMessage<Request>(&arena_)) {}

  void Start() {
    self_ = shared_from_this();
    call_.WatchCaller([weak = weak_from_this()] {
      if (const auto stream = weak.lock()) stream->Recheck();
    });
    drain_watch_ =
        context_.drain->Watch([weak = weak_from_this()](const Drain::End& end) {
          if (const auto stream = weak.lock()) stream->WindDown(end);
        });
    const MutexLock lock(&mutex_);
    SetFailure(call_.admission());
    if (!failure_) LimitAge();
    Advance();
  }

  void OnReadDone(bool ok) override {
    call_.CountMessage();
    bool first;
    {
      const MutexLock lock(&mutex_);
      reading_ = false;
      if (!ok) OnLastRead();
      if (Ending()) {
        Advance();
        return;
      }
      handling_ = true;
      first = session_ == nullptr;
    }
    if (first) {
      Open();
    } else {
      Append();
    }
  }

  void OnWriteDone(bool ok) override {
    const MutexLock lock(&mutex_);
    writing_ = false;
    if (!ok) call_.MarkGivenUp();
    Advance();
  }

  void OnCancel() override {
    call_.MarkGivenUp();
    const MutexLock lock(&mutex_);
    Advance();
  }

  void OnDone() override {
    context_.drain->Unwatch(drain_watch_);
    call_.Done();
    // May destroy this.
    const std::shared_ptr<PoseStream> self = std::move(self_);
  }

 private:
  // One batch of this stream on its way through the session.
  class Batch final : public AppendSink {
   public:
    // `poses`: their number. `bytes`: memory that the batch takes; `room` is
    // held until it is durable.
    Batch(std::shared_ptr<PoseStream> stream, std::uint64_t poses,
          std::size_t bytes, Permit room)
        : stream_(std::move(stream)),
          poses_(poses),
          bytes_(bytes),
          room_(std::move(room)) {}

    absl::StatusOr<DecodedBatch> Decode(const VehicleConfig& config) override {
      absl::StatusOr<DecodedBatch> batch =
          DecodeBatch(stream_->request_->batch().poses(),
                      stream_->context_.limits.max_batch_poses, config,
                      FieldPath().Field("batch"));
      if (batch.ok()) stream_->Inspect(batch->samples, config, &warnings_);
      return batch;
    }

    void OnStaged(const absl::Status& status) override {
      stream_->OnStaged(status);
    }

    void OnDurable(const absl::StatusOr<Acknowledgement>& result) override {
      // Whoever has the acknowledgement may send as much again.
      room_.reset();
      ServiceCounters* const counts = stream_->context_.counts;
      if (result.ok()) {
        counts->Acknowledged(poses_, result->accepted_poses,
                             std::chrono::steady_clock::now() - start_);
      } else {
        counts->Refused(poses_, result.status());
      }
      stream_->OnDurable(result, bytes_, &warnings_);
    }

    bool wants_candidates() const override { return stream_->send_candidates_; }

    std::string check_flow() const override {
      return stream_->call_.check_flow();
    }

    absl::StatusOr<core::SearchOptions> CheckOptions(
        const VehicleConfig& config) const override {
      return stream_->SearchOptions(config);
    }

    bool ShouldStop() const override {
      return stream_->call_.given_up() || stream_->is_left_;
    }

    void OnCandidates(const VehicleView& view,
                      const absl::StatusOr<core::CandidateSet>& set,
                      std::chrono::nanoseconds duration) override {
      stream_->OnCandidates(view, set, duration);
    }

    void OnOver() override { stream_->OnAppendOver(); }

   private:
    const std::shared_ptr<PoseStream> stream_;
    const std::chrono::steady_clock::time_point start_ =
        std::chrono::steady_clock::now();
    const std::uint64_t poses_;
    const std::size_t bytes_;
    Permit room_;
    PoseInspector::Warnings warnings_;
  };

  // An answer to be written: `other`, or an acknowledgement without warnings if
  // that is null.
  struct Answer {
    Acknowledgement ack;
    std::unique_ptr<Response> other;
    // Bytes of the candidates, if it holds any.
    std::int64_t candidate_bytes = 0;
  };

  static absl::Status OutOfOrder(const std::string& message) {
    return Error(absl::StatusCode::kInvalidArgument, "STREAM_PROTOCOL",
                 message);
  }

  void Open() ABSL_LOCKS_EXCLUDED(mutex_) {
    if (!request_->has_open()) {
      Fail(OutOfOrder("the first message of a stream is `open`"));
      return;
    }
    const v1::StreamPosesOpen& open = request_->open();
    const FieldPath path = FieldPath().Field("open");
    const absl::StatusOr<std::string> id =
        ParseVehicleName(open.vehicle(), path.Field("vehicle"));
    if (!id.ok()) {
      Fail(id.status());
      return;
    }
    if (open.acked_sequence() > kMaxSequence) {
      Fail(InvalidField("INVALID_FIELD", path.Field("acked_sequence"),
                        "got " + std::to_string(open.acked_sequence()) +
                            "; allowed is [0, 9223372036854775807]"));
      return;
    }
    if (absl::Status status =
            CheckUid(open.vehicle_uid(), path.Field("vehicle_uid"));
        !status.ok()) {
      Fail(status);
      return;
    }
    {
      const MutexLock lock(&mutex_);
      absl::Status allowed = call_.ChooseVehicle(*id);
      if (allowed.ok() && open.send_candidates()) {
        allowed = call_.AlsoNeeds(Verb::kRead);
      }
      SetFailure(allowed);
      if (!allowed.ok()) {
        handling_ = false;
        Advance();
        return;
      }
    }
    send_candidates_ = open.send_candidates();
    candidate_options_ = open.candidate_options();
    const std::shared_ptr<VehicleSession> session =
        context_.fleet->Session(*id);
    {
      const MutexLock lock(&mutex_);
      session_ = session;
    }
    session->CheckAcknowledged(
        open.acked_sequence(), open.vehicle_uid(),
        [self = shared_from_this()](const absl::StatusOr<VehicleView>& view) {
          self->OnChecked(view);
        });
  }

  absl::StatusOr<core::SearchOptions> SearchOptions(
      const VehicleConfig& config) const {
    const FieldPath open = FieldPath().Field("open");
    absl::StatusOr<core::SearchOptions> options = DecodeCandidateOptions(
        candidate_options_, config, open.Field("candidate_options"));
    if (options.ok())
      options->max_comparisons = context_.limits.max_search_steps;
    return options;
  }

  void OnChecked(const absl::StatusOr<VehicleView>& view) {
    if (!view.ok()) {
      Fail(view.status());
      return;
    }
    if (absl::Status status = SearchOptions(view->config).status();
        !status.ok()) {
      Fail(status);
      return;
    }
    auto response = std::make_unique<Response>();
    v1::StreamPosesOpened* opened = response->mutable_opened();
    opened->set_durable_sequence(view->durable_sequence);
    opened->set_revision(view->revision);
    opened->set_max_batch_poses(context_.limits.max_batch_poses);
    opened->set_vehicle_uid(view->config.uid);
    const MutexLock lock(&mutex_);
    handling_ = false;
    queue_.push_back({{}, std::move(response)});
    Advance();
  }

  void Append() ABSL_LOCKS_EXCLUDED(mutex_) {
    if (!request_->has_batch()) {
      Fail(OutOfOrder(request_->has_open()
                          ? "`open` came again; it comes once, first"
                          : "a message after `open` is a `batch`"));
      return;
    }
    // The staged batch takes about as much memory as the message.
    const auto bytes = static_cast<std::size_t>(arena_.SpaceUsed());
    absl::StatusOr<Permit> room = call_.AdmitBatch(bytes);
    const auto poses =
        static_cast<std::uint64_t>(request_->batch().poses_size());
    if (!room.ok()) {
      context_.counts->Refused(poses, room.status());
      Fail(room.status());
      return;
    }
    // A session that was found stays as long as this stream.
    VehicleSession* session;
    {
      const MutexLock lock(&mutex_);
      ++in_flight_;
      ++open_appends_;
      bytes_in_flight_ += bytes;
      session = session_.get();
    }
    session->Append(std::make_shared<Batch>(shared_from_this(), poses, bytes,
                                            *std::move(room)));
  }

  // Called while `handling_`.
  void Inspect(const std::vector<core::PoseSample>& samples,
               const VehicleConfig& config, PoseInspector::Warnings* warnings) {
    if (inspection_is_over_) return;
    if (inspector_ == nullptr) {
      inspector_ = std::make_unique<PoseInspector>(config.frame);
    }
    inspector_->Look(samples, warnings);
    inspection_is_over_ = inspector_->done();
    if (inspection_is_over_) inspector_.reset();
  }

  void OnStaged(const absl::Status& status) {
    const MutexLock lock(&mutex_);
    handling_ = false;
    SetFailure(status);
    Advance();
  }

  void OnDurable(const absl::StatusOr<Acknowledgement>& acknowledgement,
                 std::size_t bytes, PoseInspector::Warnings* warnings) {
    const MutexLock lock(&mutex_);
    --in_flight_;
    bytes_in_flight_ -= bytes;
    SetFailure(acknowledgement.status());
    if (acknowledgement.ok() && warnings->empty() &&
        !acknowledgement->has_warnings()) {
      queue_.push_back({*acknowledgement, nullptr});
    } else if (acknowledgement.ok()) {
      auto response = std::make_unique<Response>();
      EncodeAck(*acknowledgement, response->mutable_ack());
      response->mutable_ack()->mutable_warnings()->MergeFrom(*warnings);
      queue_.push_back({{}, std::move(response)});
    }
    Advance();
  }

  void OnCandidates(const VehicleView& view,
                    const absl::StatusOr<core::CandidateSet>& set,
                    std::chrono::nanoseconds duration) {
    call_.Searched(set, duration);
    // Searches stop when the caller is gone, and then nobody waits for them.
    if (call_.given_up()) return;
    auto response = std::make_unique<Response>();
    std::int64_t bytes = 0;
    if (set.ok()) {
      EncodeCandidateSet(view, *set, candidate_options_.include_aligned_path(),
                         duration, response->mutable_candidates());
      bytes = static_cast<std::int64_t>(response->SpaceUsedLong());
    }
    const MutexLock lock(&mutex_);
    SetFailure(set.status());
    const std::int64_t limit = context_.limits.max_unread_bytes;
    if (set.ok() && !slow_) {
      if (unread_bytes_ + bytes <= limit || queue_.empty()) {
        unread_bytes_ += bytes;
        queue_.push_back({{}, std::move(response), bytes});
      } else {
        CutSlowConsumer(view.durable_sequence, limit);
      }
    }
    Advance();
  }

  // Drops the candidates that wait and ends the stream with SLOW_CONSUMER; if
  // the client does not read that in time, the stream is cancelled.
  void CutSlowConsumer(std::uint64_t durable_sequence, std::int64_t limit)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    slow_ = true;
    const std::string durable = std::to_string(durable_sequence);
    SetFailure(Error(
        absl::StatusCode::kResourceExhausted, "SLOW_CONSUMER",
        "the client does not read its candidates: more than " +
            std::to_string(limit) +
            " bytes wait; poses are durable up to sequence " + durable,
        {{"durable_sequence", durable}, {"limit", std::to_string(limit)}}));
    std::deque<Answer> kept;
    for (Answer& answer : queue_) {
      if (answer.candidate_bytes == 0) kept.push_back(std::move(answer));
    }
    queue_.swap(kept);
    const std::chrono::milliseconds grace(static_cast<std::int64_t>(
        context_.limits.slow_consumer_seconds * 1000.0));
    cut_.Set(std::chrono::system_clock::now() + grace,
             [weak = weak_from_this()](bool ok) {
               const auto stream = weak.lock();
               if (ok && stream != nullptr) stream->Cut();
             });
  }

  void Cut() {
    const MutexLock lock(&mutex_);
    // OnCancel() follows.
    if (!finished_) grpc_context_->TryCancel();
  }

  void OnAppendOver() {
    const MutexLock lock(&mutex_);
    --open_appends_;
    Advance();
  }

  // Ends the stream after the last acknowledgement, or without it. The client
  // resends batches that the session has not taken, or that it does not find
  // stored.
  void WindDown(const Drain::End& end) {
    const MutexLock lock(&mutex_);
    if (end.at_once) {
      SetFailure(end.status);
      is_left_ = true;
    } else {
      draining_ = true;
    }
    Advance();
  }

  void LimitAge() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    const double limit = context_.limits.max_stream_age_seconds;
    if (limit <= 0.0) return;
    age_ = std::make_unique<grpc::Alarm>();
    age_->Set(std::chrono::system_clock::now() + DrawnAge(limit),
              [weak = weak_from_this()](bool ok) {
                const auto stream = weak.lock();
                if (ok && stream != nullptr) stream->OnAge();
              });
  }

  // Ends a stream that has its age after the last acknowledgement of batches
  // that the session has taken. One whose client has sent all ends anyway.
  void OnAge() {
    const MutexLock lock(&mutex_);
    if (!half_closed_) SetFailure(OldAge());
    Advance();
  }

  // Ends the stream of a caller who has lost the right to it, after the last
  // acknowledgement of batches that the session has taken.
  void Recheck() {
    const MutexLock lock(&mutex_);
    if (finished_) return;
    SetFailure(call_.Recheck());
    Advance();
  }

  // Ends the message being handled and the stream.
  void Fail(const absl::Status& status) ABSL_LOCKS_EXCLUDED(mutex_) {
    const MutexLock lock(&mutex_);
    handling_ = false;
    SetFailure(status);
    Advance();
  }

  void OnLastRead() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    if (grpc_context_->IsCancelled()) call_.MarkGivenUp();
    half_closed_ = true;
    if (request_->open().vehicle() != kUnread) {
      SetFailure(MalformedMessage());
    } else if (session_ == nullptr) {
      SetFailure(OutOfOrder(
          "the stream ended before its first message, which is `open`"));
    }
  }

  // The first failure counts.
  void SetFailure(const absl::Status& status)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    if (!status.ok() && !failure_) failure_ = status;
  }

  bool Ending() const ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    return half_closed_ || failure_ || draining_ || call_.given_up();
  }

  absl::Status FinalStatus() const ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    // Named as the reason even if the call was cut in the end, since that was
    // not the caller's doing.
    if (slow_) return *failure_;
    if (call_.given_up()) return call_.GivenUpStatus();
    if (failure_) return *failure_;
    return half_closed_ ? absl::OkStatus() : Drain::Refusal();
  }

  // Starts all operations that can be started now. It releases the mutex for
  // that: starting a write may take as long as the system takes to send it, and
  // other threads would wait for the mutex all that time. `starting_` holds
  // Finish() off meanwhile.
  void Advance() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    while (!finished_) {
      if (call_.given_up()) queue_.clear();
      const bool write = !writing_ && !queue_.empty();
      grpc::WriteOptions options;
      if (write) {
        writing_ = true;
        unread_bytes_ -= queue_.front().candidate_bytes;
        Encode(std::move(queue_.front()));
        queue_.pop_front();
        if (!queue_.empty()) options.set_buffer_hint();
      }
      if (Ending() && MayFinish()) {
        finished_ = true;
        Finish(call_.End(FinalStatus()));
        return;
      }
      const bool read = !Ending() && MayRead();
      if (read) {
        reading_ = true;
        // Reset() keeps the first block.
        arena_.Reset();
        request_ = google::protobuf::Arena::CreateMessage<Request>(&arena_);
        request_->mutable_open()->set_vehicle(kUnread);
      }
      if (!write && !read) return;
      ++starting_;
      mutex_.Unlock();
      if (write) StartWrite(&response_, options);
      if (read) StartRead(request_);
      mutex_.Lock();
      --starting_;
    }
  }

  bool MayFinish() const ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    const bool answered = queue_.empty() && open_appends_ == 0 && !handling_;
    return !writing_ && starting_ == 0 &&
           (answered || call_.given_up() || (is_left_ && queue_.empty()));
  }

  bool MayRead() const ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    const auto waiting = static_cast<std::size_t>(in_flight_) + queue_.size() +
                         (writing_ ? 1 : 0);
    const auto most =
        static_cast<std::size_t>(context_.limits.max_batches_in_flight);
    const bool has_room =
        waiting == 0 ||
        (waiting < most &&
         bytes_in_flight_ <
             static_cast<std::size_t>(context_.limits.max_bytes_in_flight));
    return !reading_ && !handling_ && has_room;
  }

  // Makes a response of an answer. Acknowledgements, which are many, reuse the
  // memory of the one before.
  void Encode(Answer answer) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    if (answer.other != nullptr) {
      response_ = *std::move(answer.other);
    } else {
      EncodeAck(answer.ack, response_.mutable_ack());
    }
  }

  // Not to be used after OnDone().
  grpc::CallbackServerContext* const grpc_context_;
  const ServiceContext context_;
  Call call_;
  Drain::WatchId drain_watch_ = -1;
  std::shared_ptr<PoseStream> self_;
  // Whether the stream ends without the answers to what is under way.
  std::atomic<bool> is_left_{false};

  // Written by Open() only, before the session hears of the stream.
  bool send_candidates_ = false;
  v1::CandidateOptions candidate_options_;

  // Belong to gRPC while `reading_`, to the session while `handling_`.
  const std::unique_ptr<char[]> request_block_;
  google::protobuf::Arena arena_;
  Request* request_;
  // Belong to the session while `handling_`.
  std::unique_ptr<PoseInspector> inspector_;
  bool inspection_is_over_ = false;
  // Belongs to gRPC while `writing_`.
  Response response_;

  Mutex mutex_;
  std::shared_ptr<VehicleSession> session_ ABSL_GUARDED_BY(mutex_);
  std::deque<Answer> queue_ ABSL_GUARDED_BY(mutex_);
  // Bytes of the candidates among the queued answers.
  std::int64_t unread_bytes_ ABSL_GUARDED_BY(mutex_) = 0;
  // Whether the client was found not to read its candidates.
  bool slow_ ABSL_GUARDED_BY(mutex_) = false;
  grpc::Alarm cut_ ABSL_GUARDED_BY(mutex_);
  // Null if streams may get any age.
  std::unique_ptr<grpc::Alarm> age_ ABSL_GUARDED_BY(mutex_);
  bool reading_ ABSL_GUARDED_BY(mutex_) = false;
  bool handling_ ABSL_GUARDED_BY(mutex_) = false;
  bool writing_ ABSL_GUARDED_BY(mutex_) = false;
  bool half_closed_ ABSL_GUARDED_BY(mutex_) = false;
  bool draining_ ABSL_GUARDED_BY(mutex_) = false;
  bool finished_ ABSL_GUARDED_BY(mutex_) = false;
  // Number of threads that are starting an operation.
  int starting_ ABSL_GUARDED_BY(mutex_) = 0;
  std::optional<absl::Status> failure_ ABSL_GUARDED_BY(mutex_);
  // Number of batches that are not durable.
  int in_flight_ ABSL_GUARDED_BY(mutex_) = 0;
  std::size_t bytes_in_flight_ ABSL_GUARDED_BY(mutex_) = 0;
  // Number of batches for which an answer may still come.
  int open_appends_ ABSL_GUARDED_BY(mutex_) = 0;
};

}  // namespace

grpc::ServerBidiReactor<Request, Response>* StartPoseStream(
    grpc::CallbackServerContext* call, const ServiceContext& context) {
  const auto stream = std::make_shared<PoseStream>(call, context);
  stream->Start();
  return stream.get();
}

}  // namespace revisit::server
