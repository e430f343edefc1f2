#include "client/trajectory/stored_groups.h"

#include <utility>

#include "client/answers/pages.h"

namespace revisit::client {
namespace {

// Entries of a page.
constexpr int kPageSize = 1000;

}  // namespace

absl::StatusOr<v1::ListFrameTransformsResponse> ReadFrameTransforms(
    const Client& client, v1::ListFrameTransformsRequest request) {
  request.set_page_size(kPageSize);
  v1::ListFrameTransformsResponse all;
  const absl::Status read = VisitPages(
      std::move(request),
      [&](const v1::ListFrameTransformsRequest& asked) {
        return client.ListFrameTransforms(asked);
      },
      [](const v1::ListFrameTransformsResponse& page) -> const auto& {
        return page.frame_transforms();
      },
      [&](const v1::ListFrameTransformsResponse& page) -> absl::StatusOr<bool> {
        const bool fits = all.group_revision() == 0 ||
                          all.group_revision() == page.group_revision();
        if (!fits) {
          return absl::AbortedError(
              "the group changed while its frames were listed: list them "
              "again");
        }
        all.set_group_revision(page.group_revision());
        all.mutable_frame_transforms()->MergeFrom(page.frame_transforms());
        return true;
      });
  if (!read.ok()) return read;
  return all;
}

absl::Status ReadPairs(const Client& client, const std::string& group,
                       v1::ListInterVehicleLoopClosuresResponse* links) {
  v1::ListInterVehicleLoopClosuresRequest request;
  request.set_parent(group);
  request.set_page_size(kPageSize);
  return VisitPages(
      std::move(request),
      [&](const v1::ListInterVehicleLoopClosuresRequest& asked) {
        return client.ListInterVehicleLoopClosures(asked);
      },
      [](const v1::ListInterVehicleLoopClosuresResponse& page) -> const auto& {
        return page.loop_closures();
      },
      [&](const v1::ListInterVehicleLoopClosuresResponse& page)
          -> absl::StatusOr<bool> {
        links->mutable_loop_closures()->MergeFrom(page.loop_closures());
        return true;
      });
}

absl::Status ReadPairs(
    const Client& client, const std::string& group,
    v1::ListInterVehicleRejectedCandidatesResponse* rejections) {
  v1::ListInterVehicleRejectedCandidatesRequest request;
  request.set_parent(group);
  request.set_page_size(kPageSize);
  return VisitPages(
      std::move(request),
      [&](const v1::ListInterVehicleRejectedCandidatesRequest& asked) {
        return client.ListInterVehicleRejectedCandidates(asked);
      },
      [](const v1::ListInterVehicleRejectedCandidatesResponse& page)
          -> const auto& { return page.rejected_candidates(); },
      [&](const v1::ListInterVehicleRejectedCandidatesResponse& page)
          -> absl::StatusOr<bool> {
        rejections->mutable_rejected_candidates()->MergeFrom(
            page.rejected_candidates());
        return true;
      });
}

}  // namespace revisit::client
