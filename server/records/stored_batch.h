// Parses and writes revisit.stored.PoseBatch, for the files of this folder.
#ifndef REVISIT_SERVER_RECORDS_STORED_BATCH_H_
#define REVISIT_SERVER_RECORDS_STORED_BATCH_H_

#include <cstddef>
#include <cstdint>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/records/stored_records.pb.h"

namespace revisit::server {

// Tag of the length-delimited field `repeated Pose poses = 1` of PoseBatch.
inline constexpr std::uint32_t kPosesTag = (1 << 3) | 2;

// The bytes that a pose of this size takes in a batch.
std::size_t BytesInBatch(std::size_t size);

// Writes what comes before the bytes of a pose; returns where these begin.
std::uint8_t* BeginPose(std::size_t size, std::uint8_t* next);

// DATA_LOSS: the payload is not that of a batch.
absl::Status NotABatch();
absl::StatusOr<stored::PoseBatch> ParseBatch(const std::string& payload);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_RECORDS_STORED_BATCH_H_
