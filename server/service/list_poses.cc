#include "server/service/list_poses.h"

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <string>

#include "absl/strings/str_cat.h"
#include "core/drive/dropped_stretch.h"
#include "google/protobuf/util/field_mask_util.h"
#include "server/conversion/page_token.h"
#include "server/conversion/pose_columns_answer.h"
#include "server/conversion/poses.h"
#include "server/fields/field_violations.h"
#include "server/fields/pose_fields.h"
#include "server/records/batch_records.h"
#include "server/sessions/vehicle_session.h"
#include "server/storage/storage.h"

namespace revisit::server {
namespace {

using google::protobuf::util::FieldMaskUtil;

// Clients read messages of 4 MiB unless configured otherwise; a page stays well
// below.
constexpr std::size_t kMaxPageBytes = std::size_t{2} << 20;

// Where a page begins.
struct Beginning {
  std::uint64_t sequence = 1;
  // Whether the caller asked for this very pose.
  bool is_named = false;
};

absl::StatusOr<Beginning> FirstSequence(const v1::ListPosesRequest& request,
                                        const std::string& list) {
  const absl::StatusOr<std::uint64_t> last =
      ParseSequenceToken(list, request.page_token());
  if (!last.ok()) return last.status();
  if (*last > 0) return Beginning{*last + 1, false};
  if (request.first_sequence() == 0) return Beginning();
  return Beginning{request.first_sequence(), true};
}

// The last sequence of a page of `count` poses from this one on, none of which
// was dropped.
std::uint64_t LastOfPage(const core::DroppedStretches& dropped,
                         std::uint64_t first, std::uint64_t count) {
  std::uint64_t last = first + count - 1;
  for (const auto& gap : dropped.gaps()) {
    if (gap.first_sequence > last) break;
    if (gap.last_sequence >= first) {
      last += gap.last_sequence - gap.first_sequence + 1;
    }
  }
  return last;
}

absl::Status CheckReadMask(const google::protobuf::FieldMask& mask) {
  Violations violations;
  const FieldPath path = kRequest.Field("read_mask");
  for (int i = 0; i < mask.paths_size(); ++i) {
    if (!FieldMaskUtil::IsValidPath<v1::Pose>(mask.paths(i))) {
      violations.Add(kInvalidField,
                     path.At("paths", static_cast<std::size_t>(i)),
                     absl::StrCat("got ", Quoted(mask.paths(i)),
                                  ", which is no field of Pose"));
    }
  }
  return violations.ToStatus();
}

// The poses of this view of a vehicle, as page tokens name them.
std::string ListOf(const v1::ListPosesRequest& request, BatchVersion version) {
  return absl::StrCat(
      version == BatchVersion::kAsSent ? "ListPoses as sent " : "ListPoses ",
      request.parent());
}

// Fills a page in the form that the request asks for. Both forms have the same
// pages.
class PageWriter {
 public:
  PageWriter(const v1::ListPosesRequest& request, int most_columns_poses,
             v1::ListPosesResponse* response)
      : mask_(request.read_mask()),
        as_columns_(request.as_columns()),
        columns_(mask_, most_columns_poses, response->mutable_columns()),
        response_(response) {}

  void Add(const PoseFields& stored) {
    v1::Pose* const pose = as_columns_ ? &pose_ : response_->add_poses();
    SetPose(stored, pose);
    if (mask_.paths_size() > 0) FieldMaskUtil::TrimMessage(mask_, pose);
    bytes_ += pose->ByteSizeLong();
    if (as_columns_) columns_.Add(*pose, stored.sequence);
  }

  bool is_full() const { return bytes_ > kMaxPageBytes; }

  // Call this after the last pose.
  void Finish() { columns_.Finish(); }

 private:
  const google::protobuf::FieldMask& mask_;
  const bool as_columns_;
  // The pose of the moment, of a page of columns.
  v1::Pose pose_;
  PoseColumnsAnswer columns_;
  v1::ListPosesResponse* const response_;
  // The size of all poses as messages.
  std::size_t bytes_ = 0;
};

// Fills a page with the poses from `first` on. Where they are damaged, a page
// ends before the damage, and the next one begins with it: DATA_LOSS.
absl::Status ReadPoses(Storage* storage, const VehicleView& view,
                       const Beginning& beginning, int page_size,
                       BatchVersion version, const std::string& list,
                       PageWriter* page, v1::ListPosesResponse* response) {
  if (beginning.sequence > view.durable_sequence) return view.damage;
  if (beginning.is_named) {
    const absl::Status kept = CheckKept(view, beginning.sequence);
    if (!kept.ok()) return kept;
  }
  const core::DroppedStretches& dropped = view.drive.dropped();
  const std::uint64_t first = dropped.KeptFrom(beginning.sequence);
  if (first > view.durable_sequence) return view.damage;
  const std::uint64_t last = std::min(
      view.durable_sequence,
      LastOfPage(dropped, first, static_cast<std::uint64_t>(page_size)));
  std::uint64_t last_taken = 0;
  absl::Status parsed;
  const absl::Status read = storage->ReadBatches(
      view.key, first, last, version, [&](const BatchRecord& batch) {
        parsed = VisitPoses(batch, [&](const PoseFields& stored) {
          if (stored.sequence < first) return true;
          if (stored.sequence > last || page->is_full()) return false;
          last_taken = stored.sequence;
          page->Add(stored);
          return true;
        });
        return parsed.ok() && !page->is_full();
      });
  page->Finish();
  const absl::Status& failure = read.ok() ? parsed : read;
  if (!failure.ok() && !(absl::IsDataLoss(failure) && last_taken > 0)) {
    return failure;
  }
  if (last_taken < view.durable_sequence || !view.damage.ok()) {
    response->set_next_page_token(MakePageToken(list, last_taken));
  }
  return absl::OkStatus();
}

}  // namespace

absl::Status ListPoses(const ServiceContext& service, const UnaryCallPtr& call,
                       const v1::ListPosesRequest& request,
                       v1::ListPosesResponse* response) {
  const auto session = SessionOf(service, request.parent(),
                                 kRequest.Field("parent"), call.get());
  if (!session.ok()) return session.status();
  const absl::StatusOr<BatchVersion> version = DecodePoseView(request.view());
  if (!version.ok()) return version.status();
  const std::string list = ListOf(request, *version);
  const absl::StatusOr<int> page_size =
      PageSize(request.page_size(), 1000, 10000);
  if (!page_size.ok()) return page_size.status();
  const absl::StatusOr<Beginning> first = FirstSequence(request, list);
  if (!first.ok()) return first.status();
  if (absl::Status status = CheckReadMask(request.read_mask()); !status.ok()) {
    return status;
  }
  const std::weak_ptr<VehicleSession> loaded = *session;
  (*session)->ReadStored(FinishWith<VehicleView>(
      call,
      [=, storage = service.storage, request = &request,
       most_poses = service.limits.max_batch_poses](const VehicleView& view) {
        PageWriter page(*request, most_poses, response);
        const absl::Status status = ReadPoses(storage, view, *first, *page_size,
                                              *version, list, &page, response);
        const auto still_there = loaded.lock();
        if (absl::IsDataLoss(status) && still_there != nullptr) {
          still_there->LoadAnew();
        }
        return status;
      }));
  return absl::OkStatus();
}

}  // namespace revisit::server
