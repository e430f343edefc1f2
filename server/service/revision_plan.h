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

// Reads the batches that hold the poses of the draft, and replaces these poses.
// If `expected` is not 0, it must be the revision of the vehicle, unless the
// result of the change is stored already: then the answer to an earlier call
// got lost. Ends early, with that status, once the call was given up. Shows the
// poses before and after to `kept`.
absl::StatusOr<RevisionPlan> PlanRevision(
    Storage* storage, const VehicleView& view,
    const std::shared_ptr<RevisionDraft>& draft, std::uint64_t expected,
    const Call& call, KeptCovariances* kept);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SERVICE_REVISION_PLAN_H_
