// Decides on stored candidates in the histories of other vehicles by the group
// in which each was found, whichever one checks search in since: loop closures
// between the two vehicles confirm those at their places, rejected candidates
// reject them, and those of vehicles that are members no more are withdrawn.
//
// Any server writes a group, so the one that has the vehicle looks from time to
// time whether a group was changed, and then through the rows, a page at a
// time, between other work of the vehicle. What is to be changed follows from
// the rows and the group, so whoever loads the vehicle comes to the same, and
// nothing is told twice. What the group says in which checks search is told to
// the basis of checks too.
#ifndef REVISIT_SERVER_SESSIONS_LINK_DECISIONS_H_
#define REVISIT_SERVER_SESSIONS_LINK_DECISIONS_H_

#include <atomic>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <map>
#include <optional>
#include <string>
#include <utility>

#include "absl/status/statusor.h"
#include "server/sessions/check_basis.h"
#include "server/sessions/check_changes.h"
#include "server/sessions/check_scopes.h"
#include "server/sessions/check_steps.h"
#include "server/sessions/vehicle_queue.h"
#include "server/sessions/vehicle_state.h"
#include "server/storage/records.h"

namespace revisit::server {

// Belongs to the strand, but for what is said to be called from any thread.
class LinkDecisions {
 public:
  // `scopes`: null where no checks search in groups. Calls `learned` when
  // checks may depend on what the group says since.
  LinkDecisions(VehicleState* vehicle, VehicleQueue* queue,
                const CheckChanges* changes, CheckBasis* basis,
                CheckScopes* scopes, std::function<void()> learned)
      : vehicle_(vehicle),
        queue_(queue),
        changes_(changes),
        basis_(basis),
        scopes_(scopes),
        learned_(std::move(learned)),
        steps_(vehicle, queue, changes) {}

  LinkDecisions(const LinkDecisions&) = delete;
  LinkDecisions& operator=(const LinkDecisions&) = delete;

  // Goes on. Call after a load and every change; costs next to nothing where
  // there is nothing to do.
  void Consider();
  // Whether LookAgain() is to be called from time to time. From any thread.
  bool is_watching() const { return is_watching_.load(); }
  // Groups may have been changed.
  void LookAgain();
  // A row has this candidate. Call for each row that is read anyway: so the
  // groups are known of which there are candidates.
  void Note(const StoredCandidate& candidate);
  // The check at this pose was stored with this candidate, or has it since.
  void LookAt(std::uint64_t check_sequence, const StoredCandidate& candidate);

 private:
  // A group that decides.
  struct Watched {
    // Whether it is to be asked for.
    bool asks = true;
    // Whether a stored candidate was found in it.
    bool has_candidates = false;
    // Whether all rows were looked at as of a version, but for those from
    // `new_from` on.
    bool is_looked_at = false;
    std::optional<GroupVersion> version;
    std::optional<std::uint64_t> new_from;
  };

  bool MayLook() const;
  // Watches the group in which checks search, and no other one unless a
  // candidate was found there.
  void FollowSettings();
  void Ask(const std::string& group);
  void Take(CheckGroupPtr group);
  // Goes on with another group.
  void EndLook();
  void LookAtNextPage();
  absl::StatusOr<ChecksWrite> LookAtPage();
  void LookAt(const CheckRecord& record, ChecksWrite* write);
  // The state into which the group has a candidate come, if it is another one.
  std::optional<CandidateTransition> Judge(
      std::uint64_t check_sequence, const StoredCandidate& candidate) const;
  // The link that decides a candidate, or null; a loop closure before a
  // rejected candidate.
  const CheckGroup::Link* FindLink(std::uint64_t check_sequence,
                                   const StoredCandidate& candidate) const;
  bool IsThere(const StoredCandidate& candidate) const;

  VehicleState* const vehicle_;
  VehicleQueue* const queue_;
  const CheckChanges* const changes_;
  CheckBasis* const basis_;
  CheckScopes* const scopes_;
  const std::function<void()> learned_;
  CheckSteps steps_;

  // By id.
  std::map<std::string, Watched> watched_;
  // A group is asked for, or looked at.
  bool is_at_work_ = false;
  // ---- The look
  std::string group_id_;
  CheckGroupPtr group_;
  std::uint64_t look_from_ = 0;

  std::atomic<bool> is_watching_{false};
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SESSIONS_LINK_DECISIONS_H_
