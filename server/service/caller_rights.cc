#include "server/service/caller_rights.h"

#include <chrono>
#include <utility>

#include "absl/status/statusor.h"
#include "server/base/status.h"
#include "server/storage/group_check.h"

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

absl::Status CallerRights::Check(const Caller& caller, const Need& need) const {
  const auto& [verb, resource, id] = need;
  if (caller.May(verb, id, resource)) return absl::OkStatus();
  const bool is_vehicle = resource == Resource::kVehicle;
  const bool creates = rule_ != nullptr && rule_->creates;
  if (!caller.MaySee(id, resource) && !creates) {
    return is_vehicle ? VehicleNotFound(id) : NoSuchGroup(id);
  }
  return Error(absl::StatusCode::kPermissionDenied, "NOT_GRANTED",
               std::string(method_) + " needs the verb " + VerbName(verb) +
                   (is_vehicle ? " on this vehicle" : " on this group") +
                   ", which is not granted to the caller",
               {{"verb", VerbName(verb)}});
}

absl::Status CallerRights::AddNeed(Need need) {
  needs_.insert(needs_.begin(), std::move(need));
  return Check(*caller_, needs_.front());
}

absl::Status CallerRights::Choose(Resource resource, const std::string& id) {
  const MutexLock lock(&mutex_);
  needs_.clear();
  return AddNeed({MethodVerb(), resource, id});
}

absl::Status CallerRights::AlsoNeeds(Verb verb) {
  const MutexLock lock(&mutex_);
  Need need = needs_.back();
  need.verb = verb;
  return AddNeed(std::move(need));
}

absl::Status CallerRights::AlsoNeeds(Verb verb, const std::string& id,
                                     Resource resource) {
  const MutexLock lock(&mutex_);
  return AddNeed({verb, resource, id});
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
  for (const Need& need : needs_) {
    if (absl::Status status = Check(**caller, need); !status.ok()) {
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
