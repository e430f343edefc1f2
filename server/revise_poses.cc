#include "server/revise_poses.h"

#include <algorithm>
#include <cstdint>
#include <limits>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/call.h"
#include "server/drain.h"
#include "server/field_violations.h"
#include "server/mutex.h"
#include "server/proto_conversion.h"
#include "server/sessions/fleet.h"
#include "server/sessions/vehicle_session.h"
#include "server/status.h"
#include "server/storage/storage.h"

namespace revisit::server {
namespace {

using Request = v1::RevisePosesRequest;

// A pose of the call and its place in it.
struct NumberedPose {
  std::uint64_t sequence;
  std::size_t number;
  const v1::Pose* pose;
};

// By sequence. INVALID_ARGUMENT if one comes twice.
absl::StatusOr<std::vector<NumberedPose>> SortedPoses(
    const std::vector<const v1::Pose*>& poses) {
  std::vector<NumberedPose> sorted;
  sorted.reserve(poses.size());
  for (std::size_t i = 0; i < poses.size(); ++i) {
    sorted.push_back({poses[i]->sequence(), i, poses[i]});
  }
  std::sort(sorted.begin(), sorted.end(),
            [](const NumberedPose& a, const NumberedPose& b) {
              return std::pair(a.sequence, a.number) <
                     std::pair(b.sequence, b.number);
            });
  Violations violations;
  for (std::size_t i = 1; i < sorted.size(); ++i) {
    if (sorted[i].sequence != sorted[i - 1].sequence) continue;
    const FieldPath pose = FieldPath().At("poses", sorted[i].number);
    violations.Add("INVALID_FIELD", pose.Field("sequence"),
                   "got " + std::to_string(sorted[i].sequence) +
                       " a second time; a call names each pose at most once");
  }
  if (violations.count() > 0) return violations.ToStatus();
  return sorted;
}

absl::Status RevisionMismatch(const VehicleView& view, std::uint64_t expected) {
  return Error(absl::StatusCode::kAborted, "REVISION_MISMATCH",
               VehicleName(view.id) + " is at revision " +
                   std::to_string(view.revision) + ", not " +
                   std::to_string(expected),
               {{"revision", std::to_string(view.revision)},
                {"expected_revision", std::to_string(expected)}});
}

// Reads the batches that hold the poses, and replaces these. If `expected` is
// not 0, it must be the revision of the vehicle, unless what follows from it is
// there already: then the answer to an earlier call got lost.
absl::StatusOr<RevisionPlan> Plan(Storage* storage, const VehicleView& view,
                                  const std::vector<const v1::Pose*>& poses,
                                  std::uint64_t expected) {
  if (absl::Status status = CheckRevisedPoses(poses, view.config);
      !status.ok()) {
    return status;
  }
  const absl::StatusOr<std::vector<NumberedPose>> sorted = SortedPoses(poses);
  if (!sorted.ok()) return sorted.status();
  const std::uint64_t last = sorted->back().sequence;
  if (last > view.durable_sequence) {
    return PoseNotFound(view.id, last, view.durable_sequence);
  }
  const auto revised = [&](std::uint64_t sequence) -> const v1::Pose* {
    const auto found =
        std::lower_bound(sorted->begin(), sorted->end(), sequence,
                         [](const NumberedPose& pose, std::uint64_t wanted) {
                           return pose.sequence < wanted;
                         });
    const bool named = found != sorted->end() && found->sequence == sequence;
    return named ? found->pose : nullptr;
  };
  RevisionPlan plan;
  plan.revised_count = static_cast<std::int64_t>(sorted->size());
  bool is_done = expected != 0 && expected != view.revision;
  absl::Status failure;
  const absl::Status read = storage->ReadBatches(
      view.key, sorted->front().sequence, last, BatchVersion::kCurrent,
      [&](const BatchRecord& batch) {
        auto record = ReviseBatch(batch, view.config, revised);
        if (!record.ok()) {
          failure = record.status();
          return false;
        }
        if (!*record) return true;
        is_done = is_done && batch.revision == expected + 1 &&
                  batch.payload == (*record)->payload;
        plan.batches.push_back(**std::move(record));
        return true;
      });
  if (!read.ok()) return read;
  if (!failure.ok()) return failure;
  if (is_done) {
    plan.done_by = expected + 1;
  } else if (expected != 0 && expected != view.revision) {
    return RevisionMismatch(view, expected);
  }
  return plan;
}

// Collects the poses of all messages, then hands them to the session in one
// piece. Held by a shared_ptr for the reasons given in stream_poses.cc.
class Revision final : public grpc::ServerReadReactor<Request>,
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
    drain_watch_ = context_.drain->Watch([weak = weak_from_this()] {
      if (const auto revision = weak.lock()) revision->WindDown();
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
    {
      const MutexLock lock(&mutex_);
      if (finished_) return;
      if (!ok && grpc_context_->IsCancelled()) call_.MarkGivenUp();
      const absl::Status status = call_.given_up() ? call_.GivenUpStatus()
                                  : ok             ? Collect()
                                                   : CheckComplete();
      if (!status.ok()) {
        End(status);
        return;
      }
      if (ok) {
        ReadNext();
        return;
      }
      // From here on the session decides.
      revising_ = true;
    }
    Revise();
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
    Finish(call_.End(status));
  }

  void ReadNext() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    request_.set_vehicle(kUnread);
    StartRead(&request_);
  }

  absl::Status Collect() {
    const FieldPath request;
    if (vehicle_.empty()) {
      const absl::StatusOr<std::string> id =
          ParseVehicleName(request_.vehicle(), request.Field("vehicle"));
      if (!id.ok()) return id.status();
      if (absl::Status status = call_.ChooseVehicle(*id); !status.ok()) {
        return status;
      }
      vehicle_ = *id;
      expected_revision_ = request_.expected_revision();
    } else {
      if (!request_.vehicle().empty() &&
          request_.vehicle() != VehicleName(vehicle_)) {
        return InvalidField("INVALID_FIELD", request.Field("vehicle"),
                            "got " + Quoted(request_.vehicle()) +
                                "; this call is about " +
                                VehicleName(vehicle_));
      }
      if (request_.expected_revision() != 0) {
        return InvalidField("INVALID_FIELD", request.Field("expected_revision"),
                            "allowed in the first message only");
      }
    }
    const std::size_t bytes = request_.ByteSizeLong();
    const absl::StatusOr<Permit> room = call_.AdmitBatch(bytes);
    if (!room.ok()) return room.status();
    room_.push_back(*room);
    bytes_ += static_cast<std::int64_t>(bytes);
    if (bytes_ > context_.limits.max_revision_bytes) {
      return InvalidField(
          "BATCH_SIZE", request.Field("poses"),
          "the call brings more than " +
              std::to_string(context_.limits.max_revision_bytes) + " bytes");
    }
    if (request_.poses_size() > 0) {
      messages_.emplace_back();
      messages_.back().Swap(request_.mutable_poses());
    }
    return absl::OkStatus();
  }

  absl::Status CheckComplete() {
    const FieldPath request;
    if (request_.vehicle() != kUnread) return MalformedMessage();
    if (vehicle_.empty()) {
      return InvalidField("INVALID_RESOURCE_NAME", request.Field("vehicle"),
                          "required in the first message");
    }
    if (messages_.empty()) {
      return InvalidField("BATCH_SIZE", request.Field("poses"),
                          "got no pose; a revision replaces at least one");
    }
    return absl::OkStatus();
  }

  void Revise() ABSL_LOCKS_EXCLUDED(mutex_) {
    const auto self = shared_from_this();
    context_.fleet->Session(vehicle_)->Revise(
        [self](const VehicleView& view) { return self->MakePlan(view); },
        [self](const absl::StatusOr<std::pair<std::uint64_t, std::int64_t>>&
                   revised) {
          const MutexLock lock(&self->mutex_);
          if (revised.ok()) {
            self->response_->set_revision(revised->first);
            self->response_->set_revised_count(revised->second);
          }
          self->End(revised.status());
        });
  }

  absl::StatusOr<RevisionPlan> MakePlan(const VehicleView& view) {
    if (call_.given_up()) return call_.GivenUpStatus();
    // Nothing can have been done from a revision that is still to come.
    if (expected_revision_ > view.revision) {
      return RevisionMismatch(view, expected_revision_);
    }
    std::vector<const v1::Pose*> poses;
    for (const Poses& message : messages_) {
      for (const v1::Pose& pose : message) poses.push_back(&pose);
    }
    return Plan(context_.storage, view, poses, expected_revision_);
  }

  // Nothing has changed yet if the poses are still coming.
  void WindDown() {
    const MutexLock lock(&mutex_);
    if (!finished_ && !revising_) End(Drain::Refusal());
  }

  // A revision that the session has got already is carried through.
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

  // Not changed any more once `revising_`.
  Request request_;
  std::string vehicle_;
  std::uint64_t expected_revision_ = 0;
  std::vector<Poses> messages_;
  std::int64_t bytes_ = 0;
  std::vector<Permit> room_;

  Mutex mutex_;
  bool revising_ ABSL_GUARDED_BY(mutex_) = false;
  bool finished_ ABSL_GUARDED_BY(mutex_) = false;
};

}  // namespace

grpc::ServerReadReactor<Request>* StartRevision(
    grpc::CallbackServerContext* call, const ServiceContext& context,
    v1::RevisePosesResponse* response) {
  const auto revision = std::make_shared<Revision>(call, context, response);
  revision->Start();
  return revision.get();
}

}  // namespace revisit::server
