#include "server/storage/postgres/postgres_fence.h"

#include <algorithm>
#include <utility>

#include "server/storage/record_check.h"
#include "server/storage/record_checksum.h"

namespace revisit::server {
namespace {

constexpr Statement kVehicleRow = {
    "vehicle_row",
    "SELECT id, format, revision, checksum, payload FROM vehicles "
    "WHERE key = $1::int8"};
constexpr Statement kHeadRows = {
    "head_rows",
    "SELECT key, owner, epoch, revision, durable_sequence FROM heads "
    "WHERE key = ANY($1::int8[])"};

}  // namespace

const Claim& Compared(const Claim* claim) {
  static const Claim& none = *new Claim;
  return claim == nullptr || claim->has_ended ? none : *claim;
}

Parameters FenceOf(const Fence& fence) {
  Parameters parameters;
  const Claim& claim = Compared(fence.claim.get());
  parameters.Add(fence.key)
      .Add(claim.owner)
      .Add(claim.epoch)
      .Add(Signed(claim.revision));
  return parameters;
}

Parameters FenceOf(const Fence& fence, std::uint64_t revision) {
  return FenceOf(fence).Add(Signed(revision));
}

absl::StatusOr<VehicleRow> ReadVehicleRow(PostgresConnection& connection,
                                          const Fence& fence) {
  const auto rows = connection.Run(kVehicleRow, Parameters().Add(fence.key));
  if (!rows.ok()) return rows.status();
  if (rows->size() == 0) return GoneVehicle(fence);
  VehicleRow row;
  row.record.key = fence.key;
  row.record.id = rows->Bytes(0, 0);
  row.record.revision = Unsigned(rows->Integer(0, 2));
  row.checksum = rows->Integer(0, 3);
  row.record.payload = rows->Bytes(0, 4);
  CheckVehicleRow(rows->Integer(0, 1), row.checksum, &row.record);
  // A damaged row that is written again would pass for sound.
  if (!row.record.damage.ok()) return row.record.damage;
  return row;
}

Parameters Replacing(const Fence& fence, VehicleRow row,
                     const std::string& payload, std::uint64_t revision) {
  Parameters parameters = FenceOf(fence, revision);
  row.record.payload = payload;
  row.record.revision = std::max(row.record.revision, revision);
  parameters.Add(row.checksum)
      .Add(kSharedRowFormat)
      .Add(Signed(row.record.revision))
      .Add(ChecksumOfVehicle(kSharedRowFormat, row.record))
      .AddText(row.record.payload);
  return parameters;
}

void NoteWritten(const Fence& fence, std::uint64_t revision) {
  if (fence.claim == nullptr) return;
  // Written by the thread that writes the vehicle alone.
  fence.claim->revision = std::max(fence.claim->revision.load(), revision);
}

absl::StatusOr<std::map<VehicleKey, Head>> ReadHeads(
    PostgresConnection& connection, const std::vector<std::int64_t>& keys) {
  const auto rows = connection.Run(kHeadRows, Parameters().Add(keys));
  if (!rows.ok()) return rows.status();
  std::map<VehicleKey, Head> heads;
  for (int i = 0; i < rows->size(); ++i) {
    heads[rows->Integer(i, 0)] = {rows->GetUuid(i, 1), rows->Integer(i, 2),
                                  Unsigned(rows->Integer(i, 3)),
                                  Unsigned(rows->Integer(i, 4))};
  }
  return heads;
}

bool Holds(const Claim* claim, const Head& head) {
  return claim != nullptr && !claim->has_ended && claim->owner == head.owner &&
         claim->epoch == head.epoch && claim->revision == head.revision;
}

absl::Status GoneVehicle(const Fence& fence) {
  return &Compared(fence.claim.get()) == fence.claim.get()
             ? Fenced("vehicle '" + fence.claim->vehicle_id + "'")
             : UnknownVehicle(fence.key);
}

absl::Status WhyNotWritten(PostgresConnection& connection, const Fence& fence,
                           absl::Status otherwise) {
  const auto heads = ReadHeads(connection, {fence.key});
  if (!heads.ok()) return heads.status();
  const auto head = heads->find(fence.key);
  if (head == heads->end()) return GoneVehicle(fence);
  if (!Holds(fence.claim.get(), head->second)) {
    return Fenced("the vehicle of key " + std::to_string(fence.key));
  }
  return otherwise;
}

}  // namespace revisit::server
