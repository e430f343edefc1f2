#include "server/service/call.h"

#include "absl/strings/cord.h"
#include "google/rpc/error_details.pb.h"
#include "server/base/status.h"
#include "server/base/status_grpc.h"
#include "server/security/gatekeeper.h"
#include "server/service/call_metadata.h"

namespace revisit::server {
namespace {

// The key of a caller's limits. They are shared by all callers of a tenant, or,
// where nobody is asked who calls, by all programs at one address.
std::string QuotaKey(const Caller& caller,
                     const grpc::CallbackServerContext& context) {
  if (!caller.tenant.empty() && caller.tenant != "*") return caller.tenant;
  if (!caller.identity.empty()) return caller.identity;
  return AddressOf(context);
}

// Adds the request id to the ErrorInfo of an error.
absl::Status WithRequestId(const absl::Status& status, const std::string& id) {
  if (status.ok()) return status;
  absl::Status result = Named(status);
  google::rpc::ErrorInfo info;
  info.ParseFromString(std::string(*result.GetPayload(kErrorInfoUrl)));
  (*info.mutable_metadata())["request_id"] = id;
  result.SetPayload(kErrorInfoUrl, absl::Cord(info.SerializeAsString()));
  return result;
}

}  // namespace

Call::Call(grpc::CallbackServerContext* context, const char* method,
           const ServiceContext& service)
    : drain_(service.drain),
      meter_(service.meters->Find(context->peer())),
      rule_(FindMethodRule(method)),
      deadline_(context->deadline()),
      record_(service, method, rule_,
              {RequestIdOf(*context), TraceOf(*context), context->peer()}),
      entry_(drain_->Enter(needs_store())),
      rights_(
          service.gatekeeper,
          service.gatekeeper->asks() ? CredentialsOf(*context) : Credentials(),
          method, rule_),
      room_(service.admission, rule_),
      searches_(service.admission, deadline_) {
  context->AddInitialMetadata(kRequestIdKey, record_.request_id());
  record_.NameCaller(rights_.caller());
  if (!entry_.ok()) return;
  entry_ = rights_.entry();
  if (!entry_.ok()) return;
  CountMessage();
  const Caller& caller = rights_.caller();
  const std::string quota_key = QuotaKey(caller, *context);
  searches_.Enter(quota_key, caller.max_search_steps_per_second);
  entry_ = room_.Enter(quota_key);
}

absl::Status Call::ChooseVehicle(const std::string& id) {
  record_.NameVehicle(id);
  searches_.ChooseVehicle(id);
  if (absl::Status status = rights_.Choose(Resource::kVehicle, id);
      !status.ok()) {
    return status;
  }
  return room_.ChooseVehicle(id);
}

absl::Status Call::ChooseGroup(const std::string& id) {
  record_.NameGroup(id);
  if (absl::Status status = rights_.Choose(Resource::kGroup, id);
      !status.ok()) {
    return status;
  }
  return room_.ChooseGroup(id);
}

void Call::MarkGivenUp() {
  given_up_ = true;
  searches_.GiveBack();
}

absl::Status Call::GivenUpStatus() const {
  return std::chrono::system_clock::now() < deadline_ ? CallerGaveUp()
                                                      : DeadlinePassed();
}

grpc::Status Call::Conclude(const absl::Status& status) {
  room_.GiveBack();
  searches_.GiveBack();
  const absl::Status told = WithRequestId(status, record_.request_id());
  record_.End(told, std::string(status.message()));
  return ToGrpcStatus(told);
}

void Call::Leave() {
  rights_.Unwatch();
  record_.Leave();
  drain_->Leave();
}

}  // namespace revisit::server
