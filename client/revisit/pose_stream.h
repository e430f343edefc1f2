// A stream of poses that survives the connection.
//
// Poses go in, in order of their sequences; the stream keeps each until the
// server has acknowledged it as durable, reconnects as often as needed, and
// goes on where the server says it stands. Every pose that was taken arrives
// exactly once, in order, or Finish() reports why not.
//
//   PoseStream stream(channel, "vehicles/shuttle-7", options, callbacks);
//   absl::StatusOr<std::uint64_t> durable = stream.WaitUntilOpened();
//   ... stream.Append(batch) from *durable + 1 on ...
//   absl::Status status = stream.Finish();
//
// Memory: at most PoseStreamOptions::max_pending_poses and max_pending_bytes of
// unacknowledged poses, and one message on its way each way. Append() waits for
// room, TryAppend() says RESOURCE_EXHAUSTED.
//
// Reconnecting: after UNAVAILABLE (NOT_OWNER among them: the next connection
// names the owner to the proxy), ABORTED, RESOURCE_EXHAUSTED with a
// RetryInfo, a cut on the way (IsCut() in status.h), an end that was not asked
// for, or silence longer than answer_timeout, with exponential back-off that
// starts over after progress.
// An expired token is no end either once the stream was opened: the next
// connection reads it anew (channel.h). Any other status ends the stream, among
// them DATA_LOSS (the server has less than was acknowledged), ALREADY_EXISTS (a
// sequence is stored with other content), FAILED_PRECONDITION (a gap, or the
// vehicle was deleted and made again under the stream: VEHICLE_REPLACED, with
// no pose taken for durable because the new vehicle has its sequence),
// INVALID_ARGUMENT and NOT_FOUND.
//
// With a scope in PoseStreamOptions::candidate_options, checks search in a
// group. While the server reads the histories of its members (GROUP_NOT_READY),
// the stream is not opened, and connects again until give_up_after.
//
// Candidates: the server sends the answer of a check once, on the stream on
// which the check's batch became durable. If the connection breaks after that
// and before the answer arrives, the answer is lost: it is not sent again, also
// not after the batch is resent. reconnects() > 0 therefore means that answers
// may be missing, for poses up to the sequence of `resumed`;
// PoseGraphService.FindCandidates can be asked for them.
#ifndef REVISIT_CLIENT_REVISIT_POSE_STREAM_H_
#define REVISIT_CLIENT_REVISIT_POSE_STREAM_H_

#include <chrono>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <memory>
#include <optional>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "client/revisit/backoff.h"
#include "revisit/v1/pose_graph_service.pb.h"

namespace grpc {
class ChannelInterface;
}

namespace revisit::client {

struct PoseStreamOptions {
  // Most poses in a message; fewer where the server says so. At least 1.
  int batch_poses = 64;
  // Unacknowledged poses that are held. At least 1.
  std::size_t max_pending_poses = 65'536;
  // Bytes that the held poses may take. A single pose that needs more is
  // refused.
  std::size_t max_pending_bytes = 32 << 20;
  // Highest sequence that this client knows to be durable from an earlier life;
  // 0 if it keeps no such record. The server answers DATA_LOSS if it has less.
  std::uint64_t acked_sequence = 0;
  // vehicle_uid() of that earlier life; the stream ends with VEHICLE_REPLACED
  // if the vehicle is another by now. Empty: whichever vehicle has the name
  // when the stream is first opened.
  std::string vehicle_uid;
  // Whether the server answers with candidates at every check, and how.
  bool send_candidates = false;
  v1::CandidateOptions candidate_options;
  BackoffOptions backoff;
  // A connection on which an answer is due and none has come for so long is
  // given up for a new one. Time spent in callbacks does not count. Never more
  // than a quarter of give_up_after, but a second at least.
  std::chrono::milliseconds answer_timeout{60'000};
  // How long to reconnect without progress before the stream ends with the last
  // status. Progress means that something became durable or was answered, or
  // that a connection was opened and nothing waits. If absent, for ever.
  std::optional<std::chrono::milliseconds> give_up_after;
};

// Called one at a time, in the order of the server's messages, on a thread of
// the library, without locks held. While one runs no further answers are read,
// so a slow one slows the server down. They may call acked_sequence(),
// reconnects(), pending_*() and Cancel() of the stream, nothing that waits. Any
// of them may be empty.
struct PoseStreamCallbacks {
  std::function<void(const v1::Ack&)> ack;
  std::function<void(const v1::CandidateSet&)> candidates;
  // The connection was lost and will be made again after the wait. May run
  // beside the others.
  std::function<void(const absl::Status&, std::chrono::nanoseconds wait)>
      disconnected;
  // The stream goes on behind this durable sequence. Not called for the first
  // connection.
  std::function<void(std::uint64_t durable_sequence)> resumed;
};

// Thread-safe, but poses come in one order, so appending is for one thread at a
// time. After the destructor has returned no callback runs.
class PoseStream {
 public:
  // Starts connecting and returns at once. `vehicle` is a resource name,
  // "vehicles/...". The channel may be shared.
  PoseStream(const std::shared_ptr<grpc::ChannelInterface>& channel,
             const std::string& vehicle, const PoseStreamOptions& options,
             const PoseStreamCallbacks& callbacks);
  // Cancels the stream if Finish() has not ended it.
  ~PoseStream();

  PoseStream(const PoseStream&) = delete;
  PoseStream& operator=(const PoseStream&) = delete;

  // Waits for the first connection. Returns the highest durable sequence at
  // that moment: go on behind it. Poses up to it may be appended again; the
  // server then compares them with what it has.
  absl::StatusOr<std::uint64_t> WaitUntilOpened();

  // Takes poses whose sequences follow each other and the last one taken. Waits
  // while there is no room; a batch may be larger than the room. OK means
  // taken, not durable. INVALID_ARGUMENT, with nothing taken, if sequences do
  // not follow or a pose is larger than max_pending_bytes; FAILED_PRECONDITION
  // after Finish(); the final status if the stream has ended.
  absl::Status Append(v1::PoseBatch batch);

  // Does what Append() does, but never waits for room: it takes all poses or,
  // with RESOURCE_EXHAUSTED, none.
  absl::Status TryAppend(const v1::PoseBatch& batch);

  // Takes no more poses and waits until all are durable and the server has
  // answered all checks. OK, or why the stream ended. May be called again.
  absl::Status Finish();

  // Does what Finish() does, but waits no longer than this, and then cancels
  // the stream. Another thread may be appending: it is told that the stream is
  // finished.
  absl::Status FinishWithin(std::chrono::milliseconds limit);

  // Ends the stream with CANCELLED unless it has ended. Does not wait.
  void Cancel();

  // Highest sequence known to be durable. A client that keeps it over restarts,
  // with the uid, and hands both in by PoseStreamOptions, learns of data loss.
  std::uint64_t acked_sequence() const;

  // Which vehicle it is (v1::Vehicle.uid). Empty until it is known: by the
  // options or the first connection.
  std::string vehicle_uid() const;

  // Connections after the first one.
  int reconnects() const;

  // Unacknowledged poses that are held now, and their bytes.
  std::size_t pending_poses() const;
  std::size_t pending_bytes() const;

 private:
  class Connection;
  struct Rep;
  const std::unique_ptr<Rep> rep_;
};

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_REVISIT_POSE_STREAM_H_
