// The plan of a revision, made of the poses in its draft and of what is
// stored.
#ifndef REVISIT_SERVER_SERVICE_REVISION_PLAN_H_
#define REVISIT_SERVER_SERVICE_REVISION_PLAN_H_

#include <cstdint>
#include <memory>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/service/call.h"
#include "server/service/kept_covariances.h"
#include "server/sessions/vehicle_session.h"
#include "server/sessions/vehicle_view.h"
#include "server/storage/revision_draft.h"
#include "server/storage/storage.h"

namespace revisit::server {

// ABORTED (REVISION_MISMATCH): the vehicle is not at the expected revision.
absl::Status RevisionMismatch(const VehicleView& view, std::uint64_t expected);

// Terms that a revision brings beside its poses.
struct RevisionTerms {
  // If not 0, the revision that the vehicle has to have, unless the result of
  // the change is stored already: then the answer to an earlier call got lost.
  std::uint64_t expected_revision = 0;
  // The poses are all in one frame, and all that are kept have to be named:
  // INVALID_ARGUMENT (INVALID_FIELD) if one is missing.
  bool has_common_frame = false;
};

// Reads the batches that hold the poses of the draft, and replaces these poses.
// Ends early, with that status, once the call was given up. Shows the poses
// before and after to `kept`, but for those that go into another frame.
absl::StatusOr<RevisionPlan> PlanRevision(
    Storage* storage, const VehicleView& view,
    const std::shared_ptr<RevisionDraft>& draft, const RevisionTerms& terms,
    const Call& call, KeptCovariances* kept);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SERVICE_REVISION_PLAN_H_
