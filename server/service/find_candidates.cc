#include "server/service/find_candidates.h"

#include <chrono>
#include <cstdint>
#include <optional>

#include "absl/strings/str_cat.h"
#include "core/engine.h"
#include "server/base/status.h"
#include "server/conversion/answers.h"
#include "server/conversion/vehicle_settings.h"
#include "server/sessions/vehicle_session.h"
#include "server/settings/limits.h"

namespace revisit::server {
namespace {

// The node at which to ask; nothing if the vehicle has none.
absl::StatusOr<std::optional<core::NodeIndex>> QueryNode(
    const VehicleView& view, std::uint64_t sequence) {
  const core::PoseGraph& graph = view.engine.graph();
  if (sequence > view.durable_sequence) {
    return PoseNotFound(view.id, sequence, view.durable_sequence);
  }
  if (sequence > 0) return graph.NodeAtOrBefore(sequence);
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

absl::Status Find(UnaryCall* call, const Limits& limits,
                  const VehicleView& view,
                  const v1::FindCandidatesRequest& request,
                  v1::FindCandidatesResponse* response) {
  // The call may have waited long behind other work.
  if (call->given_up()) return call->GivenUpStatus();
  // Candidates in the part that is damaged would be missed without a word.
  if (!view.damage.ok()) return view.damage;
  absl::StatusOr<core::SearchOptions> options = DecodeCandidateOptions(
      request.options(), view.config, kRequest.Field("options"));
  if (!options.ok()) return options.status();
  options->max_comparisons = limits.max_search_steps;
  const auto query = QueryNode(view, request.sequence());
  if (!query.ok()) return query.status();
  const auto stop = [call] { return call->given_up(); };
  const auto start = std::chrono::steady_clock::now();
  const absl::StatusOr<core::CandidateSet> found =
      *query ? view.engine.FindCandidates(**query, *options, stop, view.marks)
             : view.engine.FindCandidates(*options, stop, view.marks);
  const auto duration = std::chrono::steady_clock::now() - start;
  call->SearchTook(duration);
  call->Searched(found, duration);
  if (absl::IsCancelled(found.status())) return call->GivenUpStatus();
  if (!found.ok()) return found.status();
  if (found->empty_reason == core::EmptyReason::kTooMuchWork) {
    return TooMuchWork(found->comparisons, limits.max_search_steps);
  }
  EncodeCandidateSet(view, *found, request.options().include_aligned_path(),
                     duration, response->mutable_candidates());
  return absl::OkStatus();
}

}  // namespace

absl::Status FindCandidates(const ServiceContext& context,
                            const UnaryCallPtr& call,
                            const v1::FindCandidatesRequest& request,
                            v1::FindCandidatesResponse* response) {
  const auto session = SessionOf(context, request.vehicle(),
                                 kRequest.Field("vehicle"), call.get());
  if (!session.ok()) return session.status();
  if (absl::Status status = call->AdmitSearch(); !status.ok()) return status;
  (*session)->Search(FinishWith<VehicleView>(
      call, [=, limits = context.limits,
             request = &request](const VehicleView& view) {
        return Find(call.get(), limits, view, *request, response);
      }));
  return absl::OkStatus();
}

}  // namespace revisit::server
