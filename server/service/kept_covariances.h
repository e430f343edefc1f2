// Judges whether revised poses have moved farther than the covariances that
// they kept: an optimiser has corrected errors that these do not claim.
#ifndef REVISIT_SERVER_SERVICE_KEPT_COVARIANCES_H_
#define REVISIT_SERVER_SERVICE_KEPT_COVARIANCES_H_

#include <cstdint>
#include <optional>
#include <vector>

#include "core/geometry/pose.h"
#include "core/geometry/state_space.h"
#include "revisit/v1/pose_graph_service.pb.h"

namespace revisit::server {

class KeptCovariances {
 public:
  explicit KeptCovariances(core::StateSpace space);

  // Compares the poses of a batch before and after the revision. REQUIRES: both
  // have the same sequences.
  void Look(const std::vector<core::PoseSample>& before,
            const std::vector<core::PoseSample>& after);

  // A warning, if more poses have moved too far than chance moves: more than
  // one of a hundred of those that were revised.
  std::optional<v1::Warning> Judge() const;

 private:
  core::StateSpace space_;
  // The square of a Mahalanobis distance that 99.7 % of errors do not reach.
  double most_;
  std::int64_t revised_ = 0;
  std::int64_t outrun_ = 0;
  // The pose that moved farthest for its covariance.
  std::uint64_t sequence_ = 0;
  double squared_ = 0.0;
  double meters_ = 0.0;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SERVICE_KEPT_COVARIANCES_H_
