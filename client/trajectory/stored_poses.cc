#include "client/trajectory/stored_poses.h"

#include "client/answers/pages.h"

namespace revisit::client {

absl::Status VisitPoses(
    const Client& client, const std::string& vehicle,
    const std::function<absl::Status(const v1::Pose&)>& visit) {
  constexpr int kPagePoses = 10'000;
  v1::ListPosesRequest request;
  request.set_parent(vehicle);
  request.set_page_size(kPagePoses);
  return VisitPages(
      request,
      [&](const v1::ListPosesRequest& asked) {
        return client.ListPoses(asked);
      },
      [](const v1::ListPosesResponse& page) -> const auto& {
        return page.poses();
      },
      [&](const v1::ListPosesResponse& page) -> absl::StatusOr<bool> {
        for (const v1::Pose& pose : page.poses()) {
          if (absl::Status status = visit(pose); !status.ok()) return status;
        }
        return true;
      });
}

absl::StatusOr<std::vector<v1::LoopClosure>> ReadLoopClosures(
    const Client& client, const std::string& vehicle) {
  constexpr int kPageSize = 1000;
  std::vector<v1::LoopClosure> all;
  v1::ListLoopClosuresRequest request;
  request.set_parent(vehicle);
  request.set_page_size(kPageSize);
  const absl::Status status = VisitPages(
      request,
      [&](const v1::ListLoopClosuresRequest& asked) {
        return client.ListLoopClosures(asked);
      },
      [](const v1::ListLoopClosuresResponse& page) -> const auto& {
        return page.loop_closures();
      },
      [&](const v1::ListLoopClosuresResponse& page) -> absl::StatusOr<bool> {
        all.insert(all.end(), page.loop_closures().begin(),
                   page.loop_closures().end());
        return true;
      });
  if (!status.ok()) return status;
  return all;
}

absl::StatusOr<std::vector<v1::RejectedCandidate>> ReadRejectedCandidates(
    const Client& client, const std::string& vehicle) {
  constexpr int kPageSize = 1000;
  std::vector<v1::RejectedCandidate> all;
  v1::ListRejectedCandidatesRequest request;
  request.set_parent(vehicle);
  request.set_page_size(kPageSize);
  const absl::Status status = VisitPages(
      request,
      [&](const v1::ListRejectedCandidatesRequest& asked) {
        return client.ListRejectedCandidates(asked);
      },
      [](const v1::ListRejectedCandidatesResponse& page) -> const auto& {
        return page.rejected_candidates();
      },
      [&](const v1::ListRejectedCandidatesResponse& page)
          -> absl::StatusOr<bool> {
        all.insert(all.end(), page.rejected_candidates().begin(),
                   page.rejected_candidates().end());
        return true;
      });
  if (!status.ok()) return status;
  return all;
}

absl::StatusOr<v1::Vehicle> ReadVehicle(const Client& client,
                                        const std::string& vehicle) {
  v1::GetVehicleRequest request;
  request.set_name(vehicle);
  const auto response = client.GetVehicle(request);
  if (!response.ok()) return response.status();
  return response->vehicle();
}

}  // namespace revisit::client
