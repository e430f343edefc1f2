#include "server/service/list_recordings.h"

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <string>
#include <vector>

#include "absl/strings/str_cat.h"
#include "core/drive/frame_relations.h"
#include "core/drive/pose_graph.h"
#include "core/drive/recordings.h"
#include "server/conversion/answers.h"
#include "server/conversion/page_token.h"
#include "server/sessions/vehicle_session.h"

namespace revisit::server {
namespace {

// Fills a page with the recordings that begin behind this sequence.
void ListSome(const VehicleView& view, std::uint64_t after, int page_size,
              const std::string& list, v1::ListRecordingsResponse* response) {
  if (view.durable_sequence == 0) return;
  const core::Recordings& recordings = view.drive.recordings();
  std::size_t k = 0;
  while (k < recordings.size() && recordings[k].first_sequence <= after) ++k;
  const std::size_t end =
      std::min(recordings.size(), k + static_cast<std::size_t>(page_size));
  const std::vector<core::FrameRelation> relations =
      view.drive.RelationsAt(view.drive.graph().size() - 1)
          .From(recordings.size() - 1);
  for (; k < end; ++k) {
    EncodeRecording(view, k, relations[k], response->add_recordings());
  }
  if (end < recordings.size()) {
    response->set_next_page_token(
        MakePageToken(list, recordings[end - 1].first_sequence));
  }
}

}  // namespace

absl::Status ListRecordings(const ServiceContext& service,
                            const UnaryCallPtr& call,
                            const v1::ListRecordingsRequest& request,
                            v1::ListRecordingsResponse* response) {
  const auto session = SessionOf(service, request.parent(),
                                 kRequest.Field("parent"), call.get());
  if (!session.ok()) return session.status();
  const std::string list = absl::StrCat("ListRecordings ", request.parent());
  const absl::StatusOr<int> page_size =
      PageSize(request.page_size(), 100, 1000);
  if (!page_size.ok()) return page_size.status();
  const absl::StatusOr<std::uint64_t> after =
      ParseSequenceToken(list, request.page_token());
  if (!after.ok()) return after.status();
  // Where frames lie is found out from all loop closures.
  (*session)->LongRead(
      FinishWith<VehicleView>(call, [=](const VehicleView& view) {
        ListSome(view, *after, *page_size, list, response);
        return absl::OkStatus();
      }));
  return absl::OkStatus();
}

}  // namespace revisit::server
