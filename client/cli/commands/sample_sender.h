// Sends the samples of a recording to a vehicle.
#ifndef REVISIT_CLIENT_CLI_COMMANDS_SAMPLE_SENDER_H_
#define REVISIT_CLIENT_CLI_COMMANDS_SAMPLE_SENDER_H_

#include <chrono>
#include <cstdint>
#include <deque>
#include <memory>
#include <optional>
#include <string>

#include "absl/status/status.h"
#include "client/cli/commands/stream_command.h"
#include "client/cli/commands/stream_end.h"
#include "client/formats/sample.h"
#include "client/revisit/pose_stream.h"
#include "client/terminal/terminal.h"
#include "client/trajectory/dead_reckoning.h"
#include "client/trajectory/recording_starts.h"
#include "revisit/v1/vehicle.pb.h"

namespace revisit::client {

// Sends nothing, and asks the server nothing, before samples are let go. Not
// thread-safe.
class SampleSender {
 public:
  // All arguments must outlive it. `callbacks` are those of the stream;
  // `progress` is told of recordings that begin by themselves.
  SampleSender(const std::shared_ptr<grpc::Channel>& channel,
               const StreamOptions& options,
               const PoseStreamCallbacks& callbacks, const Terminal& terminal,
               Progress* progress);

  // The samples that follow come from this file. Lets go those before.
  void BeginFile(const std::string& file);

  // Takes the next sample. Returns why the stream has ended, if it has.
  absl::Status Take(const Sample& sample);

  // Lets go what is held back and sends what has been gathered.
  void LetGo();

  // Does so before a wait for more, unless samples that are held back have come
  // only just now: then it is to be called again after what it returns.
  std::optional<std::chrono::milliseconds> BeforeWait();

  // Waits until all is durable. FAILED_PRECONDITION if the vehicle has more
  // poses than were taken.
  absl::Status Finish();

  // Keeps the range of the samples' sequences as the label that the options
  // name, if they do. REQUIRES: Finish() returned OK.
  absl::Status KeepSession();

  // Waits until what was taken before an error of a file is durable, if any of
  // it has been sent, and adds to the error how much that is.
  absl::Status FinishAfter(const absl::Status& error);

  // The vehicle as it was before the first pose was sent. REQUIRES: Finish()
  // returned OK.
  const v1::Vehicle& vehicle() const { return vehicle_; }
  const PoseStream& stream() const { return *stream_; }
  std::uint64_t already_durable() const { return already_durable_; }
  std::uint64_t taken() const { return taken_; }
  // How many of the samples begin a recording. REQUIRES: as vehicle().
  int recordings() const { return starts_->count(); }
  // The word of --uncertainty for what was claimed. REQUIRES: as vehicle().
  std::string uncertainty() const;

 private:
  absl::Status Open();
  // Waits until all that was sent is durable, or says why it is not.
  absl::Status FinishStream();
  // Adds to a fault of this machine what is durable.
  absl::Status WithDurableCount(const absl::Status& error) const;
  absl::StatusOr<v1::Vehicle> GetOrCreate(const Sample& first);
  absl::Status CheckThatSamplesFit(const Sample& first) const;
  void ChooseUncertainty();
  // Begins behind the poses that are stored.
  absl::Status ContinueBehindStored();
  // FAILED_PRECONDITION if other poses have the session's name.
  absl::Status CheckThatSessionIsFree() const;
  void Send(const Sample& sample);
  void Flush();

  const std::shared_ptr<grpc::Channel> channel_;
  const StreamOptions& options_;
  const PoseStreamCallbacks& callbacks_;
  const Terminal& terminal_;
  Progress& progress_;

  std::string file_;
  // Why nothing more is sent.
  absl::Status status_;
  std::deque<Sample> held_;
  std::chrono::steady_clock::time_point held_since_;
  bool opened_ = false;
  v1::Vehicle vehicle_;
  UncertaintyOptions::Source source_ = UncertaintyOptions::Source::kModel;
  std::optional<UncertaintyClaims> claims_;
  std::optional<RecordingStarts> starts_;
  std::unique_ptr<PoseStream> stream_;
  // Handles Ctrl-C from the opening of the stream to its end.
  std::optional<StreamInterrupt> interrupt_;
  std::uint64_t already_durable_ = 0;
  // Sequence before that of the first sample.
  std::uint64_t base_ = 0;
  std::uint64_t taken_ = 0;
  std::uint64_t sent_ = 0;
  v1::PoseBatch batch_;
};

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_COMMANDS_SAMPLE_SENDER_H_
