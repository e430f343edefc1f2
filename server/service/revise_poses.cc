#include "server/service/revise_poses.h"

#include <algorithm>
#include <cstdint>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/base/mutex.h"
#include "core/drive/dropped_stretch.h"
#include "revisit/v1/pose_graph_service.pb.h"
#include "server/base/status.h"
#include "server/connections/drain.h"
#include "server/conversion/names.h"
#include "server/conversion/poses.h"
#include "server/fields/field_violations.h"
#include "server/service/kept_covariances.h"
#include "server/service/message_bytes.h"
#include "server/service/revision_plan.h"
#include "server/service/streaming_call.h"
#include "server/sessions/fleet.h"
#include "server/sessions/vehicle_session.h"
#include "server/storage/revision_draft.h"
#include "server/telemetry/service_counters.h"

namespace revisit::server {
namespace {

// A revision reserves room on the disk in steps of this many bytes.
constexpr std::int64_t kDraftStep = std::int64_t{1} << 20;

// Puts the poses of each message into a draft before it reads the next message,
// so that a call takes the memory of one message; then hands the draft to the
// session as a whole.
class Revision final : public ReadingCall<Revision> {
 public:
  Revision(grpc::CallbackServerContext* call, const ServiceContext& context,
           grpc::ByteBuffer* response)
      : ReadingCall<Revision>(call, "RevisePoses", context),
        context_(context),
        response_bytes_(response) {}

 private:
  void OnStart() override {
    WatchRights();
    const MutexLock lock(&mutex_);
    if (!ended_) ReadNext();
  }

  void OnMessage() override {
    const absl::Status parsed = Parse(&request_);
    std::shared_ptr<VehicleSession> session;
    {
      const MutexLock lock(&mutex_);
      if (ended_) return;
      absl::Status status = given_up() ? GivenUpStatus() : parsed;
      if (status.ok()) status = Admit();
      if (!status.ok()) {
        EndLocked(status);
        return;
      }
      session = session_;
    }
    // Runs off the threads of gRPC: it checks the poses and writes them to a
    // file.
    session->LongRead(
        [self = shared_from_this()](const absl::StatusOr<VehicleView>& view) {
          self->OnDrafted(view.ok() ? self->Draft(*view) : view.status());
        });
  }

  void OnLastMessage() override {
    std::shared_ptr<VehicleSession> session;
    {
      const MutexLock lock(&mutex_);
      if (ended_) return;
      const absl::Status status =
          given_up() ? GivenUpStatus() : CheckComplete();
      if (!status.ok()) {
        EndLocked(status);
        return;
      }
      // From here on the session decides.
      revising_ = true;
      session = session_;
    }
    const auto self = shared_from_this();
    session->Revise(
        [self](const VehicleView& view) { return self->MakePlan(view); },
        [self](const absl::StatusOr<RevisionResult>& revised) {
          self->OnRevised(revised);
        });
  }

  // Ends a call whose poses are still coming: nothing has changed yet. Where
  // the store is out of reach, nobody knows whether the session's revision is
  // stored.
  void OnDrain(const Drain::End& end)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) override {
    if (!revising_ || end.at_once) EndLocked(end.status);
  }

  // A revision that the session has already is carried through.
  void OnRightsLost(const absl::Status& reason)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) override {
    if (!revising_) EndLocked(reason);
  }

  void OnEnd(const absl::Status& status)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) override {
    draft_room_.clear();
    if (status.ok()) WriteMessage(response_, response_bytes_);
  }

  // Checks vehicle and room before the poses of a message are checked.
  absl::Status Admit() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    if (absl::Status status = session_ == nullptr ? Open() : CheckSameCall();
        !status.ok()) {
      return status;
    }
    if (absl::Status status = ReserveDraft(); !status.ok()) return status;
    absl::StatusOr<Permit> permit = room().AdmitBatch(request_.SpaceUsedLong());
    if (!permit.ok()) return permit.status();
    message_room_ = *std::move(permit);
    return absl::OkStatus();
  }

  // Takes what the first message says of the whole call.
  absl::Status Open() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    const absl::StatusOr<std::string> id =
        ParseVehicleName(request_.vehicle(), FieldPath().Field("vehicle"));
    if (!id.ok()) return id.status();
    if (absl::Status status = ChooseVehicle(*id); !status.ok()) {
      return status;
    }
    terms_.expected_revision = request_.expected_revision();
    terms_.has_common_frame = request_.common_frame();
    // The session is kept to the end, so that all messages are about the same
    // vehicle, even if it is deleted and made again.
    session_ = context_.fleet->Session(*id);
    vehicle_ = VehicleName(*id);
    return absl::OkStatus();
  }

  // A later message says nothing else of the whole call.
  absl::Status CheckSameCall() const ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    const FieldPath request;
    if (!request_.vehicle().empty() && request_.vehicle() != vehicle_) {
      return InvalidField("INVALID_FIELD", request.Field("vehicle"),
                          "got " + Quoted(request_.vehicle()) +
                              "; this call is about " + vehicle_);
    }
    if (request_.expected_revision() != 0) {
      return InvalidField("INVALID_FIELD", request.Field("expected_revision"),
                          "allowed in the first message only");
    }
    if (request_.common_frame()) {
      return InvalidField("INVALID_FIELD", request.Field("common_frame"),
                          "allowed in the first message only");
    }
    return absl::OkStatus();
  }

  // Takes room for the poses of the message beside those that came before.
  absl::Status ReserveDraft() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    bytes_ += static_cast<std::int64_t>(request_.ByteSizeLong());
    if (bytes_ > context_.limits.max_revision_bytes) {
      return InvalidField(
          "BATCH_SIZE", FieldPath().Field("poses"),
          "the call brings more than " +
              std::to_string(context_.limits.max_revision_bytes) + " bytes");
    }
    // At most the limit, so that a revision which has its vehicle to itself
    // finds room for all of its poses.
    while (bytes_ > drafted_) {
      const std::int64_t step =
          std::min(kDraftStep, context_.limits.max_revision_bytes - drafted_);
      absl::StatusOr<Permit> permit = room().AdmitDraft(step);
      if (!permit.ok()) return permit.status();
      draft_room_.push_back(*std::move(permit));
      drafted_ += step;
    }
    return absl::OkStatus();
  }

  // The state space and the frame of a vehicle with poses are fixed, so a pose
  // that is valid now is valid when all have come.
  absl::Status Draft(const VehicleView& view) {
    if (absl::Status status = CheckNotAhead(view); !status.ok()) return status;
    const Poses& poses = request_.poses();
    if (poses.empty()) return absl::OkStatus();
    DropUnknownFields(request_.mutable_poses());
    if (absl::Status status =
            CheckRevisedPoses(poses, pose_number_, view.config);
        !status.ok()) {
      return status;
    }
    const auto last = std::max_element(
        poses.begin(), poses.end(), [](const v1::Pose& a, const v1::Pose& b) {
          return a.sequence() < b.sequence();
        });
    if (last->sequence() > view.durable_sequence) {
      return PoseNotFound(view.id, last->sequence(), view.durable_sequence);
    }
    return AddToDraft(poses);
  }

  absl::Status AddToDraft(const Poses& poses) {
    if (draft_ == nullptr) {
      auto draft = RevisionDraft::Create(context_.scratch_directory,
                                         context_.min_free_bytes);
      if (!draft.ok()) return draft.status();
      draft_ = *std::move(draft);
    }
    if (absl::Status status = draft_->CheckRoom(); !status.ok()) return status;
    Violations violations;
    for (const v1::Pose& pose : poses) {
      const absl::StatusOr<bool> added =
          draft_->AddPose(pose.sequence(), pose.SerializeAsString());
      if (!added.ok()) return added.status();
      if (!*added) {
        violations.Add(
            "INVALID_FIELD",
            FieldPath().At("poses", pose_number_).Field("sequence"),
            "got " + std::to_string(pose.sequence()) +
                " a second time; a call names each pose at most once");
      }
      ++pose_number_;
    }
    return violations.ToStatus();
  }

  void OnDrafted(const absl::Status& status) ABSL_LOCKS_EXCLUDED(mutex_) {
    // The memory of the message is freed before the next one comes.
    v1::RevisePosesRequest().Swap(&request_);
    message_room_.reset();
    const MutexLock lock(&mutex_);
    if (ended_) return;
    if (given_up()) {
      EndLocked(GivenUpStatus());
    } else if (!status.ok()) {
      EndLocked(status);
    } else {
      ReadNext();
    }
  }

  absl::Status CheckComplete() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    const FieldPath request;
    if (session_ == nullptr) {
      return InvalidField("INVALID_RESOURCE_NAME", request.Field("vehicle"),
                          "required in the first message");
    }
    if (draft_ == nullptr) {
      return InvalidField("BATCH_SIZE", request.Field("poses"),
                          "got no pose; a revision replaces at least one");
    }
    return absl::OkStatus();
  }

  // Refuses an expected revision that the vehicle has not reached yet. Whether
  // the change was made from a past one is known once all poses have come.
  absl::Status CheckNotAhead(const VehicleView& view) const {
    if (given_up()) return GivenUpStatus();
    return terms_.expected_revision > view.revision
               ? RevisionMismatch(view, terms_.expected_revision)
               : absl::OkStatus();
  }

  absl::StatusOr<RevisionPlan> MakePlan(const VehicleView& view) {
    if (absl::Status status = CheckNotAhead(view); !status.ok()) return status;
    // The draft is destroyed with the plan.
    const std::shared_ptr<RevisionDraft> draft = std::move(draft_);
    KeptCovariances kept(view.config.drive.state_space);
    absl::StatusOr<RevisionPlan> plan =
        PlanRevision(context_.storage, view, draft, terms_, *this, &kept);
    if (!plan.ok() || !plan->batches) return plan;
    const absl::Status taken = room().TakeRebuild(view.durable_sequence);
    if (!taken.ok()) return taken;
    warning_ = kept.Judge();
    return plan;
  }

  void OnRevised(const absl::StatusOr<RevisionResult>& revised)
      ABSL_LOCKS_EXCLUDED(mutex_) {
    const MutexLock lock(&mutex_);
    if (revised.ok() && revised->is_new) {
      context_.counts->Decided(Decision::kPosesRevised);
    }
    if (revised.ok()) {
      response_.set_revision(revised->revision);
      response_.set_revised_count(revised->revised_count);
      response_.set_dropped_count(revised->dropped_count);
      if (warning_) *response_.add_warnings() = *warning_;
    }
    EndLocked(revised.status());
  }

  const ServiceContext context_;
  // Lives until the end.
  grpc::ByteBuffer* const response_bytes_;

  // Belongs to the session until it is drafted.
  v1::RevisePosesRequest request_;
  // Room for the message that is being drafted.
  Permit message_room_;
  // Terms of the whole call, which the first message brings.
  RevisionTerms terms_;
  // Number of the next pose in the whole call.
  std::size_t pose_number_ = 0;
  std::int64_t bytes_ = 0;
  // Null until there are poses.
  std::shared_ptr<RevisionDraft> draft_;
  // Belongs to the session while it revises.
  std::optional<v1::Warning> warning_;

  std::shared_ptr<VehicleSession> session_ ABSL_GUARDED_BY(mutex_);
  // Room for the draft, and how much.
  std::vector<Permit> draft_room_ ABSL_GUARDED_BY(mutex_);
  std::int64_t drafted_ ABSL_GUARDED_BY(mutex_) = 0;
  std::string vehicle_ ABSL_GUARDED_BY(mutex_);
  bool revising_ ABSL_GUARDED_BY(mutex_) = false;
  v1::RevisePosesResponse response_ ABSL_GUARDED_BY(mutex_);
};

}  // namespace

grpc::ServerReadReactor<grpc::ByteBuffer>* StartRevision(
    grpc::CallbackServerContext* call, const ServiceContext& context,
    grpc::ByteBuffer* response) {
  const auto revision = std::make_shared<Revision>(call, context, response);
  revision->Start();
  return revision.get();
}

}  // namespace revisit::server
