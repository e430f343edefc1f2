// The common part of writes under a claim: SQL that compares the claim with
// the vehicle's head, the values for it, and why a statement wrote nothing.
#ifndef REVISIT_SERVER_STORAGE_POSTGRES_POSTGRES_FENCE_H_
#define REVISIT_SERVER_STORAGE_POSTGRES_POSTGRES_FENCE_H_

#include <cstdint>
#include <map>
#include <memory>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/storage/postgres/connection.h"
#include "server/storage/postgres/ownership.h"
#include "server/storage/records.h"

namespace revisit::server {

// A vehicle and the claim under which it is written; null if there was none.
struct Fence {
  VehicleKey key = 0;
  std::shared_ptr<const Claim> claim;
};

// ---- SQL

// The head is as the claim knows it: a database that lacks the last commits,
// whatever they wrote, is at an earlier revision. $1 key, $2 owner, $3 epoch,
// $4 revision.
#define REVISIT_HEAD_HOLDS                           \
  "key = $1::int8 AND owner = $2::uuid AND epoch = " \
  "$3::int8 AND revision = $4::int8"
// The beginning of every write but an append: it leaves the vehicle's key in
// `h`, or nothing if the claim or the conditions do not hold. $5 new revision.
#define REVISIT_FENCE(MORE_CHANGES, MORE_CONDITIONS) \
  "WITH h AS (UPDATE heads SET revision = "          \
  "greatest(revision, $5::int8)" MORE_CHANGES        \
  " WHERE " REVISIT_HEAD_HOLDS MORE_CONDITIONS " RETURNING key) "
// The vehicle's row is as it was when its new version was made: $6 checksum.
#define REVISIT_UNCHANGED                                         \
  " AND EXISTS (SELECT 1 FROM vehicles WHERE key = $1::int8 AND " \
  "checksum = $6::int8)"
// $7 format, $8 revision, $9 checksum, $10 payload.
#define REVISIT_REPLACE_VEHICLE                                           \
  "UPDATE vehicles v SET format = $7::int8, revision = $8::int8, "        \
  "checksum = $9::int8, payload = $10::bytea FROM h WHERE v.key = h.key " \
  "RETURNING v.key"

// ---- Values

// The claim with which a head is compared. Nothing is written under one that
// has ended: it becomes one that no vehicle has.
const Claim& Compared(const Claim* claim);
// $1 to $4, and with the new revision $5. Call right before the statement: the
// claim's revision is that of the write before.
Parameters FenceOf(const Fence& fence);
Parameters FenceOf(const Fence& fence, std::uint64_t revision);

// The vehicle's row, and the checksum by which it is known again.
struct VehicleRow {
  VehicleRecord record;
  std::int64_t checksum = 0;
};
// As GoneVehicle() if there is none; DATA_LOSS (STORE_CORRUPT) if it is
// damaged.
absl::StatusOr<VehicleRow> ReadVehicleRow(PostgresConnection& connection,
                                          const Fence& fence);
// $1 to $10, for a statement that replaces the vehicle's row.
Parameters Replacing(const Fence& fence, VehicleRow row,
                     const std::string& payload, std::uint64_t revision);

// ---- After a statement

// Notes that a write was stored which brought the vehicle to this revision, if
// it was at a lower one.
void NoteWritten(const Fence& fence, std::uint64_t revision);

struct Head {
  Uuid owner;
  std::int64_t epoch;
  std::uint64_t revision;
  std::uint64_t durable_sequence;
};
absl::StatusOr<std::map<VehicleKey, Head>> ReadHeads(
    PostgresConnection& connection, const std::vector<std::int64_t>& keys);
bool Holds(const Claim* claim, const Head& head);
// Why there is no head: NOT_FOUND (VEHICLE_NOT_FOUND), or, where the vehicle
// was there when it was claimed, ABORTED (EPOCH_FENCED): the database may have
// it under another key, after it lost the first.
absl::Status GoneVehicle(const Fence& fence);
// Why a write that is no append wrote nothing: `otherwise`, if the claim holds.
absl::Status WhyNotWritten(PostgresConnection& connection, const Fence& fence,
                           absl::Status otherwise);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_POSTGRES_POSTGRES_FENCE_H_
