// One batch on its way into a vehicle: what is asked for, and who hears what
// becomes of it.
#ifndef REVISIT_SERVER_SESSIONS_APPEND_REQUEST_H_
#define REVISIT_SERVER_SESSIONS_APPEND_REQUEST_H_

#include <chrono>
#include <cstdint>
#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/drive/drive.h"
#include "core/settings.h"
#include "server/sessions/record_codec.h"
#include "server/sessions/vehicle_view.h"

namespace revisit::server {

// Decodes the poses of one batch for a vehicle, whose origin the first batch
// may set: a function of the batch and the config alone, which calls nobody.
// INVALID_ARGUMENT, with details, for defects.
using BatchDecoder =
    std::function<absl::StatusOr<DecodedBatch>(const VehicleConfig&)>;

// Decodes the options of searches for a vehicle, in the same way.
// INVALID_ARGUMENT if they do not fit it.
using SearchOptionsDecoder =
    std::function<absl::StatusOr<core::SearchOptions>(const VehicleConfig&)>;

// Has the checks run that a batch makes fall due.
struct CheckOrder {
  // Whose checks they are, among those who share the threads of searches.
  std::string flow;
  SearchOptionsDecoder options;
};

struct AppendRequest {
  // The poses come with their decoder, since their meaning depends on the
  // config that the vehicle has when it is the batch's turn. The message that
  // it reads must stay as it is until AppendObserver::OnStaged().
  BatchDecoder decode;
  // The uid of the vehicle that is meant; empty: whichever has the name.
  std::string vehicle_uid;
  // Null if the session makes none of them. Many batches may share an order.
  std::shared_ptr<const CheckOrder> checks;
};

// A stamp too far ahead of the server's clock (server_clock.h).
struct StampAhead {
  std::uint64_t sequence = 0;
  std::int64_t nanoseconds = 0;
};

struct Acknowledgement {
  std::uint64_t durable_sequence = 0;
  std::uint64_t revision = 0;
  std::vector<core::Jump> jumps;
  // Findings that these poses are the first to show.
  std::vector<core::Finding> findings = {};
  // Where these poses are the first to have one.
  std::optional<StampAhead> stamp_ahead = std::nullopt;
  // How many of the batch's poses are new; the others were stored before.
  std::uint64_t accepted_poses = 0;

  bool has_warnings() const {
    return !findings.empty() || stamp_ahead.has_value();
  }
};

// Hears what becomes of one batch. The session calls, in this order and one at
// a time per vehicle: OnDecoded() at most once, OnStaged() once, OnDurable()
// once, OnChecksDue() at most once, OnCandidates() once for each check that
// fell due if the session makes them, OnOver() once. OnDurable() comes in the
// order of the vehicle's appends, success or failure; only an append that is
// refused with QUEUE_FULL is answered ahead of those before it. Of appends that
// land together and have no checks to be made, OnOver() comes soon after
// OnDurable() of all: who is to pass their ends on may do it then, at once.
class AppendObserver {
 public:
  virtual ~AppendObserver() = default;

  // Asked when it is the batch's turn, before it is decoded: not OK if nobody
  // waits for it any longer, which is then its answer.
  virtual absl::Status StillWanted() const { return absl::OkStatus(); }

  // The poses of the batch, those included that are stored already.
  virtual void OnDecoded(const VehicleConfig& /*config*/,
                         const std::vector<core::PoseSample>& /*samples*/) {}

  // The batch has been decoded or never will be, so its message may be reused.
  // OK if it was taken on; otherwise OnDurable() will report the same.
  virtual void OnStaged(const absl::Status& /*status*/) {}

  // The batch is durable and applied, or the reason why not.
  virtual void OnDurable(const absl::StatusOr<Acknowledgement>& result) = 0;

  // Checks fell due at these poses, of which there is one at least: in order,
  // and one more than once where several did. Whoever wants them may make them,
  // at the last node at or before the pose, once this has returned.
  virtual void OnChecksDue(const std::vector<std::uint64_t>& /*sequences*/) {}

  // Gives up the checks; a batch that was staged is not given up.
  virtual bool ShouldStop() const { return false; }
  // `duration` is that of the search, without its waits.
  virtual void OnCandidates(const VehicleView& /*view*/,
                            const absl::StatusOr<core::CandidateSet>& /*set*/,
                            std::chrono::nanoseconds /*duration*/) {}

  // Nothing more comes of this append.
  virtual void OnOver() {}
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SESSIONS_APPEND_REQUEST_H_
