#include "client/revisit/pose_stream.h"

#include <algorithm>
#include <deque>
#include <optional>
#include <system_error>
#include <thread>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "client/revisit/owner_route.h"
#include "client/revisit/pose_columns.h"
#include "client/revisit/status.h"
#include "client/revisit/status_from_grpc.h"
#include "core/base/mutex.h"
#include "grpcpp/client_context.h"
#include "grpcpp/support/client_callback.h"
#include "revisit/v1/pose_graph_service.grpc.pb.h"

namespace revisit::client {
namespace {

using Clock = std::chrono::steady_clock;

bool WorthAnotherConnection(const absl::Status& status, bool was_opened) {
  // Whoever renews tokens may be late.
  if (was_opened && absl::IsUnauthenticated(status) &&
      DetailsOf(status).reason == "TOKEN_EXPIRED") {
    return true;
  }
  return absl::IsUnavailable(status) || absl::IsAborted(status) ||
         IsCut(status) ||
         (absl::IsResourceExhausted(status) &&
          DetailsOf(status).retry_delay.has_value());
}

struct PendingPose {
  v1::Pose pose;
  std::size_t bytes = 0;
};

}  // namespace

// One thread, Run(), makes the connections one after the other and starts all
// writes; gRPC's threads bring the answers in.
struct PoseStream::Rep {
  Rep(const std::shared_ptr<grpc::ChannelInterface>& channel,
      const std::string& vehicle_name, const PoseStreamOptions& stream_options,
      const PoseStreamCallbacks& stream_callbacks)
      : stub(v1::PoseGraphService::NewStub(channel)),
        vehicle(vehicle_name),
        options(stream_options),
        callbacks(stream_callbacks),
        acked_sequence(stream_options.acked_sequence),
        vehicle_uid(stream_options.vehicle_uid) {}

  void Run();
  // Holds one connection until it is over. `last` is how the one before ended.
  // OK if the server ended it in answer to our half-close.
  absl::Status RunConnection(const absl::Status& last);

  bool HasRoom(std::size_t poses, std::size_t bytes) const
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex) {
    return pending.size() + poses <= options.max_pending_poses &&
           pending_bytes + bytes <= options.max_pending_bytes;
  }
  absl::Status CheckBatch(const v1::PoseBatch& batch) const
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex);
  // Why no more poses are taken; OK if they are.
  absl::Status WhyClosed() const ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex);
  void Take(v1::Pose pose, std::size_t bytes)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex);
  // Forgets poses up to `durable_sequence`, among the first `count`.
  void DropDurable(std::uint64_t durable_sequence, std::size_t count)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex);
  // Fills a message with the next unsent poses.
  void FillBatch(v1::StreamPosesRequest* request)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex);
  bool AnswerIsDue() const ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex) {
    return !opened || sent > 0 || half_closed;
  }
  bool CanWrite() const ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex) {
    return opened && !writing && !write_failed && !half_closed;
  }
  // How long an answer that is due may take: well below the time after which
  // the stream gives up, so that there are other connections to try in it.
  std::chrono::milliseconds AnswerTimeout() const {
    constexpr std::chrono::milliseconds kLeast{1'000};
    if (!options.give_up_after.has_value()) return options.answer_timeout;
    return std::min(options.answer_timeout,
                    std::max(*options.give_up_after / 4, kLeast));
  }
  // Whether the connection is to be ended from our side.
  bool MustEnd() const ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex) {
    return cancelled || !own_verdict.ok();
  }

  // Constant after construction.
  const std::unique_ptr<v1::PoseGraphService::Stub> stub;
  const std::string vehicle;
  const PoseStreamOptions options;
  const PoseStreamCallbacks callbacks;
  std::thread thread;

  mutable Mutex mutex;
  CondVar changed;

  // The whole stream.
  std::deque<PendingPose> pending ABSL_GUARDED_BY(mutex);
  std::size_t pending_bytes ABSL_GUARDED_BY(mutex) = 0;
  std::uint64_t last_taken_sequence ABSL_GUARDED_BY(mutex) = 0;
  // Highest sequence that was ever written to a connection. What lies above it
  // and is durable already came from elsewhere, and the server shall compare
  // it.
  std::uint64_t last_sent_sequence ABSL_GUARDED_BY(mutex) = 0;
  std::uint64_t acked_sequence ABSL_GUARDED_BY(mutex);
  // Empty until it is known.
  std::string vehicle_uid ABSL_GUARDED_BY(mutex);
  std::optional<std::uint64_t> first_durable_sequence ABSL_GUARDED_BY(mutex);
  int reconnects ABSL_GUARDED_BY(mutex) = 0;
  bool finishing ABSL_GUARDED_BY(mutex) = false;
  bool cancelled ABSL_GUARDED_BY(mutex) = false;
  std::optional<absl::Status> final_status ABSL_GUARDED_BY(mutex);

  // The connection of the moment.
  bool opened ABSL_GUARDED_BY(mutex) = false;
  // Whether the connection was worth making: something became durable or was
  // answered, or nothing waits.
  bool progressed ABSL_GUARDED_BY(mutex) = false;
  bool writing ABSL_GUARDED_BY(mutex) = false;
  bool write_failed ABSL_GUARDED_BY(mutex) = false;
  bool half_closed ABSL_GUARDED_BY(mutex) = false;
  bool read_closed ABSL_GUARDED_BY(mutex) = false;
  bool in_callback ABSL_GUARDED_BY(mutex) = false;
  bool done ABSL_GUARDED_BY(mutex) = false;
  // How many of the pending poses were sent, from the front.
  std::size_t sent ABSL_GUARDED_BY(mutex) = 0;
  int batch_poses ABSL_GUARDED_BY(mutex) = 1;
  bool takes_columns ABSL_GUARDED_BY(mutex) = false;
  Clock::time_point quiet_since ABSL_GUARDED_BY(mutex);
  // Why we ended the connection ourselves.
  absl::Status own_verdict ABSL_GUARDED_BY(mutex);
  grpc::Status connection_status ABSL_GUARDED_BY(mutex);
};

class PoseStream::Connection final
    : public grpc::ClientBidiReactor<v1::StreamPosesRequest,
                                     v1::StreamPosesResponse> {
 public:
  explicit Connection(Rep* rep) : rep_(rep) {}

  grpc::ClientContext* context() { return &context_; }
  v1::StreamPosesRequest* request() { return &request_; }

  void Start() {
    rep_->stub->async()->StreamPoses(&context_, this);
    // Writes are started from outside the reactions.
    AddHold();
    StartWrite(&request_);
    StartRead(&response_);
    StartCall();
  }

  void OnWriteDone(bool ok) override {
    const MutexLock lock(&rep_->mutex);
    rep_->writing = false;
    rep_->write_failed = !ok;
    rep_->changed.NotifyAll();
  }

  void OnReadDone(bool ok) override {
    bool resumed = false;
    {
      const MutexLock lock(&rep_->mutex);
      if (!ok) {
        rep_->read_closed = true;
        rep_->changed.NotifyAll();
        return;
      }
      resumed = Digest();
      rep_->in_callback = true;
      rep_->changed.NotifyAll();
    }
    if (response_.has_ack() && rep_->callbacks.ack) {
      rep_->callbacks.ack(response_.ack());
    } else if (response_.has_candidates() && rep_->callbacks.candidates) {
      rep_->callbacks.candidates(response_.candidates());
    } else if (resumed && rep_->callbacks.resumed) {
      rep_->callbacks.resumed(response_.opened().durable_sequence());
    }
    {
      const MutexLock lock(&rep_->mutex);
      rep_->in_callback = false;
      rep_->quiet_since = Clock::now();
      rep_->changed.NotifyAll();
    }
    StartRead(&response_);
  }

  void OnDone(const grpc::Status& status) override {
    const MutexLock lock(&rep_->mutex);
    rep_->connection_status = status;
    rep_->done = true;
    rep_->changed.NotifyAll();
  }

 private:
  // Notes what an answer says; whether it opens a connection after the first.
  bool Digest() ABSL_EXCLUSIVE_LOCKS_REQUIRED(rep_->mutex) {
    if (!response_.has_opened()) rep_->progressed = true;
    if (response_.has_ack()) {
      const std::uint64_t durable = response_.ack().durable_sequence();
      rep_->acked_sequence = std::max(rep_->acked_sequence, durable);
      rep_->DropDurable(durable, rep_->sent);
    } else if (response_.has_opened() && !rep_->opened) {
      return Open(response_.opened());
    }
    return false;
  }

  bool Open(const v1::StreamPosesOpened& message)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(rep_->mutex) {
    const std::uint64_t durable = message.durable_sequence();
    // Before anything is taken for durable because this one has its sequence.
    if (!IsMeant(message)) return false;
    if (durable < rep_->acked_sequence) {
      rep_->own_verdict = absl::DataLossError(
          absl::StrCat("the server has poses up to sequence ", durable,
                       ", but acknowledged up to ", rep_->acked_sequence));
      return false;
    }
    if (durable > rep_->acked_sequence) rep_->progressed = true;
    rep_->opened = true;
    rep_->acked_sequence = durable;
    rep_->takes_columns = message.takes_pose_columns();
    rep_->batch_poses = std::max(rep_->options.batch_poses, 1);
    if (message.max_batch_poses() > 0) {
      rep_->batch_poses =
          std::min(rep_->batch_poses, message.max_batch_poses());
    }
    rep_->DropDurable(std::min(durable, rep_->last_sent_sequence),
                      rep_->pending.size());
    const bool resumed = rep_->first_durable_sequence.has_value();
    if (!resumed) rep_->first_durable_sequence = durable;
    return resumed;
  }

  // Whether the vehicle is still the one that the stream began with.
  bool IsMeant(const v1::StreamPosesOpened& message)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(rep_->mutex) {
    if (rep_->vehicle_uid.empty()) rep_->vehicle_uid = message.vehicle_uid();
    if (rep_->vehicle_uid == message.vehicle_uid()) return true;
    rep_->own_verdict = absl::FailedPreconditionError(
        rep_->vehicle + " has the uid " + message.vehicle_uid() +
        ", but the stream began with " + rep_->vehicle_uid +
        ": it was deleted and made again");
    return false;
  }

  Rep* const rep_;
  grpc::ClientContext context_;
  v1::StreamPosesRequest request_;
  v1::StreamPosesResponse response_;
};

absl::Status PoseStream::Rep::WhyClosed() const {
  if (final_status.has_value()) {
    // A stream that ended well did so because it was finished.
    if (!final_status->ok()) return *final_status;
  } else if (!finishing) {
    return absl::OkStatus();
  }
  return absl::FailedPreconditionError("the stream is finished");
}

absl::Status PoseStream::Rep::CheckBatch(const v1::PoseBatch& batch) const {
  std::uint64_t expected = last_taken_sequence + 1;
  if (last_taken_sequence == 0 && batch.poses_size() > 0) {
    expected = std::max<std::uint64_t>(batch.poses(0).sequence(), 1);
  }
  for (const v1::Pose& pose : batch.poses()) {
    if (pose.sequence() != expected) {
      return absl::InvalidArgumentError(absl::StrCat(
          "sequence ", pose.sequence(), " where ", expected, " comes next"));
    }
    ++expected;
    if (pose.SpaceUsedLong() > options.max_pending_bytes) {
      return absl::InvalidArgumentError(absl::StrCat(
          "the pose of sequence ", pose.sequence(), " takes ",
          pose.SpaceUsedLong(), " bytes, more than max_pending_bytes allows (",
          options.max_pending_bytes, ")"));
    }
  }
  return absl::OkStatus();
}

void PoseStream::Rep::Take(v1::Pose pose, std::size_t bytes) {
  last_taken_sequence = pose.sequence();
  pending.push_back({std::move(pose), bytes});
  pending_bytes += bytes;
}

void PoseStream::Rep::DropDurable(std::uint64_t durable_sequence,
                                  std::size_t count) {
  while (count > 0 && pending.front().pose.sequence() <= durable_sequence) {
    pending_bytes -= pending.front().bytes;
    pending.pop_front();
    --count;
    if (sent > 0) --sent;
  }
}

void PoseStream::Rep::FillBatch(v1::StreamPosesRequest* request) {
  if (sent == 0) quiet_since = Clock::now();
  v1::PoseBatch* const batch = request->mutable_batch();
  batch->Clear();
  std::size_t end =
      std::min(pending.size(), sent + static_cast<std::size_t>(batch_poses));
  std::optional<v1::PoseColumns> columns;
  if (takes_columns) {
    std::vector<const v1::Pose*> poses;
    for (std::size_t i = sent; i < end; ++i) {
      const v1::Pose& pose = pending[i].pose;
      // A recording begins a batch of its own.
      if (i > sent && pose.has_recording_start()) break;
      poses.push_back(&pose);
    }
    end = sent + poses.size();
    columns = PoseColumnsOf(poses);
  }
  if (columns) {
    *batch->mutable_columns() = *std::move(columns);
    sent = end;
  } else {
    for (; sent < end; ++sent) *batch->add_poses() = pending[sent].pose;
  }
  last_sent_sequence =
      std::max(last_sent_sequence, pending[sent - 1].pose.sequence());
}

absl::Status PoseStream::Rep::RunConnection(const absl::Status& last) {
  Connection connection(this);
  RouteToOwner(last, connection.context());
  MutexLock lock(&mutex);
  if (cancelled) return absl::CancelledError("the stream was cancelled");
  opened = progressed = half_closed = read_closed = in_callback = done = false;
  write_failed = false;
  writing = true;
  sent = 0;
  own_verdict = absl::OkStatus();
  quiet_since = Clock::now();
  v1::StreamPosesOpen* open = connection.request()->mutable_open();
  open->set_vehicle(vehicle);
  open->set_acked_sequence(acked_sequence);
  open->set_vehicle_uid(vehicle_uid);
  open->set_send_candidates(options.send_candidates);
  if (options.send_candidates) {
    *open->mutable_candidate_options() = options.candidate_options;
  }
  lock.Unlock();
  connection.Start();
  lock.Lock();
  while (!read_closed && !MustEnd()) {
    if (CanWrite() && sent < pending.size()) {
      writing = true;
      FillBatch(connection.request());
      lock.Unlock();
      connection.StartWrite(connection.request());
      lock.Lock();
    } else if (CanWrite() && finishing) {
      half_closed = true;
      quiet_since = Clock::now();
      lock.Unlock();
      connection.StartWritesDone();
      lock.Lock();
    } else if (!AnswerIsDue() || in_callback) {
      changed.Wait(&mutex);
    } else if (const auto deadline = quiet_since + AnswerTimeout();
               Clock::now() < deadline) {
      changed.WaitUntil(&mutex, deadline);
    } else {
      own_verdict = absl::UnavailableError(
          absl::StrCat("no answer for ", AnswerTimeout().count(), " ms"));
    }
  }
  const bool must_end = MustEnd();
  lock.Unlock();
  // Not under the lock: gRPC may run reactions before it returns.
  if (must_end) connection.context()->TryCancel();
  connection.RemoveHold();
  lock.Lock();
  while (!done) changed.Wait(&mutex);
  if (opened && pending.empty()) progressed = true;
  if (cancelled) return absl::CancelledError("the stream was cancelled");
  if (!own_verdict.ok()) return own_verdict;
  if (!connection_status.ok()) return FromGrpc(connection_status);
  if (half_closed && pending.empty()) return absl::OkStatus();
  return absl::UnavailableError("the server ended the stream too early");
}

void PoseStream::Rep::Run() {
  Backoff backoff(options.backoff, BackoffSeed());
  Clock::time_point last_progress = Clock::now();
  absl::Status status;
  for (;;) {
    status = RunConnection(status);
    MutexLock lock(&mutex);
    if (status.ok() || cancelled ||
        !WorthAnotherConnection(status, first_durable_sequence.has_value())) {
      final_status = status;
      changed.NotifyAll();
      return;
    }
    // The server says when a vehicle that is elsewhere may be asked for again,
    // and when to ask whether histories were read.
    if (progressed || WasElsewhere(status) || ReadsHistories(status)) {
      backoff.Reset();
    }
    if (progressed) {
      last_progress = Clock::now();
    }
    const auto wait = backoff.Next(DetailsOf(status).retry_delay);
    if (options.give_up_after.has_value() &&
        Clock::now() + wait - last_progress > *options.give_up_after) {
      final_status = status;
      changed.NotifyAll();
      return;
    }
    ++reconnects;
    lock.Unlock();
    if (callbacks.disconnected) callbacks.disconnected(status, wait);
    lock.Lock();
    const auto again = Clock::now() + wait;
    while (!cancelled && !changed.WaitUntil(&mutex, again)) {
    }
  }
}

PoseStream::PoseStream(const std::shared_ptr<grpc::ChannelInterface>& channel,
                       const std::string& vehicle,
                       const PoseStreamOptions& options,
                       const PoseStreamCallbacks& callbacks)
    : rep_(std::make_unique<Rep>(channel, vehicle, options, callbacks)) {
  try {
    rep_->thread = std::thread([this] { rep_->Run(); });
  } catch (const std::system_error& error) {
    const MutexLock lock(&rep_->mutex);
    rep_->final_status = absl::ResourceExhaustedError(
        std::string("no thread for the stream: ") + error.what());
  }
}

PoseStream::~PoseStream() {
  Cancel();
  if (rep_->thread.joinable()) rep_->thread.join();
}

absl::StatusOr<std::uint64_t> PoseStream::WaitUntilOpened() {
  const MutexLock lock(&rep_->mutex);
  while (!rep_->first_durable_sequence.has_value() &&
         !rep_->final_status.has_value()) {
    rep_->changed.Wait(&rep_->mutex);
  }
  if (rep_->first_durable_sequence.has_value()) {
    return *rep_->first_durable_sequence;
  }
  return *rep_->final_status;
}

absl::Status PoseStream::Append(v1::PoseBatch batch) {
  const MutexLock lock(&rep_->mutex);
  if (absl::Status status = rep_->WhyClosed(); !status.ok()) return status;
  if (absl::Status status = rep_->CheckBatch(batch); !status.ok()) {
    return status;
  }
  for (v1::Pose& pose : *batch.mutable_poses()) {
    const std::size_t bytes = pose.SpaceUsedLong();
    if (!rep_->HasRoom(1, bytes)) {
      rep_->changed.NotifyAll();
      while (!rep_->HasRoom(1, bytes) && rep_->WhyClosed().ok()) {
        rep_->changed.Wait(&rep_->mutex);
      }
      if (absl::Status status = rep_->WhyClosed(); !status.ok()) return status;
    }
    rep_->Take(std::move(pose), bytes);
  }
  rep_->changed.NotifyAll();
  return absl::OkStatus();
}

absl::Status PoseStream::TryAppend(const v1::PoseBatch& batch) {
  const MutexLock lock(&rep_->mutex);
  if (absl::Status status = rep_->WhyClosed(); !status.ok()) return status;
  if (absl::Status status = rep_->CheckBatch(batch); !status.ok()) {
    return status;
  }
  std::size_t bytes = 0;
  for (const v1::Pose& pose : batch.poses()) bytes += pose.SpaceUsedLong();
  if (!rep_->HasRoom(static_cast<std::size_t>(batch.poses_size()), bytes)) {
    return absl::ResourceExhaustedError(absl::StrCat(
        rep_->pending.size(),
        " poses wait for their acknowledgement; there is no room for ",
        batch.poses_size(), " more"));
  }
  for (const v1::Pose& pose : batch.poses()) {
    rep_->Take(pose, pose.SpaceUsedLong());
  }
  rep_->changed.NotifyAll();
  return absl::OkStatus();
}

absl::Status PoseStream::Finish() {
  const MutexLock lock(&rep_->mutex);
  rep_->finishing = true;
  rep_->changed.NotifyAll();
  while (!rep_->final_status.has_value()) rep_->changed.Wait(&rep_->mutex);
  return *rep_->final_status;
}

absl::Status PoseStream::FinishWithin(std::chrono::milliseconds limit) {
  const auto deadline = Clock::now() + limit;
  const MutexLock lock(&rep_->mutex);
  rep_->finishing = true;
  rep_->changed.NotifyAll();
  while (!rep_->final_status.has_value() && Clock::now() < deadline) {
    rep_->changed.WaitUntil(&rep_->mutex, deadline);
  }
  if (rep_->final_status.has_value()) return *rep_->final_status;
  rep_->cancelled = true;
  rep_->changed.NotifyAll();
  return absl::CancelledError(
      absl::StrCat("the stream was cancelled: not all was answered within ",
                   limit.count(), " ms"));
}

void PoseStream::Cancel() {
  const MutexLock lock(&rep_->mutex);
  rep_->cancelled = true;
  rep_->changed.NotifyAll();
}

std::uint64_t PoseStream::acked_sequence() const {
  const MutexLock lock(&rep_->mutex);
  return rep_->acked_sequence;
}

std::string PoseStream::vehicle_uid() const {
  const MutexLock lock(&rep_->mutex);
  return rep_->vehicle_uid;
}

int PoseStream::reconnects() const {
  const MutexLock lock(&rep_->mutex);
  return rep_->reconnects;
}

std::size_t PoseStream::pending_poses() const {
  const MutexLock lock(&rep_->mutex);
  return rep_->pending.size();
}

std::size_t PoseStream::pending_bytes() const {
  const MutexLock lock(&rep_->mutex);
  return rep_->pending_bytes;
}

}  // namespace revisit::client
