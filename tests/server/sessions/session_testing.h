// Shared by tests of sessions and the fleet.
#ifndef REVISIT_TESTS_SERVER_SESSIONS_SESSION_TESTING_H_
#define REVISIT_TESTS_SERVER_SESSIONS_SESSION_TESTING_H_

#include <cstdint>
#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/settings.h"
#include "server/sessions/fleet.h"
#include "server/sessions/vehicle_session.h"
#include "tests/server/waiting.h"

namespace revisit::server {

// A vehicle's view, to keep.
struct Snapshot {
  std::uint64_t durable_sequence = 0;
  std::uint64_t revision = 0;
  std::int64_t loop_closure_count = 0;
  core::Consistency consistency;
  VehicleConfig config;
  // Every number of every node, and the loop edges, as text.
  std::string graph;
  std::int64_t node_count = 0;
  // The first pose that is kept, and how many were dropped.
  std::uint64_t first_kept = 1;
  std::uint64_t dropped = 0;
  double travelled_meters = 0.0;
  // Candidates at the newest node, as text.
  std::string candidates;
  absl::Status damage;
  bool config_is_known = true;
};

// Nodes 1 m apart, 10 m sequences, a check every 5 m.
VehicleConfig TestConfig();

Snapshot Take(const VehicleView& view);
absl::StatusOr<Snapshot> Take(const absl::StatusOr<VehicleView>& view);
// The callback of a creation.
CreateCallback TakingCreated(const Answer<absl::StatusOr<Snapshot>>& answer);
// The callback of a call that answers with a view.
std::function<void(absl::StatusOr<VehicleView>)> Taking(
    const Answer<absl::StatusOr<Snapshot>>& answer);

// The calls of a session, waited for.
absl::StatusOr<Snapshot> ReadNow(VehicleSession& session);
absl::StatusOr<Snapshot> CheckAcknowledgedNow(VehicleSession& session,
                                              std::uint64_t acked_sequence,
                                              const std::string& uid = "");
absl::StatusOr<Snapshot> AcceptDataLossNow(VehicleSession& session,
                                           std::uint64_t durable_sequence);
absl::StatusOr<Snapshot> UpdateNow(
    VehicleSession& session,
    const std::function<absl::StatusOr<VehicleConfig>(const VehicleView&)>&
        change);
absl::StatusOr<RevisionResult> ReviseNow(
    VehicleSession& session,
    const std::function<absl::StatusOr<RevisionPlan>(const VehicleView&)>&
        plan);
absl::StatusOr<AddedPair> AddPairNow(VehicleSession& session, PairKind kind,
                                     const PosePairRecord& pair);
absl::StatusOr<std::uint64_t> DeletePairNow(VehicleSession& session,
                                            PairKind kind,
                                            const std::string& id,
                                            const PairDeletion& deletion = {});
absl::Status DeleteNow(VehicleSession& session);
void CloseNow(VehicleSession& session);

// The end that an append came to.
struct Appended {
  Answer<absl::Status> staged;
  Answer<absl::StatusOr<Acknowledgement>> durable;
};

// Asks for a batch of plain_codec.h, and for its checks if wanted, with the
// vehicle's own options if `options` is empty.
AppendRequest PlainRequest(const std::string& payload,
                           bool wants_checks = false,
                           SearchOptionsDecoder options = nullptr);

// Appends a batch of plain_codec.h; hears of it by functions, each of which may
// be empty.
class PlainAppend final : public AppendObserver {
 public:
  explicit PlainAppend(std::string payload) : payload_(std::move(payload)) {}

  // The request as the members below say.
  AppendRequest Request() const {
    return PlainRequest(payload_, wants, options);
  }

  void OnStaged(const absl::Status& status) override;
  void OnDurable(const absl::StatusOr<Acknowledgement>& result) override;
  bool ShouldStop() const override;
  void OnCandidates(const VehicleView& view,
                    const absl::StatusOr<core::CandidateSet>& set,
                    std::chrono::nanoseconds duration) override;
  void OnOver() override;

  std::function<void(absl::Status)> staged;
  std::function<void(absl::StatusOr<Acknowledgement>)> durable;
  std::function<void(const VehicleView&,
                     const absl::StatusOr<core::CandidateSet>&)>
      candidates;
  bool wants = false;
  // Empty for those of the vehicle.
  SearchOptionsDecoder options;
  std::function<bool()> should_stop;
  std::function<void()> over;

 private:
  const std::string payload_;
};

Appended Append(VehicleSession& session, const std::string& payload);
absl::StatusOr<Acknowledgement> AppendNow(VehicleSession& session,
                                          const std::string& payload);

}  // namespace revisit::server

#endif  // REVISIT_TESTS_SERVER_SESSIONS_SESSION_TESTING_H_
