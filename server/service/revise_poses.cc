#include "server/service/revise_poses.h"

#include <algorithm>
#include <cstdint>
#include <functional>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/base/mutex.h"
#include "core/drive/dropped_stretch.h"
#include "server/base/status.h"
#include "server/connections/drain.h"
#include "server/conversion/field_violations.h"
#include "server/conversion/names.h"
#include "server/conversion/poses.h"
#include "server/conversion/record_codec.h"
#include "server/service/call.h"
#include "server/sessions/fleet.h"
#include "server/sessions/vehicle_session.h"
#include "server/storage/revision_draft.h"
#include "server/storage/storage.h"

namespace revisit::server {
namespace {

// A revision reserves room on the disk in steps of this many bytes.
constexpr std::int64_t kDraftStep = std::int64_t{1} << 20;

absl::Status RevisionMismatch(const VehicleView& view, std::uint64_t expected) {
  return Error(absl::StatusCode::kAborted, "REVISION_MISMATCH",
               VehicleName(view.id) + " is at revision " +
                   std::to_string(view.revision) + ", not " +
                   std::to_string(expected),
               {{"revision", std::to_string(view.revision)},
                {"expected_revision", std::to_string(expected)}});
}

// The batch as the poses of the draft change it; nullopt if they do not.
absl::StatusOr<std::optional<BatchRecord>> Revise(const BatchRecord& batch,
                                                  const VehicleConfig& config,
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
  return ReviseBatch(batch, config, [&](std::uint64_t sequence) {
    const std::size_t place = sequence - first;
    const bool found = place < named.size() && named[place];
    return found ? &poses[place] : nullptr;
  });
}

// Reads the batches that hold the poses of the draft, and replaces these poses.
// If `expected` is not 0, it must be the revision of the vehicle, unless the
// result of the change is stored already: then the answer to an earlier call
// got lost.
absl::StatusOr<RevisionPlan> Plan(Storage* storage, const VehicleView& view,
                                  const std::shared_ptr<RevisionDraft>& draft,
                                  std::uint64_t expected, const Call& call) {
  RevisionPlan plan;
  bool is_done = expected != 0 && expected != view.revision;
  absl::Status failure;
  const absl::Status read = storage->ReadBatches(
      view.key, draft->first_sequence(), draft->last_sequence(),
      BatchVersion::kCurrent, [&](const BatchRecord& batch) {
        if (call.given_up()) {
          failure = call.GivenUpStatus();
          return false;
        }
        if (view.drive.dropped().Contains(batch.first_sequence)) {
          failure = draft->ReadPoses(batch.first_sequence,
                                     batch.first_sequence + batch.count - 1,
                                     [&](std::uint64_t, const std::string&) {
                                       ++plan.dropped_count;
                                       return absl::OkStatus();
                                     });
          return failure.ok();
        }
        const auto revised = Revise(batch, view.config, draft.get());
        if (!revised.ok()) {
          failure = revised.status();
          return false;
        }
        if (!*revised) return true;
        is_done = is_done && batch.revision == expected + 1 &&
                  batch.payload == (*revised)->payload;
        failure = draft->AddBatch(**revised);
        return failure.ok();
      });
  if (!read.ok()) return read;
  if (!failure.ok()) return failure;
  plan.revised_count = draft->pose_count() - plan.dropped_count;
  if (is_done && draft->has_batches()) {
    plan.done_by = expected + 1;
  } else if (expected != 0 && expected != view.revision) {
    return RevisionMismatch(view, expected);
  } else if (draft->has_batches()) {
    plan.batches =
        [draft](const std::function<absl::Status(const BatchRecord&)>& take) {
          return draft->ReadBatches(take);
        };
  }
  return plan;
}

// Puts the poses of each message into a draft before it reads the next message,
// so that a call takes the memory of one message; then hands the draft to the
// session as a whole. Held by a shared_ptr for the reasons given in
// stream_poses.cc.
class Revision final : public grpc::ServerReadReactor<v1::RevisePosesRequest>,
                       public std::enable_shared_from_this<Revision> {
 public:
  Revision(grpc::CallbackServerContext* call, const ServiceContext& context,
           v1::RevisePosesResponse* response)
      : grpc_context_(call),
        context_(context),
        response_(response),
        call_(call, "RevisePoses", context) {}

  void Start() {
    self_ = shared_from_this();
    call_.WatchCaller([weak = weak_from_this()] {
      if (const auto revision = weak.lock()) revision->Recheck();
    });
    drain_watch_ =
        context_.drain->Watch([weak = weak_from_this()](const Drain::End& end) {
          if (const auto revision = weak.lock()) revision->WindDown(end);
        });
    const MutexLock lock(&mutex_);
    if (finished_) return;
    if (call_.admission().ok()) {
      ReadNext();
    } else {
      End(call_.admission());
    }
  }

  void OnReadDone(bool ok) override {
    call_.CountMessage();
    std::shared_ptr<VehicleSession> session;
    {
      const MutexLock lock(&mutex_);
      if (finished_) return;
      if (!ok && grpc_context_->IsCancelled()) call_.MarkGivenUp();
      const absl::Status status = call_.given_up() ? call_.GivenUpStatus()
                                  : ok             ? Admit()
                                                   : CheckComplete();
      if (!status.ok()) {
        End(status);
        return;
      }
      // From here on the session decides.
      revising_ = !ok;
      session = session_;
    }
    const auto self = shared_from_this();
    if (!ok) {
      session->Revise(
          [self](const VehicleView& view) { return self->MakePlan(view); },
          [self](const absl::StatusOr<RevisionResult>& revised) {
            self->OnRevised(revised);
          });
      return;
    }
    // Runs off the threads of gRPC: it checks the poses and writes them to a
    // file.
    session->LongRead([self](const absl::StatusOr<VehicleView>& view) {
      self->OnDrafted(view.ok() ? self->Draft(*view) : view.status());
    });
  }

  void OnCancel() override { call_.MarkGivenUp(); }

  void OnDone() override {
    context_.drain->Unwatch(drain_watch_);
    call_.Done();
    // May destroy this.
    const std::shared_ptr<Revision> self = std::move(self_);
  }

 private:
  void End(const absl::Status& status) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    finished_ = true;
    draft_room_.clear();
    Finish(call_.End(status));
  }

  void ReadNext() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    request_.set_vehicle(kUnread);
    StartRead(&request_);
  }

  // Checks vehicle and room before the poses of a message are checked.
  absl::Status Admit() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    const FieldPath request;
    if (session_ == nullptr) {
      const absl::StatusOr<std::string> id =
          ParseVehicleName(request_.vehicle(), request.Field("vehicle"));
      if (!id.ok()) return id.status();
      if (absl::Status status = call_.ChooseVehicle(*id); !status.ok()) {
        return status;
      }
      expected_revision_ = request_.expected_revision();
      // The session is kept to the end, so that all messages are about the same
      // vehicle, even if it is deleted and made again.
      session_ = context_.fleet->Session(*id);
      vehicle_ = VehicleName(*id);
    } else {
      if (!request_.vehicle().empty() && request_.vehicle() != vehicle_) {
        return InvalidField("INVALID_FIELD", request.Field("vehicle"),
                            "got " + Quoted(request_.vehicle()) +
                                "; this call is about " + vehicle_);
      }
      if (request_.expected_revision() != 0) {
        return InvalidField("INVALID_FIELD", request.Field("expected_revision"),
                            "allowed in the first message only");
      }
    }
    bytes_ += static_cast<std::int64_t>(request_.ByteSizeLong());
    if (bytes_ > context_.limits.max_revision_bytes) {
      return InvalidField(
          "BATCH_SIZE", request.Field("poses"),
          "the call brings more than " +
              std::to_string(context_.limits.max_revision_bytes) + " bytes");
    }
    // At most the limit, so that a revision which has its vehicle to itself
    // finds room for all of its poses.
    while (bytes_ > drafted_) {
      const std::int64_t step =
          std::min(kDraftStep, context_.limits.max_revision_bytes - drafted_);
      absl::StatusOr<Permit> room = call_.AdmitDraft(step);
      if (!room.ok()) return room.status();
      draft_room_.push_back(*std::move(room));
      drafted_ += step;
    }
    absl::StatusOr<Permit> room = call_.AdmitBatch(request_.SpaceUsedLong());
    if (!room.ok()) return room.status();
    room_ = *std::move(room);
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
    room_.reset();
    const MutexLock lock(&mutex_);
    if (finished_) return;
    if (call_.given_up()) {
      End(call_.GivenUpStatus());
    } else if (!status.ok()) {
      End(status);
    } else {
      ReadNext();
    }
  }

  absl::Status CheckComplete() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    const FieldPath request;
    if (request_.vehicle() != kUnread) return MalformedMessage();
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
    if (call_.given_up()) return call_.GivenUpStatus();
    return expected_revision_ > view.revision
               ? RevisionMismatch(view, expected_revision_)
               : absl::OkStatus();
  }

  absl::StatusOr<RevisionPlan> MakePlan(const VehicleView& view) {
    if (absl::Status status = CheckNotAhead(view); !status.ok()) return status;
    // The draft is destroyed with the plan.
    const std::shared_ptr<RevisionDraft> draft = std::move(draft_);
    absl::StatusOr<RevisionPlan> plan =
        Plan(context_.storage, view, draft, expected_revision_, call_);
    if (!plan.ok() || !plan->batches) return plan;
    const MutexLock lock(&mutex_);
    if (finished_) return call_.GivenUpStatus();
    const absl::Status room = call_.AdmitRebuild(view.durable_sequence);
    if (!room.ok()) return room;
    return plan;
  }

  void OnRevised(const absl::StatusOr<RevisionResult>& revised)
      ABSL_LOCKS_EXCLUDED(mutex_) {
    const MutexLock lock(&mutex_);
    if (revised.ok() && revised->is_new) {
      context_.counts->Decided(Decision::kPosesRevised);
    }
    if (finished_) return;
    if (revised.ok()) {
      response_->set_revision(revised->revision);
      response_->set_revised_count(revised->revised_count);
      response_->set_dropped_count(revised->dropped_count);
    }
    End(revised.status());
  }

  // Ends a call whose poses are still coming: nothing has changed yet. Where
  // the store is out of reach, nobody knows whether the session's revision is
  // stored.
  void WindDown(const Drain::End& end) {
    const MutexLock lock(&mutex_);
    if (!finished_ && (!revising_ || end.at_once)) End(end.status);
  }

  // Ends the call of a caller who has lost the right to it, unless the session
  // has the revision already: that is carried through.
  void Recheck() {
    const MutexLock lock(&mutex_);
    if (finished_ || revising_) return;
    if (absl::Status status = call_.Recheck(); !status.ok()) End(status);
  }

  // Not to be used after OnDone().
  grpc::CallbackServerContext* const grpc_context_;
  const ServiceContext context_;
  // Lives until Finish().
  v1::RevisePosesResponse* const response_;
  Call call_;
  Drain::WatchId drain_watch_ = -1;
  std::shared_ptr<Revision> self_;

  // Belong to gRPC while a message is read, to the session until it is drafted.
  v1::RevisePosesRequest request_;
  // Room for the message that is being drafted.
  Permit room_;
  std::uint64_t expected_revision_ = 0;
  // Number of the next pose in the whole call.
  std::size_t pose_number_ = 0;
  std::int64_t bytes_ = 0;
  // Null until there are poses.
  std::shared_ptr<RevisionDraft> draft_;

  Mutex mutex_;
  std::shared_ptr<VehicleSession> session_ ABSL_GUARDED_BY(mutex_);
  // Room for the draft, and how much.
  std::vector<Permit> draft_room_ ABSL_GUARDED_BY(mutex_);
  std::int64_t drafted_ ABSL_GUARDED_BY(mutex_) = 0;
  std::string vehicle_ ABSL_GUARDED_BY(mutex_);
  bool revising_ ABSL_GUARDED_BY(mutex_) = false;
  bool finished_ ABSL_GUARDED_BY(mutex_) = false;
};

}  // namespace

grpc::ServerReadReactor<v1::RevisePosesRequest>* StartRevision(
    grpc::CallbackServerContext* call, const ServiceContext& context,
    v1::RevisePosesResponse* response) {
  const auto revision = std::make_shared<Revision>(call, context, response);
  revision->Start();
  return revision.get();
}

}  // namespace revisit::server
