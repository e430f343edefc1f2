#include "server/service/append_poses.h"

#include <chrono>
#include <cstdint>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "absl/status/statusor.h"
#include "server/conversion/answers.h"
#include "server/conversion/names.h"
#include "server/conversion/pose_inspection.h"
#include "server/conversion/poses.h"
#include "server/sessions/fleet.h"
#include "server/sessions/vehicle_session.h"
#include "server/telemetry/service_counters.h"

namespace revisit::server {
namespace {

// The batch of an AppendPoses call. Request and response live as long as the
// call.
class UnaryAppend final : public AppendObserver {
 public:
  UnaryAppend(UnaryCallPtr call, const v1::AppendPosesRequest* request,
              v1::AppendPosesResponse* response, ServiceCounters* counts)
      : call_(std::move(call)),
        request_(request),
        response_(response),
        counts_(counts) {}

  // The batch may have waited past its caller's deadline.
  absl::Status StillWanted() const override {
    return call_->given_up() ? call_->GivenUpStatus() : absl::OkStatus();
  }

  void OnDecoded(const VehicleConfig& config,
                 const std::vector<core::PoseSample>& samples) override {
    if (samples.front().sequence != 1) return;
    PoseInspector(config.frame).Look(samples, &warnings_);
  }

  void OnDurable(const absl::StatusOr<Acknowledgement>& result) override {
    const std::uint64_t poses = SentPosesOf(*request_).count();
    if (result.ok()) {
      counts_->Acknowledged(poses, result->accepted_poses,
                            std::chrono::steady_clock::now() - start_);
      EncodeAck(*result, response_->mutable_ack());
      response_->mutable_ack()->mutable_warnings()->MergeFrom(warnings_);
    } else {
      counts_->Refused(poses, result.status());
    }
    call_->End(result.status());
  }

 private:
  const UnaryCallPtr call_;
  const v1::AppendPosesRequest* const request_;
  v1::AppendPosesResponse* const response_;
  ServiceCounters* const counts_;
  const std::chrono::steady_clock::time_point start_ =
      std::chrono::steady_clock::now();
  PoseInspector::Warnings warnings_;
};

// The session of the vehicle, once the call has room for its batch.
absl::StatusOr<std::shared_ptr<VehicleSession>> Admit(
    const ServiceContext& service, const v1::AppendPosesRequest& request,
    UnaryCall* call) {
  auto session =
      SessionOf(service, request.vehicle(), kRequest.Field("vehicle"), call);
  if (!session.ok()) return session;
  if (absl::Status status =
          CheckUid(request.vehicle_uid(), kRequest.Field("vehicle_uid"));
      !status.ok()) {
    return status;
  }
  if (absl::Status status = call->room().TakeBatch(request.ByteSizeLong());
      !status.ok()) {
    return status;
  }
  return session;
}

}  // namespace

absl::Status AppendPoses(const ServiceContext& service,
                         const UnaryCallPtr& call,
                         const v1::AppendPosesRequest& request,
                         v1::AppendPosesResponse* response) {
  const auto session = Admit(service, request, call.get());
  if (!session.ok()) {
    service.counts->Refused(SentPosesOf(request).count(), session.status());
    return session.status();
  }
  AppendRequest append;
  append.decode =
      DecoderOf(SentPosesOf(request), service.limits.max_batch_poses, nullptr);
  append.vehicle_uid = request.vehicle_uid();
  (*session)->Append(
      std::move(append),
      std::make_shared<UnaryAppend>(call, &request, response, service.counts));
  return absl::OkStatus();
}

}  // namespace revisit::server
