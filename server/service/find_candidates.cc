#include "server/service/find_candidates.h"

#include <cstdint>
#include <memory>
#include <optional>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/drive/drive.h"
#include "core/drive/pose_graph.h"
#include "core/settings.h"
#include "server/base/status.h"
#include "server/conversion/answers.h"
#include "server/conversion/vehicle_settings.h"
#include "server/fleet/group_scope.h"
#include "server/fleet/group_searches.h"
#include "server/service/group_search.h"
#include "server/sessions/search_turns.h"
#include "server/sessions/vehicle_session.h"
#include "server/settings/limits.h"

namespace revisit::server {
namespace {

// The node at which to ask; nothing if the vehicle has none.
absl::StatusOr<std::optional<core::NodeIndex>> QueryNode(
    const VehicleView& view, std::uint64_t sequence) {
  const core::PoseGraph& graph = view.drive.graph();
  if (sequence > view.durable_sequence) {
    return PoseNotFound(view.id, sequence, view.durable_sequence);
  }
  if (sequence > 0) {
    const absl::Status kept = CheckKept(view, sequence);
    if (!kept.ok()) return kept;
    return graph.NodeAtOrBefore(sequence);
  }
  if (graph.size() == 0) return std::optional<core::NodeIndex>();
  return std::optional<core::NodeIndex>(graph.size() - 1);
}

absl::Status TooMuchWork(std::int64_t got, std::int64_t limit) {
  return Error(
      absl::StatusCode::kOutOfRange, "LIMIT_EXCEEDED",
      absl::StrCat("the search would compare ", got,
                   " pairs of nodes; allowed are ", limit,
                   ": take a shorter sequence, a longer node spacing or one "
                   "direction"),
      {{"got", absl::StrCat(got)}, {"limit", absl::StrCat(limit)}});
}

// Takes a turn of the search. Returns the status to end the call with, or
// nothing if the search needs another turn.
std::optional<absl::Status> TakeTurn(UnaryCall* call, const Limits& limits,
                                     const absl::StatusOr<VehicleView>& read,
                                     const v1::FindCandidatesRequest& request,
                                     const GroupScope* scope,
                                     SearchTurns* search,
                                     v1::FindCandidatesResponse* response) {
  // The call may have waited long behind other work.
  if (call->given_up()) return call->GivenUpStatus();
  if (!read.ok()) return read.status();
  const VehicleView& view = *read;
  // Candidates in the part that is damaged would be missed without a word.
  if (!view.damage.ok()) return view.damage;
  absl::StatusOr<core::SearchOptions> options = DecodeCandidateOptions(
      request.options(), view.config, kRequest.Field("options"));
  if (!options.ok()) return options.status();
  options->max_comparisons = limits.max_search_steps;
  const auto query = QueryNode(view, request.sequence());
  if (!query.ok()) return query.status();
  // It was not used up when the call came, but may be by now.
  if (absl::Status status = call->searches().CheckSteps(); !status.ok()) {
    return status;
  }
  const auto stop = [call] { return call->given_up(); };
  std::optional<absl::StatusOr<core::CandidateSet>> answer;
  if (*query) {
    answer = search->Take(view, **query, *options, stop,
                          scope == nullptr ? nullptr : &scope->scope);
  } else {
    answer = view.search->AtEnd(*options, stop);
  }
  call->searches().Took(search->last_turn(), search->last_steps());
  if (!answer) return std::nullopt;
  const absl::StatusOr<core::CandidateSet>& found = *answer;
  call->record().Searched(found, search->all_turns());
  if (absl::IsCancelled(found.status())) return call->GivenUpStatus();
  if (absl::IsResourceExhausted(found.status()))
    return call->searches().TooManySteps();
  if (!found.ok()) return found.status();
  if (found->empty_reason == core::EmptyReason::kTooMuchWork) {
    return TooMuchWork(found->comparisons, limits.max_search_steps);
  }
  EncodeCandidateSet(view, *found, request.options().include_aligned_path(),
                     search->all_turns(), response->mutable_candidates(),
                     scope);
  return absl::OkStatus();
}

// A call on its way. All of it lives as long as the call.
struct Finding {
  UnaryCallPtr call;
  std::shared_ptr<VehicleSession> session;
  const v1::FindCandidatesRequest* request;
  v1::FindCandidatesResponse* response;
  Limits limits;
};

// Searches in turns, and ends the call. `scope`: null for the vehicle's own
// history alone.
void Search(const Finding& finding, std::shared_ptr<const GroupScope> scope) {
  const auto search =
      std::make_shared<SearchTurns>(finding.limits.max_search_steps);
  finding.session->Search(
      finding.call->searches().search_flow(),
      [call = finding.call, request = finding.request,
       response = finding.response, limits = finding.limits, search,
       scope = std::move(scope)](const absl::StatusOr<VehicleView>& view) {
        const std::optional<absl::Status> end =
            TakeTurn(call.get(), limits, view, *request, scope.get(),
                     search.get(), response);
        if (end) call->End(*end);
        return end.has_value();
      });
}

// Gets the scope ready once the vehicle is loaded, whose own history is a part
// of it.
void SearchInGroup(const Finding& finding, const ScopeRequest& scope,
                   GroupSearches* groups) {
  finding.session->Read([finding, scope,
                         groups](const absl::StatusOr<VehicleView>& view) {
    const absl::Status status = view.ok() ? view->damage : view.status();
    if (!status.ok()) {
      finding.call->End(status);
      return;
    }
    groups->Prepare(scope, [finding](absl::StatusOr<GroupScope> ready) {
      if (finding.call->given_up() || !ready.ok()) {
        finding.call->End(ready.ok() ? finding.call->GivenUpStatus()
                                     : ready.status());
        return;
      }
      Search(finding, std::make_shared<const GroupScope>(*std::move(ready)));
    });
  });
}

}  // namespace

absl::Status FindCandidates(const ServiceContext& service,
                            const UnaryCallPtr& call,
                            const v1::FindCandidatesRequest& request,
                            v1::FindCandidatesResponse* response) {
  const auto id =
      ParseVehicleName(request.vehicle(), kRequest.Field("vehicle"));
  if (!id.ok()) return id.status();
  const auto session = SessionOf(service, request.vehicle(),
                                 kRequest.Field("vehicle"), call.get());
  if (!session.ok()) return session.status();
  absl::StatusOr<ScopeRequest> scope = ScopeRequest();
  if (request.options().has_scope()) {
    const FieldPath options = kRequest.Field("options");
    scope = DecodeScope(request.options().scope(), *id, options.Field("scope"),
                        call.get());
  }
  if (!scope.ok()) return scope.status();
  if (absl::Status status = call->searches().TakeRoom(); !status.ok())
    return status;
  const Finding finding{call, *session, &request, response, service.limits};
  if (request.options().has_scope()) {
    SearchInGroup(finding, *scope, service.group_searches);
  } else {
    Search(finding, nullptr);
  }
  return absl::OkStatus();
}

}  // namespace revisit::server
