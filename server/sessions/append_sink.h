// One batch on its way into a vehicle: where its poses come from, and who hears
// what becomes of them.
#ifndef REVISIT_SERVER_SESSIONS_APPEND_SINK_H_
#define REVISIT_SERVER_SESSIONS_APPEND_SINK_H_

#include <chrono>
#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/drive/drive.h"
#include "core/drive/findings.h"
#include "core/settings.h"
#include "server/sessions/record_codec.h"
#include "server/sessions/vehicle_view.h"

namespace revisit::server {

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

// The session calls, in this order and one at a time per vehicle: Decode() at
// most once, OnStaged() once, OnDurable() once, OnCandidates() once for each
// check that fell due, OnOver() once. OnDurable() comes in the order of the
// vehicle's appends, success or failure; only an append that is refused with
// QUEUE_FULL is answered ahead of those before it.
class AppendSink {
 public:
  virtual ~AppendSink() = default;

  // Decodes the batch for a vehicle, whose origin the first batch may set.
  // INVALID_ARGUMENT, with details, for defects.
  virtual absl::StatusOr<DecodedBatch> Decode(const VehicleConfig& config) = 0;

  // Decode() has been called or never will be, so its message may be reused. OK
  // if the batch was taken on; otherwise OnDurable() will report the same.
  virtual void OnStaged(const absl::Status& /*status*/) {}

  // The batch is durable and applied, or the reason why not.
  virtual void OnDurable(const absl::StatusOr<Acknowledgement>& result) = 0;

  // Whether the checks that the batch makes fall due are run.
  virtual bool wants_candidates() const { return false; }
  // Whose checks they are, among those who share the threads of searches.
  virtual std::string check_flow() const { return "checks"; }
  // Search options of these checks, for a vehicle of this config.
  // INVALID_ARGUMENT if the options that the client sent do not fit it.
  virtual absl::StatusOr<core::SearchOptions> CheckOptions(
      const VehicleConfig& config) const {
    return config.drive.search;
  }
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

#endif  // REVISIT_SERVER_SESSIONS_APPEND_SINK_H_
