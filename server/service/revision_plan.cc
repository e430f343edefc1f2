#include "server/service/revision_plan.h"

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <limits>
#include <optional>
#include <string>
#include <vector>

#include "core/drive/dropped_stretch.h"
#include "core/drive/recordings.h"
#include "core/geometry/pose.h"
#include "revisit/v1/geometry.pb.h"
#include "server/base/status.h"
#include "server/conversion/names.h"
#include "server/conversion/poses.h"
#include "server/fields/field_violations.h"
#include "server/fields/pose_fields.h"
#include "server/records/batch_records.h"
#include "server/records/proto_record_codec.h"

namespace revisit::server {
namespace {

// The batch as the poses of the draft change it; nullopt if they do not.
absl::StatusOr<std::optional<BatchRecord>> Revise(const BatchRecord& batch,
                                                  const VehicleConfig& config,
                                                  RevisedStarts starts,
                                                  RevisionDraft* draft) {
  std::vector<v1::Pose> poses(batch.count);
  std::vector<bool> named(batch.count, false);
  const std::uint64_t first = batch.first_sequence;
  const absl::Status read = draft->ReadPoses(
      first, first + batch.count - 1,
      [&](std::uint64_t sequence, const std::string& pose) {
        const std::size_t place = sequence - first;
        named[place] = true;
        return poses[place].ParseFromString(pose)
                   ? absl::OkStatus()
                   : Error(absl::StatusCode::kInternal, "INTERNAL",
                           "a pose of a revision cannot be read again");
      });
  if (!read.ok()) return read;
  return ReviseBatch(batch, config, starts, [&](std::uint64_t sequence) {
    const std::size_t place = sequence - first;
    const bool found = place < named.size() && named[place];
    return found ? std::make_optional(PoseFieldsOf(poses[place]))
                 : std::nullopt;
  });
}

// Takes the stored batches one by one.
class Planner {
 public:
  Planner(const VehicleView& view, RevisionDraft* draft,
          const RevisionTerms& terms, KeptCovariances* kept)
      : view_(view),
        draft_(draft),
        expected_(terms.expected_revision),
        starts_(terms.has_common_frame ? RevisedStarts::kFirst
                                       : RevisedStarts::kStay),
        kept_(kept),
        is_done_(is_mismatch()) {
    const core::Recordings& recordings = view.drive.recordings();
    if (terms.has_common_frame && recordings.size() > 1) {
      moves_frame_from_ = recordings[1].first_sequence;
    }
  }

  absl::Status Take(const BatchRecord& batch) {
    if (view_.drive.dropped().Contains(batch.first_sequence)) {
      return CountDropped(batch);
    }
    const auto revised = Revise(batch, view_.config, starts_, draft_);
    if (!revised.ok()) return revised.status();
    if (!*revised) return absl::OkStatus();
    if (absl::Status shown = Show(batch, **revised); !shown.ok()) return shown;
    is_done_ = is_done_ && batch.revision == expected_ + 1 &&
               batch.payload == (*revised)->payload;
    return draft_->AddBatch(**revised);
  }

  // Whether another revision than the vehicle's is expected.
  bool is_mismatch() const {
    return expected_ != 0 && expected_ != view_.revision;
  }
  // Whether the batches are stored already as the draft changes them, by the
  // revision after the expected one.
  bool is_done() const { return is_done_ && draft_->has_batches(); }
  // Number of poses of the draft that are kept no longer.
  std::int64_t dropped_count() const { return dropped_count_; }

 private:
  absl::Status Show(const BatchRecord& batch, const BatchRecord& revised) {
    const ProtoRecordCodec codec;
    auto before = codec.DecodePoses(batch.payload, view_.config);
    if (!before.ok()) return before.status();
    auto after = codec.DecodePoses(revised.payload, view_.config);
    if (!after.ok()) return after.status();
    for (auto* samples : {&before->samples, &after->samples}) {
      const auto moved = std::find_if(
          samples->begin(), samples->end(), [&](const core::PoseSample& pose) {
            return pose.sequence >= moves_frame_from_;
          });
      samples->erase(moved, samples->end());
    }
    kept_->Look(before->samples, after->samples);
    return absl::OkStatus();
  }

  absl::Status CountDropped(const BatchRecord& batch) {
    return draft_->ReadPoses(batch.first_sequence,
                             batch.first_sequence + batch.count - 1,
                             [this](std::uint64_t, const std::string&) {
                               ++dropped_count_;
                               return absl::OkStatus();
                             });
  }

  const VehicleView& view_;
  RevisionDraft* const draft_;
  const std::uint64_t expected_;
  const RevisedStarts starts_;
  KeptCovariances* const kept_;
  // The first of the poses that go into another frame.
  std::uint64_t moves_frame_from_ = std::numeric_limits<std::uint64_t>::max();
  bool is_done_;
  std::int64_t dropped_count_ = 0;
};

// Whether the poses that are revised are all that the vehicle keeps.
absl::Status CheckAllNamed(const VehicleView& view, std::int64_t revised) {
  const std::uint64_t kept =
      view.durable_sequence - view.drive.dropped().count();
  if (static_cast<std::uint64_t>(revised) == kept) return absl::OkStatus();
  return InvalidField(kInvalidField, FieldPath().Field("poses"),
                      "got " + std::to_string(revised) + " of the " +
                          std::to_string(kept) + " poses that " +
                          VehicleName(view.id) +
                          " keeps; with `common_frame`, all have to be named");
}

}  // namespace

absl::Status RevisionMismatch(const VehicleView& view, std::uint64_t expected) {
  return Error(absl::StatusCode::kAborted, "REVISION_MISMATCH",
               VehicleName(view.id) + " is at revision " +
                   std::to_string(view.revision) + ", not " +
                   std::to_string(expected),
               {{"revision", std::to_string(view.revision)},
                {"expected_revision", std::to_string(expected)}});
}

absl::StatusOr<RevisionPlan> PlanRevision(
    Storage* storage, const VehicleView& view,
    const std::shared_ptr<RevisionDraft>& draft, const RevisionTerms& terms,
    const Call& call, KeptCovariances* kept) {
  Planner planner(view, draft.get(), terms, kept);
  absl::Status taken;
  const absl::Status read = storage->ReadBatches(
      view.key, draft->first_sequence(), draft->last_sequence(),
      BatchVersion::kCurrent, [&](const BatchRecord& batch) {
        taken = call.given_up() ? call.GivenUpStatus() : planner.Take(batch);
        return taken.ok();
      });
  if (!read.ok()) return read;
  if (!taken.ok()) return taken;
  RevisionPlan plan;
  plan.dropped_count = planner.dropped_count();
  plan.revised_count = draft->pose_count() - plan.dropped_count;
  if (planner.is_done()) {
    plan.done_by = terms.expected_revision + 1;
    return plan;
  }
  if (planner.is_mismatch()) {
    return RevisionMismatch(view, terms.expected_revision);
  }
  if (terms.has_common_frame) {
    const absl::Status named = CheckAllNamed(view, plan.revised_count);
    if (!named.ok()) return named;
  }
  if (draft->has_batches()) {
    plan.batches =
        [draft](const std::function<absl::Status(const BatchRecord&)>& take) {
          return draft->ReadBatches(take);
        };
  }
  return plan;
}

}  // namespace revisit::server
