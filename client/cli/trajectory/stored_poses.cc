#include "client/cli/trajectory/stored_poses.h"

namespace revisit::client {

absl::Status VisitPoses(
    const Client& client, const std::string& vehicle,
    const std::function<absl::Status(const v1::Pose&)>& visit) {
  constexpr int kPagePoses = 10'000;
  v1::ListPosesRequest request;
  request.set_parent(vehicle);
  request.set_page_size(kPagePoses);
  do {
    const auto page = client.ListPoses(request);
    if (!page.ok()) return page.status();
    for (const v1::Pose& pose : page->poses()) {
      if (absl::Status status = visit(pose); !status.ok()) return status;
    }
    request.set_page_token(page->next_page_token());
  } while (!request.page_token().empty());
  return absl::OkStatus();
}

absl::StatusOr<std::vector<v1::LoopClosure>> ReadLoopClosures(
    const Client& client, const std::string& vehicle) {
  constexpr int kPageSize = 1000;
  std::vector<v1::LoopClosure> all;
  v1::ListLoopClosuresRequest request;
  request.set_parent(vehicle);
  request.set_page_size(kPageSize);
  do {
    const auto page = client.ListLoopClosures(request);
    if (!page.ok()) return page.status();
    all.insert(all.end(), page->loop_closures().begin(),
               page->loop_closures().end());
    request.set_page_token(page->next_page_token());
  } while (!request.page_token().empty());
  return all;
}

absl::StatusOr<std::vector<v1::RejectedCandidate>> ReadRejectedCandidates(
    const Client& client, const std::string& vehicle) {
  constexpr int kPageSize = 1000;
  std::vector<v1::RejectedCandidate> all;
  v1::ListRejectedCandidatesRequest request;
  request.set_parent(vehicle);
  request.set_page_size(kPageSize);
  do {
    const auto page = client.ListRejectedCandidates(request);
    if (!page.ok()) return page.status();
    all.insert(all.end(), page->rejected_candidates().begin(),
               page->rejected_candidates().end());
    request.set_page_token(page->next_page_token());
  } while (!request.page_token().empty());
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
