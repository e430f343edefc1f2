// Copies a whole store into an empty one of any kind, with the keys of its
// vehicles.
#ifndef REVISIT_SERVER_STORAGE_STORE_COPY_H_
#define REVISIT_SERVER_STORAGE_STORE_COPY_H_

#include <optional>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/storage/group_records.h"
#include "server/storage/records.h"
#include "server/storage/store_report.h"

namespace revisit::server {

class Storage;

// An empty store that takes records, all or nothing: destroyed before Commit(),
// it leaves nothing behind.
class StoreIntake {
 public:
  virtual ~StoreIntake() = default;

  // Only key, id, payload and revision of the record are read.
  virtual absl::Status AddVehicle(const VehicleRecord& vehicle) = 0;
  // Batches come in order, after their vehicle.
  virtual absl::Status AddBatch(VehicleKey key, const BatchRecord& as_sent,
                                const std::optional<BatchRecord>& revised) = 0;
  virtual absl::Status AddPosePair(VehicleKey key, PairKind kind,
                                   const PosePairRecord& pair) = 0;
  // The record's own number is kept.
  virtual absl::Status AddDeletedPair(VehicleKey key,
                                      const DeletedPairRecord& deleted) = 0;
  // Adds checks of the vehicle, and sets its head. Its events stay behind,
  // since nobody can have read them in this store.
  virtual absl::Status AddChecks(VehicleKey key, const ChecksHead& head,
                                 const std::vector<CheckRecord>& checks) = 0;
  // Groups come after all vehicles, each before its members, and these before
  // its links. The record's own revision is kept.
  virtual absl::Status AddGroup(const GroupRecord& group) = 0;
  virtual absl::Status AddMember(const std::string& group_id,
                                 const GroupMemberRecord& member) = 0;
  virtual absl::Status AddLink(const std::string& group_id,
                               const GroupLinkRecord& link) = 0;
  virtual absl::Status Commit() = 0;
};

// Copies everything and commits; returns what was copied. DATA_LOSS
// (STORE_CORRUPT) if anything is damaged: a copy would pass for sound.
// REQUIRES: nobody writes to the source.
absl::StatusOr<StoreReport> CopyStore(Storage& source,
                                      StoreIntake* destination);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_STORE_COPY_H_
