#include "server/service/caller_rights.h"

#include <chrono>
#include <utility>

#include "absl/status/statusor.h"
#include "server/base/status.h"

namespace revisit::server {
namespace {

std::shared_ptr<const Caller> Nobody() {
  static const auto* const nobody = new std::shared_ptr<const Caller>([] {
    auto caller = std::make_shared<Caller>();
    caller->grants.emplace();
    return caller;
  }());
  return *nobody;
}

}  // namespace

CallerRights::CallerRights(Gatekeeper* gatekeeper, Credentials credentials,
                           const char* method, const MethodRule* rule)
    : gatekeeper_(gatekeeper),
      method_(method),
      rule_(rule),
      credentials_(std::move(credentials)) {
  auto caller =
      gatekeeper_->Admit(credentials_, std::chrono::system_clock::now());
  entry_ = caller.status();
  caller_ = caller.ok() ? *std::move(caller) : Nobody();
}

Verb CallerRights::MethodVerb() const {
  if (rule_ == nullptr) return Verb::kAdmin;
  return rule_->verb.value_or(Verb::kAdmin);
}

absl::Status CallerRights::Check(const Caller& caller,
                                 const std::string& vehicle, Verb verb) const {
  if (caller.May(verb, vehicle)) return absl::OkStatus();
  const bool creates = rule_ != nullptr && rule_->creates;
  if (!caller.MaySee(vehicle) && !creates) return VehicleNotFound(vehicle);
  return Error(absl::StatusCode::kPermissionDenied, "NOT_GRANTED",
               std::string(method_) + " needs the verb " + VerbName(verb) +
                   " on this vehicle, which is not granted to the caller",
               {{"verb", VerbName(verb)}});
}

absl::Status CallerRights::ChooseVehicle(const std::string& id) {
  const MutexLock lock(&mutex_);
  vehicle_ = id;
  needs_ = {MethodVerb()};
  return Check(*caller_, vehicle_, MethodVerb());
}

absl::Status CallerRights::AlsoNeeds(Verb verb) {
  const MutexLock lock(&mutex_);
  needs_.insert(needs_.begin(), verb);
  return Check(*caller_, vehicle_, verb);
}

std::shared_ptr<const Caller> CallerRights::Now() const {
  auto caller =
      gatekeeper_->Admit(credentials_, std::chrono::system_clock::now());
  return caller.ok() ? *std::move(caller) : Nobody();
}

absl::Status CallerRights::Recheck() const {
  const auto caller =
      gatekeeper_->Admit(credentials_, std::chrono::system_clock::now());
  if (!caller.ok()) return caller.status();
  const MutexLock lock(&mutex_);
  for (const Verb verb : needs_) {
    if (absl::Status status = Check(**caller, vehicle_, verb); !status.ok()) {
      return status;
    }
  }
  return absl::OkStatus();
}

void CallerRights::Watch(std::function<void()> recheck) {
  watch_ = gatekeeper_->Watch(caller_->expires, std::move(recheck));
}

void CallerRights::Unwatch() {
  if (watch_ >= 0) gatekeeper_->Unwatch(watch_);
}

}  // namespace revisit::server
