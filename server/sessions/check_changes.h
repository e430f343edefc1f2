// The rows of a vehicle's stored checks: how they are read, and how a change of
// a candidate becomes a row and an event.
#ifndef REVISIT_SERVER_SESSIONS_CHECK_CHANGES_H_
#define REVISIT_SERVER_SESSIONS_CHECK_CHANGES_H_

#include <cstddef>
#include <cstdint>
#include <optional>
#include <string>
#include <utility>

#include "core/drive/pose_graph.h"
#include "core/search/candidates/candidate.h"
#include "core/search/candidates/value.h"
#include "server/sessions/check_codec.h"
#include "server/sessions/check_scopes.h"
#include "server/sessions/vehicle_state.h"
#include "server/storage/records.h"

namespace revisit::server {

// The pose with which a node came.
std::uint64_t PoseOf(const core::PoseGraph& graph, core::NodeIndex index);
// The distance travelled up to the last node at or before a pose.
double TravelledAt(const core::PoseGraph& graph, std::uint64_t sequence);
// The poses within core::kPlaceRadiusMeters of a node, along the path: the
// first and the last one. `last_sequence`: of all poses; those behind the last
// node are at it, as far as the graph tells. REQUIRES: the graph has nodes.
std::pair<std::uint64_t, std::uint64_t> PlaceAround(
    const core::PoseGraph& graph, core::NodeIndex node,
    std::uint64_t last_sequence);
// Fills in where the matched node of a candidate is. `graph`: that of the
// vehicle that is checked; `scope`: of the search; null for its own history
// alone.
void SetMatch(const core::PoseGraph& graph, const core::Candidate& candidate,
              const CheckScope* scope, StoredCandidate* stored);
// 0 of alignments that know none.
double ProbabilityOf(const core::Candidate& candidate);
// Whether a candidate is worth keeping. Of alignments that know no probability,
// those are which pass.
bool IsWorthKeeping(const core::Candidate& candidate, double keep_probability);

// A state that a candidate comes into.
struct CandidateTransition {
  CandidateState state;
  CandidateCause cause;
  std::string actor;
  std::int64_t time_ns = 0;
  std::string decision;
};

// Belongs to the session's strand, as the vehicle does.
class CheckChanges {
 public:
  // `codec`: null where no checks are stored.
  CheckChanges(const VehicleState* vehicle, const CheckCodec* codec)
      : vehicle_(vehicle), codec_(codec) {}

  // Null where no checks are stored.
  const CheckCodec* codec() const { return codec_; }
  // Whether checks may be made and written at all.
  bool MayWork() const;
  // Whether a change could concern a stored candidate at all.
  bool HasCandidates() const {
    return codec_ != nullptr && vehicle_->head.checks().last_event > 0;
  }

  // A write that changes nothing yet. REQUIRES, as what adds to it: no other
  // write of the vehicle is under way until it is done.
  ChecksWrite Begin() const;
  // Nothing if the row is damaged: such a check is left as it is.
  std::optional<StoredCheck> Read(const CheckRecord& record) const;
  // Adds the row of the check, in place of the one that the write has of it.
  void Put(const CheckRecord& record, const StoredCheck& check,
           ChecksWrite* write) const;
  // Has candidate `index` of the check come into a state, and adds the row and
  // the event.
  void Change(const CheckRecord& record, StoredCheck* check, std::size_t index,
              const CandidateTransition& transition, ChecksWrite* write) const;
  // Adds the event of candidate `index`, which then has its number.
  void Tell(std::uint64_t sequence, StoredCheck* check, std::size_t index,
            ChecksWrite* write) const;

  // The path of the vehicle's own pose.
  double TravelledAt(std::uint64_t sequence) const;
  // Whether two of its poses lie within core::kPlaceRadiusMeters along the
  // path.
  bool AreNear(std::uint64_t a, std::uint64_t b) const;
  // Whether the pair's places are those of a candidate of the check at a pose:
  // never if that is in the history of another vehicle.
  bool IsPair(const PosePairRecord& pair, std::uint64_t query,
              const StoredCandidate& candidate) const;
  // Has a pair that is there decide on a candidate that was just found.
  void Decide(std::uint64_t sequence, StoredCandidate* candidate) const;
  // For ValueOf(), as long as the vehicle does not change.
  core::VarianceReductions Reductions() const {
    return core::VarianceReductions(*vehicle_->loaded);
  }
  // StoredCandidate::value, given the closures that there are: 0 of one in the
  // history of another vehicle.
  double ValueOf(std::uint64_t sequence, const StoredCandidate& candidate,
                 core::VarianceReductions* reductions) const;

  static std::uint32_t OpenCount(const StoredCheck& check);

 private:
  const VehicleState* const vehicle_;
  const CheckCodec* const codec_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SESSIONS_CHECK_CHANGES_H_
