#include "client/trajectory/stored_poses.h"

#include <algorithm>

#include "absl/strings/str_cat.h"
#include "client/answers/pages.h"

namespace revisit::client {

namespace {

// The poses of one view, one after the other.
class PoseReader {
 public:
  PoseReader(const Client& client, const std::string& vehicle,
             v1::PoseView view)
      : pages_(
            RequestFor(vehicle, view),
            [&client](const v1::ListPosesRequest& asked) {
              return client.ListPoses(asked);
            },
            [](const v1::ListPosesResponse& page) -> const auto& {
              return page.poses();
            }) {}

  // The next pose, valid until the next call; null after the last one.
  absl::StatusOr<const v1::Pose*> Next() {
    while (next_ == pages_.page().poses_size()) {
      const absl::StatusOr<bool> found = pages_.Next();
      if (!found.ok()) return found.status();
      if (!*found) return nullptr;
      next_ = 0;
    }
    return &pages_.page().poses(next_++);
  }

 private:
  using List = std::function<absl::StatusOr<v1::ListPosesResponse>(
      const v1::ListPosesRequest&)>;
  using Items =
      std::function<const google::protobuf::RepeatedPtrField<v1::Pose>&(
          const v1::ListPosesResponse&)>;

  static v1::ListPosesRequest RequestFor(const std::string& vehicle,
                                         v1::PoseView view) {
    constexpr int kPagePoses = 10'000;
    v1::ListPosesRequest request;
    request.set_parent(vehicle);
    request.set_page_size(kPagePoses);
    request.set_view(view);
    return request;
  }

  PageReader<v1::ListPosesRequest, List, Items> pages_;
  int next_ = 0;
};

// Entries of a page of all lists but that of poses.
constexpr int kPageSize = 1000;

}  // namespace

absl::Status VisitPoses(
    const Client& client, const std::string& vehicle, v1::PoseView view,
    const std::function<absl::Status(const v1::Pose&)>& visit) {
  PoseReader reader(client, vehicle, view);
  for (;;) {
    const absl::StatusOr<const v1::Pose*> pose = reader.Next();
    if (!pose.ok()) return pose.status();
    if (*pose == nullptr) return absl::OkStatus();
    if (absl::Status status = visit(**pose); !status.ok()) return status;
  }
}

absl::Status VisitBothViews(
    const Client& client, const std::string& vehicle,
    const std::function<absl::Status(const v1::Pose& current,
                                     const v1::Pose& as_sent)>& visit) {
  PoseReader current(client, vehicle, v1::POSE_VIEW_CURRENT);
  PoseReader as_sent(client, vehicle, v1::POSE_VIEW_AS_SENT);
  for (;;) {
    const absl::StatusOr<const v1::Pose*> pose = current.Next();
    if (!pose.ok()) return pose.status();
    const absl::StatusOr<const v1::Pose*> sent = as_sent.Next();
    if (!sent.ok()) return sent.status();
    // Poses that were streamed after the last page of the other view are left
    // out.
    if (*pose == nullptr || *sent == nullptr) return absl::OkStatus();
    if ((*pose)->sequence() != (*sent)->sequence()) {
      return absl::AbortedError(
          absl::StrCat(vehicle, ": poses were dropped meanwhile, pose ",
                       std::min((*pose)->sequence(), (*sent)->sequence()),
                       " among them; try again"));
    }
    if (absl::Status status = visit(**pose, **sent); !status.ok()) {
      return status;
    }
  }
}

absl::StatusOr<std::vector<v1::LoopClosure>> ReadLoopClosures(
    const Client& client, const std::string& vehicle) {
  v1::ListLoopClosuresRequest request;
  request.set_parent(vehicle);
  request.set_page_size(kPageSize);
  return ReadPages(
      request,
      [&](const v1::ListLoopClosuresRequest& asked) {
        return client.ListLoopClosures(asked);
      },
      [](const v1::ListLoopClosuresResponse& page) -> const auto& {
        return page.loop_closures();
      });
}

absl::StatusOr<std::vector<v1::RejectedCandidate>> ReadRejectedCandidates(
    const Client& client, const std::string& vehicle) {
  v1::ListRejectedCandidatesRequest request;
  request.set_parent(vehicle);
  request.set_page_size(kPageSize);
  return ReadPages(
      request,
      [&](const v1::ListRejectedCandidatesRequest& asked) {
        return client.ListRejectedCandidates(asked);
      },
      [](const v1::ListRejectedCandidatesResponse& page) -> const auto& {
        return page.rejected_candidates();
      });
}

absl::StatusOr<std::vector<v1::Recording>> ReadRecordings(
    const Client& client, const std::string& vehicle) {
  v1::ListRecordingsRequest request;
  request.set_parent(vehicle);
  request.set_page_size(kPageSize);
  return ReadPages(
      request,
      [&](const v1::ListRecordingsRequest& asked) {
        return client.ListRecordings(asked);
      },
      [](const v1::ListRecordingsResponse& page) -> const auto& {
        return page.recordings();
      });
}

const v1::Recording* RecordingOf(const std::vector<v1::Recording>& recordings,
                                 std::uint64_t sequence) {
  const auto next =
      std::upper_bound(recordings.begin(), recordings.end(), sequence,
                       [](std::uint64_t of, const v1::Recording& recording) {
                         return of < recording.first_sequence();
                       });
  return next == recordings.begin() ? nullptr : &*(next - 1);
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
