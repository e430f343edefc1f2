#include "server/service/stream_poses.h"

#include <atomic>
#include <chrono>
#include <cstdint>
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
#include "server/conversion/names.h"
#include "server/conversion/pose_inspection.h"
#include "server/conversion/poses.h"
#include "server/conversion/vehicle_settings.h"
#include "server/fields/field_violations.h"
#include "server/fleet/stream_checks.h"
#include "server/service/answer_queue.h"
#include "server/service/group_search.h"
#include "server/service/streaming_call.h"
#include "server/sessions/fleet.h"
#include "server/sessions/vehicle_session.h"
#include "server/telemetry/service_counters.h"

namespace revisit::server {
namespace {

using Request = v1::StreamPosesRequest;
using Response = v1::StreamPosesResponse;

constexpr FieldPath kOpenPath = FieldPath().Field("open");
constexpr FieldPath kOptionsPath = kOpenPath.Field("candidate_options");

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
// Checks in a group are no part of that way: StreamChecks makes them beside it,
// in their order.
//
// Ending: whatever ends the stream (half-close, failure, age, drain), batches
// that the session has taken run to their end and their answers are written
// first. Only checks in a group that fail, or whose caller has lost a right,
// leave those behind them without an answer. Only a stream whose caller is gone
// skips that, and one whose store is out of reach: what was acknowledged by
// then is written, and what becomes of the rest its client learns from whoever
// has the vehicle when it resumes.
//
// The stream does not end while a thread is starting an operation.
class PoseStream final : public BidiCall<PoseStream>,
                         public StreamChecks::Observer {
 public:
  PoseStream(grpc::CallbackServerContext* call, const ServiceContext& context)
      : BidiCall<PoseStream>(call, "StreamPoses", context),
        context_(context),
        request_block_(new char[kRequestBlockBytes]),
        arena_(RequestArenaOptions(request_block_.get())),
        request_(google::protobuf::Arena::CreateMessage<Request>(&arena_)) {}

 private:
  // One batch of this stream on its way through the session.
  class Batch final : public AppendObserver {
   public:
    // `poses`: their number. `bytes`: memory that the batch takes; `room` is
    // held until it is durable.
    Batch(std::shared_ptr<PoseStream> stream, std::uint64_t poses,
          std::size_t bytes, Permit room)
        : stream_(std::move(stream)),
          poses_(poses),
          bytes_(bytes),
          room_(std::move(room)) {}

    void OnDecoded(const VehicleConfig& config,
                   const std::vector<core::PoseSample>& samples) override {
      stream_->Inspect(samples, config, &warnings_);
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
      stream_->OnDurable(result, bytes_, warnings_);
    }

    void OnChecksDue(const std::vector<std::uint64_t>& sequences) override {
      if (stream_->group_checks_) stream_->group_checks_->Add(sequences);
    }

    bool ShouldStop() const override {
      return stream_->given_up() || stream_->is_left_;
    }

    void OnCandidates(const VehicleView& view,
                      const absl::StatusOr<core::CandidateSet>& set,
                      std::chrono::nanoseconds duration) override {
      stream_->OnCandidates(view, set, duration, nullptr);
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

  static absl::Status OutOfOrder(const std::string& message) {
    return Error(absl::StatusCode::kInvalidArgument, "STREAM_PROTOCOL",
                 message);
  }

  void OnStart() override {
    WatchRights();
    const MutexLock lock(&mutex_);
    LimitAge();
    Advance();
  }

  void OnMessage() override {
    bool first;
    {
      const MutexLock lock(&mutex_);
      reading_ = false;
      if (Ending()) {
        Advance();
        return;
      }
      handling_ = true;
      first = session_ == nullptr;
    }
    absl::Status status = Parse(request_);
    if (status.ok()) status = first ? Open() : Append();
    if (!status.ok()) Fail(status);
  }

  void OnLastMessage() override {
    const MutexLock lock(&mutex_);
    reading_ = false;
    half_closed_ = true;
    if (session_ == nullptr) {
      SetFailure(OutOfOrder(
          "the stream ended before its first message, which is `open`"));
    }
    Advance();
  }

  void OnWritten() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) override { Advance(); }

  void OnGivenUp() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) override { Advance(); }

  void OnEnd(const absl::Status&)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) override {
    GiveUpGroupChecks();
  }

  // Ends the stream after the last acknowledgement, or without it. The client
  // resends batches that the session has not taken, or that it does not find
  // stored.
  void OnDrain(const Drain::End& end)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) override {
    if (end.at_once) {
      SetFailure(end.status);
      is_left_ = true;
    } else {
      draining_ = true;
    }
    Advance();
  }

  // Ends the stream after the last acknowledgement of batches that the session
  // has taken.
  void OnRightsLost(const absl::Status& reason)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) override {
    SetFailure(reason);
    GiveUpGroupChecks();
    Advance();
  }

  void OnRightsKept() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) override {
    if (group_checks_) group_checks_->SetMayRead(WhatMayBeRead(*this));
  }

  // Takes the first message. If this is not OK, or the session finds nothing of
  // what was acknowledged, the stream fails.
  absl::Status Open() ABSL_LOCKS_EXCLUDED(mutex_) {
    if (!request_->has_open()) {
      return OutOfOrder("the first message of a stream is `open`");
    }
    const v1::StreamPosesOpen& open = request_->open();
    const absl::StatusOr<std::string> id = CheckOpen(open);
    if (!id.ok()) return id.status();
    if (absl::Status status = ChooseVehicle(*id); !status.ok()) return status;
    if (open.send_candidates()) {
      const absl::Status allowed = rights().AlsoNeeds(Verb::kRead);
      if (!allowed.ok()) return allowed;
    }
    absl::StatusOr<ScopeRequest> scope = ScopeRequest();
    if (open.candidate_options().has_scope()) {
      scope = DecodeScope(open.candidate_options().scope(), *id,
                          kOptionsPath.Field("scope"), this);
    }
    if (!scope.ok()) return scope.status();
    checks_ = std::make_shared<const CheckOrder>(CheckOrder{
        searches().check_flow(), CheckOptions(open.candidate_options())});
    send_candidates_ = open.send_candidates();
    include_aligned_path_ = open.candidate_options().include_aligned_path();
    const std::shared_ptr<VehicleSession> session =
        context_.fleet->Session(*id);
    {
      const MutexLock lock(&mutex_);
      session_ = session;
      if (send_candidates_ && open.candidate_options().has_scope()) {
        group_checks_ = std::make_shared<StreamChecks>(
            session, context_.group_searches, checks_, *std::move(scope),
            weak_from_this());
        // Rights that have changed before this did not reach it.
        OnRightsKept();
      }
    }
    session->CheckAcknowledged(
        open.acked_sequence(), open.vehicle_uid(),
        [self = shared_from_this()](const absl::StatusOr<VehicleView>& view) {
          self->OnChecked(view);
        });
    return absl::OkStatus();
  }

  // The id of the vehicle that the message names.
  static absl::StatusOr<std::string> CheckOpen(
      const v1::StreamPosesOpen& open) {
    absl::StatusOr<std::string> id =
        ParseVehicleName(open.vehicle(), kOpenPath.Field("vehicle"));
    if (!id.ok()) return id;
    if (open.acked_sequence() > kMaxSequence) {
      return InvalidField("INVALID_FIELD", kOpenPath.Field("acked_sequence"),
                          "got " + std::to_string(open.acked_sequence()) +
                              "; allowed is [0, 9223372036854775807]");
    }
    if (absl::Status status =
            CheckUid(open.vehicle_uid(), kOpenPath.Field("vehicle_uid"));
        !status.ok()) {
      return status;
    }
    return id;
  }

  SearchOptionsDecoder CheckOptions(const v1::CandidateOptions& given) const {
    return [given, max_steps = context_.limits.max_search_steps](
               const VehicleConfig& config) {
      absl::StatusOr<core::SearchOptions> options =
          DecodeCandidateOptions(given, config, kOptionsPath);
      if (options.ok()) options->max_comparisons = max_steps;
      return options;
    };
  }

  void OnChecked(const absl::StatusOr<VehicleView>& view) {
    if (!view.ok()) {
      Fail(view.status());
      return;
    }
    if (absl::Status status = checks_->options(view->config).status();
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
    opened->set_takes_pose_columns(true);
    if (group_checks_ == nullptr) {
      SendOpened(std::move(response));
      return;
    }
    group_checks_->Open([self = shared_from_this(),
                         opening = *response](const absl::Status& status) {
      if (!status.ok()) {
        self->Fail(status);
      } else {
        self->SendOpened(std::make_unique<Response>(opening));
      }
    });
  }

  void SendOpened(std::unique_ptr<Response> response) {
    const MutexLock lock(&mutex_);
    handling_ = false;
    queue_.Add(std::move(response));
    Advance();
  }

  // Hands the session a batch, unless this is not OK.
  absl::Status Append() ABSL_LOCKS_EXCLUDED(mutex_) {
    if (!request_->has_batch()) {
      return OutOfOrder(request_->has_open()
                            ? "`open` came again; it comes once, first"
                            : "a message after `open` is a `batch`");
    }
    // The staged batch takes about as much memory as the message.
    const auto bytes = static_cast<std::size_t>(arena_.SpaceUsed());
    absl::StatusOr<Permit> permit = room().AdmitBatch(bytes);
    const SentPoses sent = SentPosesOf(request_->batch());
    const std::uint64_t poses = sent.count();
    if (!permit.ok()) {
      context_.counts->Refused(poses, permit.status());
      return permit.status();
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
    AppendRequest append;
    append.decode = DecoderOf(sent, context_.limits.max_batch_poses, "batch");
    if (send_candidates_ && !group_checks_) append.checks = checks_;
    session->Append(std::move(append),
                    std::make_shared<Batch>(shared_from_this(), poses, bytes,
                                            *std::move(permit)));
    return absl::OkStatus();
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
                 std::size_t bytes, const PoseInspector::Warnings& warnings) {
    const MutexLock lock(&mutex_);
    --in_flight_;
    bytes_in_flight_ -= bytes;
    SetFailure(acknowledgement.status());
    if (acknowledgement.ok()) queue_.Add(*acknowledgement, warnings);
    // Appends that the session does not make checks for are over soon, several
    // together, and their acknowledgements then go out together too.
    if (send_candidates_) Advance();
  }

  void OnFound(const VehicleView& view, core::CandidateSet set,
               std::chrono::nanoseconds duration,
               const GroupScope& scope) override {
    OnCandidates(view, std::move(set), duration, &scope);
  }

  void OnIdle(const absl::Status& status) override {
    const MutexLock lock(&mutex_);
    SetFailure(status);
    Advance();
  }

  void GiveUpGroupChecks() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    if (group_checks_) group_checks_->GiveUp();
  }

  // `scope`: null for the vehicle's own history alone.
  void OnCandidates(const VehicleView& view,
                    const absl::StatusOr<core::CandidateSet>& set,
                    std::chrono::nanoseconds duration,
                    const GroupScope* scope) {
    record().Searched(set, duration);
    // Searches stop when the caller is gone, and then nobody waits for them.
    if (given_up()) return;
    auto response = std::make_unique<Response>();
    std::int64_t bytes = 0;
    if (set.ok()) {
      EncodeCandidateSet(view, *set, include_aligned_path_, duration,
                         response->mutable_candidates(), scope);
      bytes = static_cast<std::int64_t>(response->SpaceUsedLong());
    }
    const MutexLock lock(&mutex_);
    SetFailure(set.status());
    const std::int64_t limit = context_.limits.max_unread_bytes;
    if (set.ok() && !slow_) {
      if (queue_.candidate_bytes() + bytes <= limit || queue_.empty()) {
        queue_.AddCandidates(std::move(response), bytes);
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
    queue_.DropCandidates();
    GiveUpGroupChecks();
    const std::chrono::milliseconds grace(static_cast<std::int64_t>(
        context_.limits.slow_consumer_seconds * 1000.0));
    cut_ = AlarmAfter(grace, &PoseStream::Cut);
  }

  void Cut() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    // OnCancel() follows.
    grpc_context_->TryCancel();
  }

  void OnAppendOver() {
    const MutexLock lock(&mutex_);
    --open_appends_;
    Advance();
  }

  void LimitAge() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    const double limit = context_.limits.max_stream_age_seconds;
    if (limit <= 0.0) return;
    age_ = AlarmAfter(DrawnAge(limit), &PoseStream::OnAge);
  }

  // Ends a stream that has its age after the last acknowledgement of batches
  // that the session has taken. One whose client has sent all ends anyway.
  void OnAge() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    if (!half_closed_) SetFailure(OldAge());
    Advance();
  }

  // Ends the message being handled and the stream.
  void Fail(const absl::Status& status) ABSL_LOCKS_EXCLUDED(mutex_) {
    const MutexLock lock(&mutex_);
    handling_ = false;
    SetFailure(status);
    Advance();
  }

  // The first failure counts.
  void SetFailure(const absl::Status& status)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    if (!status.ok() && !failure_) failure_ = status;
  }

  bool Ending() const ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    return half_closed_ || failure_ || draining_ || given_up();
  }

  absl::Status FinalStatus() const ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    // Named as the reason even if the call was cut in the end, since that was
    // not the caller's doing.
    if (slow_) return *failure_;
    if (given_up()) return GivenUpStatus();
    if (failure_) return *failure_;
    return half_closed_ ? absl::OkStatus() : Drain::Refusal();
  }

  // Starts all operations that can be started now. It releases the mutex for
  // that: starting a write may take as long as the system takes to send it, and
  // other threads would wait for the mutex all that time. `starting_` holds the
  // end off meanwhile.
  void Advance() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    while (!ended_) {
      if (given_up()) queue_.Clear();
      const bool write = !writing_ && !queue_.empty();
      if (write) {
        writing_ = true;
        queue_.Take(&response_);
      }
      // More answers follow this one.
      const bool more = !queue_.empty();
      if (Ending() && MayFinish()) {
        EndLocked(FinalStatus());
        return;
      }
      const bool read = !Ending() && MayRead();
      if (read) ClearRequest();
      if (!write && !read) return;
      ++starting_;
      mutex_.Unlock();
      if (write) {
        Write(response_, more ? grpc::WriteOptions().set_buffer_hint()
                              : grpc::WriteOptions());
      }
      if (read) ReadNext();
      mutex_.Lock();
      --starting_;
    }
  }

  void ClearRequest() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    reading_ = true;
    // Reset() keeps the first block.
    arena_.Reset();
    request_ = google::protobuf::Arena::CreateMessage<Request>(&arena_);
  }

  bool MayFinish() const ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    const bool checked = group_checks_ == nullptr || group_checks_->idle();
    const bool answered =
        queue_.empty() && open_appends_ == 0 && checked && !handling_;
    return !writing_ && starting_ == 0 &&
           (answered || given_up() || (is_left_ && queue_.empty()));
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

  const ServiceContext context_;
  // Whether the stream ends without the answers to what is under way.
  std::atomic<bool> is_left_{false};

  // Written by Open() only, with the mutex where others may ask for it before
  // the session hears of the stream.
  std::shared_ptr<const CheckOrder> checks_;
  bool send_candidates_ = false;
  bool include_aligned_path_ = false;
  // Null unless checks are sent that search in a group.
  std::shared_ptr<StreamChecks> group_checks_;

  // Belong to gRPC while `reading_`, to the session while `handling_`.
  const std::unique_ptr<char[]> request_block_;
  google::protobuf::Arena arena_;
  Request* request_;
  // Belong to the session while `handling_`.
  std::unique_ptr<PoseInspector> inspector_;
  bool inspection_is_over_ = false;
  // While `writing_`, belongs to the thread that set that, until it has started
  // the write.
  Response response_;

  std::shared_ptr<VehicleSession> session_ ABSL_GUARDED_BY(mutex_);
  AnswerQueue queue_ ABSL_GUARDED_BY(mutex_);
  // Whether the client was found not to read its candidates.
  bool slow_ ABSL_GUARDED_BY(mutex_) = false;
  // Null unless that is so.
  std::unique_ptr<grpc::Alarm> cut_ ABSL_GUARDED_BY(mutex_);
  // Null if streams may get any age.
  std::unique_ptr<grpc::Alarm> age_ ABSL_GUARDED_BY(mutex_);
  bool reading_ ABSL_GUARDED_BY(mutex_) = false;
  bool handling_ ABSL_GUARDED_BY(mutex_) = false;
  bool half_closed_ ABSL_GUARDED_BY(mutex_) = false;
  bool draining_ ABSL_GUARDED_BY(mutex_) = false;
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

grpc::ServerBidiReactor<grpc::ByteBuffer, grpc::ByteBuffer>* StartPoseStream(
    grpc::CallbackServerContext* call, const ServiceContext& context) {
  const auto stream = std::make_shared<PoseStream>(call, context);
  stream->Start();
  return stream.get();
}

}  // namespace revisit::server
