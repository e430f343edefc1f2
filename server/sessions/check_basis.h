// What the answer of a stored check depends on, as a number: where it is what
// it was, a search would answer what it did.
#ifndef REVISIT_SERVER_SESSIONS_CHECK_BASIS_H_
#define REVISIT_SERVER_SESSIONS_CHECK_BASIS_H_

#include <cstdint>
#include <optional>
#include <utility>
#include <vector>

#include "server/sessions/check_codec.h"
#include "server/sessions/vehicle_state.h"

namespace revisit::server {

// A check depends on the vehicle's settings, the estimates at its pose and at
// those matched, the loop closures and the rejected candidates up to it, which
// also count for what marks before it have shown, and the rejected candidates
// beside it. What other vehicles have driven, and what is known of where, is
// left out: the check is about what was known of that then. What closures far
// from the check do to the scale of covariances
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
  };

  explicit CheckBasis(const VehicleState* vehicle) : vehicle_(vehicle) {}

  // O(1). REQUIRES, as for Of(): the vehicle is loaded.
  Version version() const;
  // O(log pairs), after O(pairs log pairs) once a version.
  std::uint64_t Of(std::uint64_t check_sequence,
                   const std::vector<StoredCandidate>& candidates);

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

  void Refresh();

  const VehicleState* const vehicle_;
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
  return a.drive == b.drive && a.config == b.config && a.pairs == b.pairs;
}
inline bool operator!=(const CheckBasis::Version& a,
                       const CheckBasis::Version& b) {
  return !(a == b);
}

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SESSIONS_CHECK_BASIS_H_
