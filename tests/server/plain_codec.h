// Records as plain text, so that tests of sessions need no messages.
#ifndef REVISIT_TESTS_SERVER_PLAIN_CODEC_H_
#define REVISIT_TESTS_SERVER_PLAIN_CODEC_H_

#include <cstddef>
#include <cstdint>
#include <functional>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "core/drive/confirmed_loop.h"
#include "core/drive/dropped_stretch.h"
#include "server/sessions/record_codec.h"

namespace revisit::server {

// A vehicle is a line with some of its settings, a batch a line for each pose:
// sequence, x, y, heading, and the stamp in seconds where that is not the
// sequence; behind the word "recording" where it begins one, of which nothing
// is known. A batch of columns begins with the line "columns". Doubles are
// written so that they read back exactly. For a geodetic vehicle x and y count
// from the first pose, whose place is the origin's latitude and longitude.
class PlainCodec : public RecordCodec {
 public:
  std::string EncodeVehicle(const VehicleConfig& config) const override;
  absl::StatusOr<VehicleConfig> DecodeVehicle(
      const VehicleRecord& record) const override;
  // A batch as a caller would send it.
  absl::StatusOr<DecodedBatch> DecodeBatch(const std::string& payload,
                                           const VehicleConfig& config) const;
  absl::StatusOr<DecodedPoses> DecodePoses(
      const std::string& payload, const VehicleConfig& config) const override;
  absl::StatusOr<std::vector<std::uint64_t>> Fingerprints(
      const std::string& payload) const override;
  absl::StatusOr<std::string> AsMessages(std::string payload) const override;
  // A line: "dropped", first and last sequence, metres.
  std::string EncodeDropped(const core::DroppedStretch& stretch) const override;
  // The payload of a measured loop closure is a line: x, y, heading, and their
  // common standard deviation. That of any pair may end with "by" and a name,
  // and "undone by" and a name.
  absl::StatusOr<std::optional<core::LoopMeasurement>> DecodeMeasurement(
      const std::string& payload, core::StateSpace space) const override;
  bool SayTheSame(const std::string& payload,
                  const std::string& other) const override;
  std::string WithDeleter(const std::string& payload,
                          const std::string& deleted_by) const override;
  absl::StatusOr<std::string> SliceBatch(const std::string& payload,
                                         std::size_t first,
                                         std::size_t count) const override;
  std::vector<BatchPart> DivideBatch(std::string payload, std::size_t count,
                                     std::size_t most_bytes) const override;
};

// Poses of one batch, from this sequence on, at these x; y and heading are 0.
std::string PlainBatch(std::uint64_t first_sequence,
                       const std::vector<double>& xs);

// `count` poses 1 m apart, x as the sequence.
std::string StraightBatch(std::uint64_t first_sequence, std::uint64_t count);

// The same, of which the first begins a recording.
std::string RecordingBatch(std::uint64_t first_sequence, std::uint64_t count);

// `count` poses, 1 m apart, around and around a square of 20 m. `stamp`: from
// the sequence of a pose, in seconds.
std::string SquareBatch(std::uint64_t first_sequence, std::uint64_t count);
std::string SquareBatch(
    std::uint64_t first_sequence, std::uint64_t count,
    const std::function<std::int64_t(std::uint64_t)>& stamp);

}  // namespace revisit::server

#endif  // REVISIT_TESTS_SERVER_PLAIN_CODEC_H_
