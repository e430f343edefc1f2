#include "server/storage/store_copy.h"

#include <cstddef>
#include <cstdint>
#include <string>
#include <utility>
#include <vector>

#include "server/storage/storage.h"

namespace revisit::server {
namespace {

// Read at a time.
constexpr int kVehicles = 100;
constexpr std::size_t kBatches = 256;

class Copier {
 public:
  Copier(Storage& source, StoreIntake* destination)
      : source_(source), destination_(destination) {}

  absl::StatusOr<StoreReport> Copy() {
    std::string after;
    while (true) {
      const auto page = source_.ListVehicles(after, "", kVehicles);
      if (!page.ok()) return page.status();
      if (page->empty()) break;
      for (const VehicleRecord& vehicle : *page) {
        absl::Status status = CopyVehicle(vehicle);
        if (!status.ok()) return status;
      }
      after = page->back().id;
    }
    absl::Status status = VisitGroups(
        source_, [this](const GroupRecord& group) { return CopyGroup(group); });
    if (status.ok()) status = destination_->Commit();
    if (!status.ok()) return status;
    return report_;
  }

 private:
  absl::Status CopyVehicle(const VehicleRecord& vehicle) {
    if (!vehicle.damage.ok()) return vehicle.damage;
    absl::Status status = destination_->AddVehicle(vehicle);
    if (!status.ok()) return status;
    ++report_.vehicles;
    std::uint64_t next = 1;
    while (next <= vehicle.durable_sequence) {
      status = CopyBatches(vehicle, &next);
      if (!status.ok()) return status;
    }
    for (const PairKind kind : kPairKinds) {
      status = VisitPosePairs(
          source_, vehicle.key, kind, [&](const PosePairRecord& pair) {
            ++(kind == PairKind::kLoopClosure ? report_.loop_closures
                                              : report_.rejected_candidates);
            return destination_->AddPosePair(vehicle.key, kind, pair);
          });
      if (!status.ok()) return status;
    }
    status = VisitDeletedPairs(
        source_, vehicle.key, [&](const DeletedPairRecord& deleted) {
          ++report_.deleted_pairs;
          return destination_->AddDeletedPair(vehicle.key, deleted);
        });
    if (!status.ok() || vehicle.checks == ChecksHead()) return status;
    status = destination_->AddChecks(vehicle.key, vehicle.checks, {});
    if (!status.ok()) return status;
    return VisitChecks(
        source_, vehicle.key, [&](const std::vector<CheckRecord>& checks) {
          report_.checks += static_cast<std::int64_t>(checks.size());
          return destination_->AddChecks(vehicle.key, vehicle.checks, checks);
        });
  }

  absl::Status CopyGroup(const GroupRecord& group) {
    absl::Status status = destination_->AddGroup(group);
    if (!status.ok()) return status;
    ++report_.groups;
    status =
        VisitMembers(source_, group.id, [&](const GroupMemberRecord& member) {
          ++report_.members;
          return destination_->AddMember(group.id, member);
        });
    if (!status.ok()) return status;
    return VisitLinks(source_, group.id, [&](const GroupLinkRecord& link) {
      ++report_.links;
      return destination_->AddLink(group.id, link);
    });
  }

  absl::StatusOr<std::vector<BatchRecord>> Read(const VehicleRecord& vehicle,
                                                std::uint64_t first,
                                                BatchVersion version) {
    std::vector<BatchRecord> batches;
    const absl::Status status =
        source_.ReadBatches(vehicle.key, first, vehicle.durable_sequence,
                            version, [&](BatchRecord batch) {
                              batches.push_back(std::move(batch));
                              return batches.size() < kBatches;
                            });
    if (!status.ok()) return status;
    return batches;
  }

  // Copies some batches from `*next` on, and sets it after them.
  absl::Status CopyBatches(const VehicleRecord& vehicle, std::uint64_t* next) {
    const auto as_sent = Read(vehicle, *next, BatchVersion::kAsSent);
    if (!as_sent.ok()) return as_sent.status();
    const auto current = Read(vehicle, *next, BatchVersion::kCurrent);
    if (!current.ok()) return current.status();
    for (std::size_t i = 0; i < as_sent->size(); ++i) {
      const BatchRecord& sent = (*as_sent)[i];
      const BatchRecord& now = (*current)[i];
      std::optional<BatchRecord> revised;
      if (now.revision != sent.revision || now.payload != sent.payload) {
        revised = now;
        ++report_.revised_batches;
      }
      absl::Status status = destination_->AddBatch(vehicle.key, sent, revised);
      if (!status.ok()) return status;
      ++report_.batches;
      report_.poses += sent.count;
      *next = sent.first_sequence + sent.count;
    }
    return absl::OkStatus();
  }

  Storage& source_;
  StoreIntake* const destination_;
  StoreReport report_;
};

}  // namespace

absl::StatusOr<StoreReport> CopyStore(Storage& source,
                                      StoreIntake* destination) {
  return Copier(source, destination).Copy();
}

}  // namespace revisit::server
