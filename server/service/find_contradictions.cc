#include "server/service/find_contradictions.h"

#include <chrono>

#include "core/drive/suspects.h"
#include "server/base/status.h"
#include "server/conversion/names.h"
#include "server/sessions/contradicted_closures.h"
#include "server/sessions/fair_executor.h"
#include "server/sessions/vehicle_session.h"

namespace revisit::server {
namespace {

// Returns the status to end the call with.
absl::Status Find(UnaryCall* call, const absl::StatusOr<VehicleView>& read,
                  v1::FindContradictionsResponse* response) {
  // The call may have waited long behind other work.
  if (call->given_up()) return call->GivenUpStatus();
  if (!read.ok()) return read.status();
  const VehicleView& view = *read;
  if (!view.damage.ok()) return view.damage;
  if (absl::Status status = call->searches().CheckSteps(); !status.ok()) {
    return status;
  }
  const auto begin = std::chrono::steady_clock::now();
  std::chrono::steady_clock::duration waited{};
  core::SuspectSearch search(view.drive);
  const bool is_done = search.Run([&] {
    waited += FairExecutor::Yield();
    return call->given_up();
  });
  if (!is_done) return call->GivenUpStatus();
  call->searches().Took(std::chrono::steady_clock::now() - begin - waited,
                        /*steps=*/0);
  for (const auto& [id, p_value] :
       NameSuspects(*view.loop_closures, search.suspects())) {
    v1::Contradiction* const contradiction = response->add_contradictions();
    contradiction->set_loop_closure(
        PosePairResourceName(PairKind::kLoopClosure, view.id, id));
    contradiction->set_p_value(p_value);
  }
  response->set_revision(view.revision);
  return absl::OkStatus();
}

}  // namespace

absl::Status FindContradictions(const ServiceContext& service,
                                const UnaryCallPtr& call,
                                const v1::FindContradictionsRequest& request,
                                v1::FindContradictionsResponse* response) {
  const auto session = SessionOf(service, request.vehicle(),
                                 kRequest.Field("vehicle"), call.get());
  if (!session.ok()) return session.status();
  if (absl::Status status = call->searches().TakeRoom(); !status.ok())
    return status;
  (*session)->Search(call->searches().search_flow(),
                     [=](const absl::StatusOr<VehicleView>& view) {
                       call->End(Find(call.get(), view, response));
                       return true;
                     });
  return absl::OkStatus();
}

}  // namespace revisit::server
