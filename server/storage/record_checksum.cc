#include "server/storage/record_checksum.h"

#include <array>
#include <cstddef>
#include <memory>

#include "xxhash.h"

namespace revisit::server {
namespace {

class Hasher {
 public:
  explicit Hasher(char table) {
    XXH3_64bits_reset(state_.get());
    XXH3_64bits_update(state_.get(), &table, 1);
  }

  Hasher& Add(std::uint64_t value) {
    std::array<unsigned char, 8> bytes;
    for (std::size_t i = 0; i < bytes.size(); ++i) {
      bytes[i] = static_cast<unsigned char>(value >> (8 * i));
    }
    XXH3_64bits_update(state_.get(), bytes.data(), bytes.size());
    return *this;
  }

  Hasher& Add(std::int64_t value) {
    return Add(static_cast<std::uint64_t>(value));
  }

  Hasher& Add(absl::string_view bytes) {
    Add(static_cast<std::uint64_t>(bytes.size()));
    XXH3_64bits_update(state_.get(), bytes.data(), bytes.size());
    return *this;
  }

  std::int64_t Digest() const {
    return static_cast<std::int64_t>(XXH3_64bits_digest(state_.get()));
  }

 private:
  struct Free {
    void operator()(XXH3_state_t* state) const { XXH3_freeState(state); }
  };

  std::unique_ptr<XXH3_state_t, Free> state_{XXH3_createState()};
};

}  // namespace

std::int64_t ChecksumOfVehicle(std::int64_t format, const VehicleRecord& row) {
  return Hasher('V')
      .Add(row.key)
      .Add(row.id)
      .Add(format)
      .Add(row.revision)
      .Add(row.payload)
      .Digest();
}

std::int64_t ChecksumOfBatch(std::int64_t format, VehicleKey key,
                             BatchVersion version, const BatchRecord& row) {
  return Hasher(version == BatchVersion::kAsSent ? 'B' : 'R')
      .Add(key)
      .Add(row.first_sequence)
      .Add(static_cast<std::uint64_t>(row.count))
      .Add(format)
      .Add(row.revision)
      .Add(row.payload)
      .Digest();
}

std::int64_t ChecksumOfPosePair(std::int64_t format, VehicleKey key,
                                PairKind kind, const PosePairRecord& row) {
  return Hasher(kind == PairKind::kLoopClosure ? 'L' : 'N')
      .Add(key)
      .Add(row.id)
      .Add(format)
      .Add(row.query_sequence)
      .Add(row.matched_sequence)
      .Add(row.create_time_ns)
      .Add(row.payload)
      .Digest();
}

std::int64_t ChecksumOfDeletedPair(std::int64_t format, VehicleKey key,
                                   const DeletedPairRecord& row) {
  return Hasher('D')
      .Add(key)
      .Add(row.number)
      .Add(NumberOf(row.kind))
      .Add(row.pair.id)
      .Add(format)
      .Add(row.pair.query_sequence)
      .Add(row.pair.matched_sequence)
      .Add(row.pair.create_time_ns)
      .Add(row.delete_time_ns)
      .Add(row.pair.payload)
      .Digest();
}

std::int64_t ChecksumOfSnapshot(std::int64_t format, VehicleKey key,
                                const SnapshotRecord& row) {
  return Hasher('S')
      .Add(key)
      .Add(format)
      .Add(row.last_sequence)
      .Add(static_cast<std::uint64_t>(row.part_count))
      .Add(row.payload)
      .Digest();
}

std::int64_t ChecksumOfSnapshotPart(std::int64_t format, std::int64_t snapshot,
                                    std::uint32_t number,
                                    absl::string_view payload) {
  return Hasher('P')
      .Add(snapshot)
      .Add(static_cast<std::uint64_t>(number))
      .Add(format)
      .Add(payload)
      .Digest();
}

std::int64_t ChecksumOfCheck(std::int64_t format, VehicleKey key,
                             const CheckRecord& row) {
  return Hasher('C')
      .Add(key)
      .Add(row.sequence)
      .Add(format)
      .Add(row.revision)
      .Add(static_cast<std::uint64_t>(row.open_count))
      .Add(row.create_time_ns)
      .Add(row.payload)
      .Digest();
}

std::int64_t ChecksumOfEvent(std::int64_t format, VehicleKey key,
                             const EventRecord& row) {
  return Hasher('E')
      .Add(key)
      .Add(row.number)
      .Add(format)
      .Add(row.time_ns)
      .Add(row.payload)
      .Digest();
}

std::int64_t ChecksumOfChecksHead(std::int64_t format, VehicleKey key,
                                  const ChecksHead& row) {
  return Hasher('H')
      .Add(key)
      .Add(format)
      .Add(static_cast<std::uint64_t>(row.stores))
      .Add(row.checked_sequence)
      .Add(row.last_event)
      .Digest();
}

std::int64_t ChecksumOfGroup(std::int64_t format, const GroupRecord& row) {
  return Hasher('G')
      .Add(row.id)
      .Add(format)
      .Add(row.version.uid)
      .Add(row.payload)
      .Digest();
}

std::int64_t ChecksumOfMember(std::int64_t format, const std::string& group_id,
                              const GroupMemberRecord& row) {
  return Hasher('M')
      .Add(group_id)
      .Add(row.vehicle)
      .Add(format)
      .Add(row.payload)
      .Digest();
}

std::int64_t ChecksumOfLink(std::int64_t format, const std::string& group_id,
                            const GroupLinkRecord& row) {
  return Hasher('K')
      .Add(group_id)
      .Add(row.id)
      .Add(format)
      .Add(static_cast<std::int64_t>(row.state))
      .Add(row.query.vehicle)
      .Add(row.query.sequence)
      .Add(row.matched.vehicle)
      .Add(row.matched.sequence)
      .Add(row.payload)
      .Digest();
}

}  // namespace revisit::server
