// Checksums of stored records.
#ifndef REVISIT_SERVER_STORAGE_RECORD_CHECKSUM_H_
#define REVISIT_SERVER_STORAGE_RECORD_CHECKSUM_H_

#include <cstdint>
#include <string>

#include "server/storage/group_records.h"
#include "server/storage/records.h"

namespace revisit::server {

// XXH3, 64 bits, seed 0, over every column of a row: a letter for the table
// ('V', 'B', 'R', 'L', 'N', 'D', 'S', 'P', 'C', 'E', 'H', 'G', 'M', 'K'), then
// the columns in the order of the schema, integers as 8 bytes little-endian,
// text and blobs as their size (8 bytes) and their bytes. The columns include
// format version and vehicle key, so a row that ended up in another place fails
// too. It finds damage, not malice. The 64 bits are stored as SQLite's signed
// integer.
std::int64_t ChecksumOfVehicle(std::int64_t format, const VehicleRecord& row);
std::int64_t ChecksumOfBatch(std::int64_t format, VehicleKey key,
                             BatchVersion version, const BatchRecord& row);
// The format of rows in a database that servers of two versions share: it rises
// only if the columns of a row or its checksum change, and then one version
// after all servers can read the new rows.
inline constexpr std::int64_t kSharedRowFormat = 4;
std::int64_t ChecksumOfPosePair(std::int64_t format, VehicleKey key,
                                PairKind kind, const PosePairRecord& row);
std::int64_t ChecksumOfDeletedPair(std::int64_t format, VehicleKey key,
                                   const DeletedPairRecord& row);

std::int64_t ChecksumOfSnapshot(std::int64_t format, VehicleKey key,
                                const SnapshotRecord& row);
// `snapshot`: the key of the snapshot, which is none of a vehicle.
std::int64_t ChecksumOfSnapshotPart(std::int64_t format, std::int64_t snapshot,
                                    std::uint32_t number,
                                    absl::string_view payload);
// The marks of a vehicle (Storage::PutMarks()) are the part of this number,
// which none of a snapshot has: so they go with the others, also where a server
// of the version before, which does not know them, changes the poses.
inline constexpr std::uint32_t kMarksPart = 0x7fffffff;

std::int64_t ChecksumOfCheck(std::int64_t format, VehicleKey key,
                             const CheckRecord& row);
// An event is known by it also once its payload is gone.
std::int64_t ChecksumOfEvent(std::int64_t format, VehicleKey key,
                             const EventRecord& row);
std::int64_t ChecksumOfChecksHead(std::int64_t format, VehicleKey key,
                                  const ChecksHead& row);

// Without the revision, which the database raises itself where a vehicle goes.
std::int64_t ChecksumOfGroup(std::int64_t format, const GroupRecord& row);
std::int64_t ChecksumOfMember(std::int64_t format, const std::string& group_id,
                              const GroupMemberRecord& row);
std::int64_t ChecksumOfLink(std::int64_t format, const std::string& group_id,
                            const GroupLinkRecord& row);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_RECORD_CHECKSUM_H_
