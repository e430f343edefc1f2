// What the answer of a stored check depends on, as a number: where it is what
// it was, a search would answer what it did.
#ifndef REVISIT_SERVER_SESSIONS_CHECK_BASIS_H_
#define REVISIT_SERVER_SESSIONS_CHECK_BASIS_H_

#include <cstdint>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "core/drive/node_index.h"
#include "server/sessions/check_codec.h"
#include "server/sessions/check_scopes.h"
#include "server/sessions/vehicle_state.h"

namespace revisit::server {

// A check depends on the vehicle's settings, the estimates at its pose and at
// those matched, the loop closures and the rejected candidates up to it, which
// also count for what marks before it have shown, and the rejected candidates
// beside it. In a group it depends on where the vehicle was placed there, and
// on the loop closures and rejected candidates between it and others, by the
// same rules. What others have driven since, and what ties these to each other,
// is left out: the check is about what was known of that then. What closures
// far from the check do to the scale of covariances
// (VehicleSettings.apply_inflation) is left out, or each closure would have all
// checks searched again. Numbers are the same in all processes, so that they
// are stored. Belongs to the session's strand.
class CheckBasis {
 public:
  // Counts the changes on which any check's number may depend.
  struct Version {
    std::uint64_t drive = 0;
    std::uint64_t config = 0;
    std::uint64_t pairs = 0;
    std::uint64_t ties = 0;
  };

  // `searches_groups`: whether checks search in the group that the vehicle's
  // settings name.
  CheckBasis(const VehicleState* vehicle, bool searches_groups)
      : vehicle_(vehicle), searches_groups_(searches_groups) {}

  // Tells what a group says, unless something newer is known of it.
  void Learn(const std::string& group_id, CheckTiesPtr ties);
  // Whether it was told what the group says in which checks search, if any.
  bool knows_ties() const {
    return Group().empty() || (ties_ != nullptr && ties_of_ == Group());
  }
  // Whether these are all that it knows to tie the vehicle; null: nothing.
  bool IsTiedBy(const CheckTiesPtr& ties) const;

  // O(1). REQUIRES, as for Of(): the vehicle is loaded.
  Version version() const;
  // O(log pairs + ties), after O(pairs log pairs) once a version. REQUIRES:
  // knows_ties().
  std::uint64_t Of(std::uint64_t check_sequence,
                   const std::vector<StoredCandidate>& candidates);
  // The number of a check that was searched with these ties; null: with none.
  std::uint64_t Of(std::uint64_t check_sequence,
                   const std::vector<StoredCandidate>& candidates,
                   const CheckTiesPtr& ties);

 private:
  // Hashes of pairs by where they are, each the sum of those before it and its
  // own.
  class SumsByPlace {
   public:
    void Clear() { sums_.clear(); }
    void Add(double place, std::uint64_t hash) {
      sums_.emplace_back(place, hash);
    }
    void Finish();
    // The sum of the hashes at places up to this one, and below it.
    std::uint64_t UpTo(double place) const;
    std::uint64_t Below(double place) const;

   private:
    std::vector<std::pair<double, std::uint64_t>> sums_;
  };

  // Empty if none is searched.
  const std::string& Group() const;
  void Refresh();
  // How far from a rejected candidate, along the path, a search heeds it.
  double RejectionRadius() const;
  // Joins the ties that concern a check at a node to `hash`; where there are
  // none, it is `hash` itself.
  std::uint64_t JoinedTies(std::uint64_t hash, core::NodeIndex node,
                           const CheckTiesPtr& ties) const;

  const VehicleState* const vehicle_;
  const bool searches_groups_;
  // Null if unknown.
  CheckTiesPtr ties_;
  std::uint64_t ties_hash_ = 0;
  std::string ties_of_;
  std::uint64_t ties_version_ = 0;
  std::optional<Version> version_;
  std::uint64_t settings_ = 0;
  // All pairs by the index of their later node; rejected candidates also by the
  // distances travelled at their two poses.
  SumsByPlace pairs_;
  SumsByPlace rejected_queries_;
  SumsByPlace rejected_matches_;
};

inline bool operator==(const CheckBasis::Version& a,
                       const CheckBasis::Version& b) {
  return a.drive == b.drive && a.config == b.config && a.pairs == b.pairs &&
         a.ties == b.ties;
}
inline bool operator!=(const CheckBasis::Version& a,
                       const CheckBasis::Version& b) {
  return !(a == b);
}

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SESSIONS_CHECK_BASIS_H_
