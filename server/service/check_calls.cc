#include "server/service/check_calls.h"

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <map>
#include <set>
#include <string>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "server/base/status.h"
#include "server/conversion/names.h"
#include "server/conversion/page_token.h"
#include "server/conversion/stored_checks_codec.h"
#include "server/fields/enums.h"
#include "server/sessions/executor.h"
#include "server/storage/storage.h"

namespace revisit::server {
namespace {

// A page ends where it is longer than this, so that clients with the usual
// limit of 4 MiB can read it, and where so many checks were looked at.
constexpr std::size_t kMostPageBytes = std::size_t{1} << 20;
constexpr int kMostLookedAt = 2000;
constexpr int kVehiclesPerRead = 100;
constexpr int kChecksPerRead = 1000;
constexpr int kMostLooksPerKilometer = 1000;
constexpr char kAllVehicles[] = "vehicles/-";

absl::Status CheckNotFound(const ParsedCheckName& name) {
  return Error(
      absl::StatusCode::kNotFound, "CHECK_NOT_FOUND",
      absl::StrCat("vehicle '", name.vehicle_id,
                   "' has no stored check at sequence ", name.sequence));
}

// VEHICLE_NOT_FOUND where there is none.
absl::StatusOr<VehicleRecord> FindVehicle(Storage* storage,
                                          const std::string& id) {
  absl::StatusOr<VehicleRecord> vehicle = storage->GetVehicle(id);
  if (absl::IsNotFound(vehicle.status())) return VehicleNotFound(id);
  return vehicle;
}

MayReadVehicle RightsOf(const Caller& caller) {
  return [&caller](const std::string& vehicle_id) {
    return caller.May(Verb::kRead, vehicle_id);
  };
}

absl::Status ReadCheck(Storage* storage, const ParsedCheckName& name,
                       const Caller& caller, v1::Check* check) {
  const absl::StatusOr<VehicleRecord> vehicle =
      FindVehicle(storage, name.vehicle_id);
  if (!vehicle.ok()) return vehicle.status();
  const absl::StatusOr<std::vector<CheckRecord>> found = storage->ListChecks(
      vehicle->key, name.sequence, name.sequence, /*open_only=*/false, 1);
  if (!found.ok()) return found.status();
  if (found->empty()) return CheckNotFound(name);
  const absl::Status status =
      EncodeCheck(name.vehicle_id, found->front(), RightsOf(caller), check);
  if (!status.ok()) return status;
  // All that was kept is in vehicles that the caller may not read.
  if (check->states().empty()) return CheckNotFound(name);
  return absl::OkStatus();
}

// What a list is asked for, beside its place.
struct ListOptions {
  CandidateFilter filter;
  bool fresh_only = false;
  int looks_per_kilometer = 0;
  // Names the list in page tokens.
  std::string list;
  int page_size = 0;
};

// One page of a list of checks.
class Page {
 public:
  Page(Storage* storage, const Caller& caller, ListOptions options,
       v1::ListChecksResponse* response)
      : storage_(storage),
        caller_(caller),
        options_(std::move(options)),
        response_(response) {}

  // The checks of one vehicle that come behind the place.
  absl::Status ListOf(const std::string& vehicle_id,
                      const VehiclePlace& after) {
    const absl::StatusOr<VehicleRecord> vehicle =
        FindVehicle(storage_, vehicle_id);
    if (!vehicle.ok()) return vehicle.status();
    return Add(*vehicle, after.sequence + 1);
  }

  // The same, the most valuable first. The place is the count of those before.
  absl::Status ListByValue(const std::string& vehicle_id,
                           const VehiclePlace& after) {
    const absl::StatusOr<VehicleRecord> vehicle =
        FindVehicle(storage_, vehicle_id);
    if (!vehicle.ok()) return vehicle.status();
    const absl::StatusOr<std::vector<Ranked>> ranked = Rank(*vehicle);
    if (!ranked.ok()) return ranked.status();
    std::size_t next = std::min<std::size_t>(after.sequence, ranked->size());
    for (; next < ranked->size(); ++next) {
      if (response_->checks_size() == options_.page_size ||
          bytes_ > kMostPageBytes) {
        response_->set_next_page_token(
            MakePageToken(options_.list, VehiclePlace{vehicle_id, next}));
        break;
      }
      const std::uint64_t sequence = (*ranked)[next].sequence;
      const absl::StatusOr<std::vector<CheckRecord>> found =
          storage_->ListChecks(vehicle->key, sequence, sequence, false, 1);
      if (!found.ok()) return found.status();
      // It may have gone since.
      if (found->empty()) continue;
      v1::Check check;
      const absl::Status status =
          EncodeCheck(vehicle_id, found->front(), RightsOf(caller_), &check);
      if (!status.ok()) return status;
      for (v1::CheckCandidate& candidate : *check.mutable_states()) {
        candidate.set_recommended(recommended_.count(candidate.name()) > 0);
      }
      Take(&check);
    }
    return absl::OkStatus();
  }

  // Those of all vehicles that the caller may read. The others leave no trace.
  absl::Status ListAll(const VehiclePlace& after) {
    if (!after.vehicle_id.empty() && IsWanted(after.vehicle_id)) {
      const absl::StatusOr<VehicleRecord> vehicle =
          storage_->GetVehicle(after.vehicle_id);
      absl::Status status = vehicle.status();
      if (vehicle.ok()) status = Add(*vehicle, after.sequence + 1);
      if (!status.ok() && !absl::IsNotFound(status)) return status;
    }
    for (const std::string& prefix : caller_.PrefixesOf(Verb::kRead)) {
      std::string place = after.vehicle_id;
      for (bool past = false; !past && !is_full_;) {
        const auto records =
            storage_->ListVehicles(place, prefix, kVehiclesPerRead);
        if (!records.ok()) return records.status();
        past = static_cast<int>(records->size()) < kVehiclesPerRead;
        for (const VehicleRecord& record : *records) {
          if (is_full_) break;
          // One that never had an event has no check.
          if (record.checks.last_event == 0 || !IsWanted(record.id)) continue;
          const absl::Status status = Add(record, 1);
          // It may have been deleted since.
          if (!status.ok() && !absl::IsNotFound(status)) return status;
        }
        if (!past) place = records->back().id;
      }
    }
    return absl::OkStatus();
  }

 private:
  bool IsWanted(const std::string& vehicle_id) const {
    return caller_.May(Verb::kRead, vehicle_id) &&
           (options_.filter.vehicles.empty() ||
            options_.filter.vehicles.count(vehicle_id) > 0);
  }

  bool IsWanted(const v1::Check& check) const {
    return (!options_.fresh_only || !check.stale()) &&
           Matches(options_.filter, check);
  }

  void Take(v1::Check* check) {
    bytes_ += check->ByteSizeLong();
    response_->add_checks()->Swap(check);
  }

  // A check in the order of value.
  struct Ranked {
    // The value of its most valuable open candidate; negative if it has none. A
    // loop closure that others contradict comes before all.
    double value = -1.0;
    std::uint64_t sequence = 0;
  };

  // An open candidate, for the looks of its kilometre.
  struct Look {
    double value = 0.0;
    std::string name;
  };

  // All checks of the vehicle that are wanted, in the order of value, and what
  // is recommended of them.
  absl::StatusOr<std::vector<Ranked>> Rank(const VehicleRecord& vehicle) {
    std::vector<Ranked> ranked;
    std::map<std::int64_t, std::vector<Look>> looks;
    for (std::uint64_t first = 1;;) {
      const absl::StatusOr<std::vector<CheckRecord>> records =
          storage_->ListChecks(vehicle.key, first, kLastSequence, false,
                               kChecksPerRead);
      if (!records.ok()) return records.status();
      for (const CheckRecord& record : *records) {
        v1::Check check;
        const absl::Status status =
            EncodeCheck(vehicle.id, record, RightsOf(caller_), &check);
        if (!status.ok()) return status;
        if (!IsWanted(check)) continue;
        Ranked one;
        one.sequence = record.sequence;
        const auto kilometer = static_cast<std::int64_t>(
            check.candidates().query().travelled_meters() / 1000.0);
        for (const v1::CheckCandidate& candidate : check.states()) {
          if (candidate.state() != v1::CANDIDATE_STATE_OPEN ||
              !Matches(options_.filter, check, candidate)) {
            continue;
          }
          const double value =
              candidate.cause() == v1::CANDIDATE_CAUSE_CONTRADICTION
                  ? std::numeric_limits<double>::infinity()
                  : candidate.value_square_meters();
          one.value = std::max(one.value, value);
          looks[kilometer].push_back({value, candidate.name()});
        }
        ranked.push_back(one);
      }
      if (static_cast<int>(records->size()) < kChecksPerRead) break;
      first = records->back().sequence + 1;
    }
    std::sort(ranked.begin(), ranked.end(),
              [](const Ranked& a, const Ranked& b) {
                return a.value != b.value ? a.value > b.value
                                          : a.sequence < b.sequence;
              });
    const auto most = static_cast<std::size_t>(options_.looks_per_kilometer);
    for (auto& [kilometer, of_it] : looks) {
      std::stable_sort(
          of_it.begin(), of_it.end(),
          [](const Look& a, const Look& b) { return a.value > b.value; });
      for (std::size_t i = 0; i < std::min(most, of_it.size()); ++i) {
        recommended_.insert(of_it[i].name);
      }
    }
    return ranked;
  }

  absl::Status Add(const VehicleRecord& vehicle, std::uint64_t first) {
    const bool open_only =
        options_.filter.states ==
        std::set<v1::CandidateState>{v1::CANDIDATE_STATE_OPEN};
    while (!is_full_) {
      const int wanted = options_.page_size - response_->checks_size() + 1;
      const absl::StatusOr<std::vector<CheckRecord>> records =
          storage_->ListChecks(vehicle.key, first, kLastSequence, open_only,
                               wanted);
      if (!records.ok()) return records.status();
      for (const CheckRecord& record : *records) {
        if (response_->checks_size() == options_.page_size ||
            bytes_ > kMostPageBytes || looked_at_ == kMostLookedAt) {
          is_full_ = true;
          // Behind what was looked at.
          response_->set_next_page_token(MakePageToken(
              options_.list, VehiclePlace{vehicle.id, record.sequence - 1}));
          return absl::OkStatus();
        }
        ++looked_at_;
        v1::Check check;
        const absl::Status status =
            EncodeCheck(vehicle.id, record, RightsOf(caller_), &check);
        if (!status.ok()) return status;
        if (IsWanted(check)) Take(&check);
      }
      if (static_cast<int>(records->size()) < wanted) return absl::OkStatus();
      first = records->back().sequence + 1;
    }
    return absl::OkStatus();
  }

  Storage* const storage_;
  const Caller& caller_;
  const ListOptions options_;
  v1::ListChecksResponse* const response_;
  bool is_full_ = false;
  std::size_t bytes_ = 0;
  int looked_at_ = 0;
  // Names of candidates.
  std::set<std::string> recommended_;
};

// Whether the order and what goes with it can be had of the parent.
absl::StatusOr<bool> DecodeOrder(const v1::ListChecksRequest& request) {
  const bool by_value = request.order() == v1::LIST_CHECKS_ORDER_BY_VALUE;
  Violations violations;
  if (!v1::ListChecksOrder_IsValid(request.order())) {
    AddUnknownValue(request.order(), kRequest.Field("order"), &violations);
  }
  if (by_value && request.parent() == kAllVehicles) {
    violations.Add(kInvalidField, kRequest.Field("order"),
                   "BY_VALUE is the order of one vehicle's checks; got the "
                   "parent vehicles/-");
  }
  const int looks = request.looks_per_kilometer();
  if (looks < 0 || looks > kMostLooksPerKilometer) {
    violations.Add(kInvalidField, kRequest.Field("looks_per_kilometer"),
                   absl::StrCat("got ", looks, "; allowed is [0, ",
                                kMostLooksPerKilometer, "]"));
  } else if (looks > 0 && !by_value) {
    violations.Add(kInvalidField, kRequest.Field("looks_per_kilometer"),
                   "looks are recommended in the order BY_VALUE only");
  }
  if (violations.count() > 0) return violations.ToStatus();
  return by_value;
}

}  // namespace

absl::Status GetCheck(const ServiceContext& service, const UnaryCallPtr& call,
                      const v1::GetCheckRequest& request,
                      v1::GetCheckResponse* response) {
  const absl::StatusOr<ParsedCheckName> name =
      ParseCheckName(request.name(), kRequest.Field("name"));
  if (!name.ok()) return name.status();
  if (absl::Status status = call->ChooseVehicle(name->vehicle_id);
      !status.ok()) {
    return status;
  }
  service.executor->Post([=, name = *name, storage = service.storage] {
    call->End(ReadCheck(storage, name, call->rights().caller(),
                        response->mutable_check()));
  });
  return absl::OkStatus();
}

absl::Status ListChecks(const ServiceContext& service, const UnaryCallPtr& call,
                        const v1::ListChecksRequest& request,
                        v1::ListChecksResponse* response) {
  std::string vehicle_id;
  if (request.parent() != kAllVehicles) {
    absl::StatusOr<std::string> id =
        ParseVehicleName(request.parent(), kRequest.Field("parent"));
    if (!id.ok()) return id.status();
    if (absl::Status status = call->ChooseVehicle(*id); !status.ok()) {
      return status;
    }
    vehicle_id = *std::move(id);
  }
  const absl::StatusOr<bool> by_value = DecodeOrder(request);
  if (!by_value.ok()) return by_value.status();
  const std::string list =
      absl::StrCat("ListChecks ", request.parent(), *by_value ? " value" : "");
  const absl::StatusOr<int> page_size =
      PageSize(request.page_size(), 100, 1000);
  if (!page_size.ok()) return page_size.status();
  const absl::StatusOr<VehiclePlace> after =
      ParsePlaceToken(list, request.page_token());
  if (!after.ok()) return after.status();
  const absl::StatusOr<CandidateFilter> filter =
      DecodeFilter(request.filter(), kRequest.Field("filter"));
  if (!filter.ok()) return filter.status();
  const ListOptions options{*filter, request.fresh_only(),
                            request.looks_per_kilometer(), list, *page_size};
  service.executor->Post([=, storage = service.storage, after = *after,
                          by_value = *by_value,
                          is_first = request.page_token().empty()] {
    if (is_first) {
      const absl::StatusOr<EventPosition> last = storage->LastEvent();
      if (!last.ok()) {
        call->End(last.status());
        return;
      }
      response->set_watch_cursor(MakeCursor(*last));
    }
    Page page(storage, call->rights().caller(), options, response);
    call->End(vehicle_id.empty() ? page.ListAll(after)
              : by_value         ? page.ListByValue(vehicle_id, after)
                                 : page.ListOf(vehicle_id, after));
  });
  return absl::OkStatus();
}

}  // namespace revisit::server
