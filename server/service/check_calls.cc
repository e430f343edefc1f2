#include "server/service/check_calls.h"

#include <cstddef>
#include <cstdint>
#include <string>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "server/base/status.h"
#include "server/conversion/names.h"
#include "server/conversion/page_token.h"
#include "server/conversion/stored_checks_codec.h"
#include "server/sessions/executor.h"
#include "server/storage/storage.h"

namespace revisit::server {
namespace {

// A page ends where it is longer than this, so that clients with the usual
// limit of 4 MiB can read it, and where so many checks were looked at.
constexpr std::size_t kMostPageBytes = std::size_t{1} << 20;
constexpr int kMostLookedAt = 2000;
constexpr int kVehiclesPerRead = 100;

absl::Status CheckNotFound(const ParsedCheckName& name) {
  return Error(
      absl::StatusCode::kNotFound, "CHECK_NOT_FOUND",
      absl::StrCat("vehicle '", name.vehicle_id,
                   "' has no stored check at sequence ", name.sequence));
}

absl::Status ReadCheck(Storage* storage, const ParsedCheckName& name,
                       v1::Check* check) {
  const absl::StatusOr<VehicleRecord> vehicle =
      storage->GetVehicle(name.vehicle_id);
  if (absl::IsNotFound(vehicle.status())) {
    return VehicleNotFound(name.vehicle_id);
  }
  if (!vehicle.ok()) return vehicle.status();
  const absl::StatusOr<std::vector<CheckRecord>> found = storage->ListChecks(
      vehicle->key, name.sequence, name.sequence, /*open_only=*/false, 1);
  if (!found.ok()) return found.status();
  if (found->empty()) return CheckNotFound(name);
  return EncodeCheck(name.vehicle_id, found->front(), check);
}

// One page of a list of checks.
class Page {
 public:
  Page(Storage* storage, const Caller& caller, CandidateFilter filter,
       std::string list, int page_size, v1::ListChecksResponse* response)
      : storage_(storage),
        caller_(caller),
        filter_(std::move(filter)),
        list_(std::move(list)),
        page_size_(page_size),
        response_(response) {}

  // The checks of one vehicle that come behind the place.
  absl::Status ListOf(const std::string& vehicle_id,
                      const VehiclePlace& after) {
    const absl::StatusOr<VehicleRecord> vehicle =
        storage_->GetVehicle(vehicle_id);
    if (absl::IsNotFound(vehicle.status())) return VehicleNotFound(vehicle_id);
    if (!vehicle.ok()) return vehicle.status();
    return Add(*vehicle, after.sequence + 1);
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
           (filter_.vehicles.empty() || filter_.vehicles.count(vehicle_id) > 0);
  }

  absl::Status Add(const VehicleRecord& vehicle, std::uint64_t first) {
    const bool open_only = filter_.states == std::set<v1::CandidateState>{
                                                 v1::CANDIDATE_STATE_OPEN};
    while (!is_full_) {
      const int wanted = page_size_ - response_->checks_size() + 1;
      const absl::StatusOr<std::vector<CheckRecord>> records =
          storage_->ListChecks(vehicle.key, first, kLastSequence, open_only,
                               wanted);
      if (!records.ok()) return records.status();
      for (const CheckRecord& record : *records) {
        if (response_->checks_size() == page_size_ || bytes_ > kMostPageBytes ||
            looked_at_ == kMostLookedAt) {
          is_full_ = true;
          // Behind what was looked at.
          response_->set_next_page_token(MakePageToken(
              list_, VehiclePlace{vehicle.id, record.sequence - 1}));
          return absl::OkStatus();
        }
        ++looked_at_;
        v1::Check check;
        const absl::Status status = EncodeCheck(vehicle.id, record, &check);
        if (!status.ok()) return status;
        if (!Matches(filter_, check)) continue;
        bytes_ += check.ByteSizeLong();
        response_->add_checks()->Swap(&check);
      }
      if (static_cast<int>(records->size()) < wanted) return absl::OkStatus();
      first = records->back().sequence + 1;
    }
    return absl::OkStatus();
  }

  Storage* const storage_;
  const Caller& caller_;
  const CandidateFilter filter_;
  const std::string list_;
  const int page_size_;
  v1::ListChecksResponse* const response_;
  bool is_full_ = false;
  std::size_t bytes_ = 0;
  int looked_at_ = 0;
};

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
    call->End(ReadCheck(storage, name, response->mutable_check()));
  });
  return absl::OkStatus();
}

absl::Status ListChecks(const ServiceContext& service, const UnaryCallPtr& call,
                        const v1::ListChecksRequest& request,
                        v1::ListChecksResponse* response) {
  std::string vehicle_id;
  if (request.parent() != "vehicles/-") {
    absl::StatusOr<std::string> id =
        ParseVehicleName(request.parent(), kRequest.Field("parent"));
    if (!id.ok()) return id.status();
    if (absl::Status status = call->ChooseVehicle(*id); !status.ok()) {
      return status;
    }
    vehicle_id = *std::move(id);
  }
  const std::string list = absl::StrCat("ListChecks ", request.parent());
  const absl::StatusOr<int> page_size =
      PageSize(request.page_size(), 100, 1000);
  if (!page_size.ok()) return page_size.status();
  const absl::StatusOr<VehiclePlace> after =
      ParsePlaceToken(list, request.page_token());
  if (!after.ok()) return after.status();
  const absl::StatusOr<CandidateFilter> filter =
      DecodeFilter(request.filter(), kRequest.Field("filter"));
  if (!filter.ok()) return filter.status();
  service.executor->Post([=, storage = service.storage, after = *after,
                          filter = *filter, page_size = *page_size,
                          is_first = request.page_token().empty()] {
    if (is_first) {
      const absl::StatusOr<EventPosition> last = storage->LastEvent();
      if (!last.ok()) {
        call->End(last.status());
        return;
      }
      response->set_watch_cursor(MakeCursor(*last));
    }
    Page page(storage, call->rights().caller(), filter, list, page_size,
              response);
    call->End(vehicle_id.empty() ? page.ListAll(after)
                                 : page.ListOf(vehicle_id, after));
  });
  return absl::OkStatus();
}

}  // namespace revisit::server
