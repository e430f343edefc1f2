#include "tests/server/plain_codec.h"

#include <cmath>
#include <cstdlib>
#include <functional>
#include <memory>
#include <sstream>

#include "core/drive/confirmed_loop.h"
#include "core/drive/dropped_stretch.h"
#include "core/geometry/pose.h"
#include "core/geometry/recording_start.h"

namespace revisit::server {
namespace {

constexpr std::int64_t kSecond = 1'000'000'000;
constexpr char kRecording[] = "recording ";
constexpr char kColumns[] = "columns";

absl::Status Damaged() { return absl::DataLossError("not a plain record"); }

std::string Line(std::uint64_t sequence, double x, double y, double heading,
                 std::optional<std::int64_t> seconds = std::nullopt) {
  std::ostringstream line;
  line << sequence << std::hexfloat << " " << x << " " << y << " " << heading;
  if (seconds) line << " " << *seconds;
  line << "\n";
  return line.str();
}

// Streams do not read back the hexadecimal form.
bool ReadDouble(std::istream& stream, double* value) {
  std::string text;
  if (!(stream >> text)) return false;
  char* end = nullptr;
  *value = std::strtod(text.c_str(), &end);
  return *end == '\0';
}

std::vector<std::string> Lines(const std::string& payload) {
  std::vector<std::string> lines;
  std::istringstream stream(payload);
  for (std::string line; std::getline(stream, line);) {
    if (line != kColumns) lines.push_back(line);
  }
  return lines;
}

}  // namespace

std::string PlainCodec::EncodeVehicle(const VehicleConfig& config) const {
  std::ostringstream line;
  if (!config.check_group.empty()) line << "in " << config.check_group << " ";
  if (config.checks == ChecksKept::kStored) {
    line << "stores " << std::hexfloat << config.keep_probability << " ";
  }
  line << "vehicle " << std::hexfloat << config.drive.node_spacing_meters << " "
       << config.drive.check_interval_meters << " "
       << config.drive.max_step_meters << " "
       << config.drive.search.sequence_length_meters << " " << std::dec
       << config.drive.search.max_candidates << " "
       << config.drive.retention.max_passes << " "
       << config.drive.retention.max_age_ns.value_or(0) << " "
       << (config.frame == CoordinateFrame::kGeodetic) << " "
       << config.data_loss << " " << config.damaged << " "
       << config.origin.has_value();
  if (config.origin) {
    line << " " << std::hexfloat << config.origin->latitude_degrees << " "
         << config.origin->longitude_degrees;
  }
  if (!config.uid.empty()) line << " " << config.uid;
  return line.str();
}

absl::StatusOr<VehicleConfig> PlainCodec::DecodeVehicle(
    const VehicleRecord& record) const {
  std::istringstream stream(record.payload);
  std::string word;
  VehicleConfig config;
  std::int64_t max_age_ns = 0;
  bool is_geodetic = false;
  bool has_origin = false;
  if (!(stream >> word)) return Damaged();
  if (word == "in" && !(stream >> config.check_group >> word)) return Damaged();
  if (word == "stores") {
    config.checks = ChecksKept::kStored;
    if (!ReadDouble(stream, &config.keep_probability) || !(stream >> word)) {
      return Damaged();
    }
  }
  if (word != "vehicle" ||
      !ReadDouble(stream, &config.drive.node_spacing_meters) ||
      !ReadDouble(stream, &config.drive.check_interval_meters) ||
      !ReadDouble(stream, &config.drive.max_step_meters) ||
      !ReadDouble(stream, &config.drive.search.sequence_length_meters) ||
      !(stream >> config.drive.search.max_candidates >>
        config.drive.retention.max_passes >> max_age_ns >> is_geodetic >>
        config.data_loss >> config.damaged >> has_origin)) {
    return Damaged();
  }
  if (max_age_ns > 0) config.drive.retention.max_age_ns = max_age_ns;
  config.frame =
      is_geodetic ? CoordinateFrame::kGeodetic : CoordinateFrame::kLocal;
  if (has_origin) {
    config.origin.emplace();
    if (!ReadDouble(stream, &config.origin->latitude_degrees) ||
        !ReadDouble(stream, &config.origin->longitude_degrees)) {
      return Damaged();
    }
  }
  stream >> config.uid;
  return config;
}

absl::StatusOr<DecodedBatch> PlainCodec::DecodeBatch(
    const std::string& payload, const VehicleConfig& config) const {
  DecodedBatch batch;
  batch.payload = payload;
  if (config.frame == CoordinateFrame::kGeodetic) batch.origin = config.origin;
  if (payload.rfind("dropped ", 0) == 0) {
    std::istringstream stream(payload);
    std::string word;
    core::DroppedStretch& dropped = batch.dropped.emplace();
    if (!(stream >> word >> dropped.first_sequence >> dropped.last_sequence) ||
        !ReadDouble(stream, &dropped.travelled_meters)) {
      return Damaged();
    }
    return batch;
  }
  for (const std::string& line : Lines(payload)) {
    core::PoseSample sample;
    const bool begins = line.rfind(kRecording, 0) == 0;
    if (begins) {
      core::RecordingStart start;
      start.relation = core::RecordingRelation::kUnknown;
      sample.recording_start = std::make_shared<core::RecordingStart>(start);
    }
    std::istringstream stream(
        line.substr(begins ? std::string(kRecording).size() : 0));
    if (!(stream >> sample.sequence) || !ReadDouble(stream, &sample.pose.x) ||
        !ReadDouble(stream, &sample.pose.y) ||
        !ReadDouble(stream, &sample.pose.heading)) {
      return Damaged();
    }
    if (config.frame == CoordinateFrame::kGeodetic) {
      if (!batch.origin) {
        batch.origin.emplace();
        batch.origin->latitude_degrees = sample.pose.y;
        batch.origin->longitude_degrees = sample.pose.x;
      }
      sample.pose.x -= batch.origin->longitude_degrees;
      sample.pose.y -= batch.origin->latitude_degrees;
    }
    std::int64_t seconds = 0;
    if (!(stream >> seconds)) {
      seconds = static_cast<std::int64_t>(sample.sequence);
    }
    sample.stamp_ns = seconds * kSecond;
    // Grows as dead reckoning's does.
    const double variance = 1e-4 * static_cast<double>(sample.sequence);
    sample.covariance(0, 0) = variance;
    sample.covariance(1, 1) = variance;
    sample.covariance(2, 2) = variance;
    sample.covariance(3, 3) = 0.01 * variance;
    batch.samples.push_back(sample);
  }
  return batch;
}

absl::StatusOr<DecodedPoses> PlainCodec::DecodePoses(
    const std::string& payload, const VehicleConfig& config) const {
  absl::StatusOr<DecodedBatch> batch = DecodeBatch(payload, config);
  if (!batch.ok()) return batch.status();
  return DecodedPoses(*std::move(batch));
}

absl::StatusOr<std::vector<std::uint64_t>> PlainCodec::Fingerprints(
    const std::string& payload) const {
  std::vector<std::uint64_t> fingerprints;
  if (payload.rfind("dropped ", 0) == 0) return fingerprints;
  for (const std::string& line : Lines(payload)) {
    fingerprints.push_back(std::hash<std::string>()(line));
  }
  return fingerprints;
}

absl::StatusOr<std::string> PlainCodec::AsMessages(std::string payload) const {
  const std::string columns = std::string(kColumns) + "\n";
  return payload.rfind(columns, 0) == 0 ? payload.substr(columns.size())
                                        : payload;
}

std::string PlainCodec::EncodeDropped(
    const core::DroppedStretch& stretch) const {
  std::ostringstream line;
  line << "dropped " << stretch.first_sequence << " " << stretch.last_sequence
       << " " << std::hexfloat << stretch.travelled_meters << "\n";
  return line.str();
}

absl::StatusOr<std::optional<core::LoopMeasurement>>
PlainCodec::DecodeMeasurement(const std::string& payload,
                              core::StateSpace /*space*/) const {
  std::istringstream stream(payload);
  core::LoopMeasurement measurement;
  double deviation = 0.0;
  if (!ReadDouble(stream, &measurement.relative.x) ||
      !ReadDouble(stream, &measurement.relative.y) ||
      !ReadDouble(stream, &measurement.relative.heading) ||
      !ReadDouble(stream, &deviation)) {
    return Damaged();
  }
  for (int i = 0; i < 4; ++i) {
    measurement.covariance(i, i) = deviation * deviation;
  }
  return std::optional<core::LoopMeasurement>(measurement);
}

bool PlainCodec::SayTheSame(const std::string& payload,
                            const std::string& other) const {
  return payload.substr(0, payload.find(" by ")) ==
         other.substr(0, other.find(" by "));
}

std::string PlainCodec::WithDeleter(const std::string& payload,
                                    const std::string& deleted_by) const {
  return payload + " undone by " + deleted_by;
}

absl::StatusOr<std::string> PlainCodec::SliceBatch(const std::string& payload,
                                                   std::size_t first,
                                                   std::size_t count) const {
  const std::vector<std::string> lines = Lines(payload);
  if (first + count > lines.size()) return Damaged();
  std::string slice;
  for (std::size_t i = first; i < first + count; ++i) slice += lines[i] + "\n";
  return slice;
}

std::vector<BatchPart> PlainCodec::DivideBatch(std::string payload,
                                               std::size_t count,
                                               std::size_t most_bytes) const {
  if (payload.size() <= most_bytes) return {{count, std::move(payload)}};
  std::vector<BatchPart> parts;
  for (const std::string& line : Lines(payload)) {
    if (parts.empty() ||
        parts.back().payload.size() + line.size() + 1 > most_bytes) {
      parts.emplace_back();
    }
    parts.back().payload += line + "\n";
    ++parts.back().count;
  }
  return parts;
}

std::string PlainBatch(std::uint64_t first_sequence,
                       const std::vector<double>& xs) {
  std::string batch;
  for (const double x : xs) batch += Line(first_sequence++, x, 0.0, 0.0);
  return batch;
}

std::string StraightBatch(std::uint64_t first_sequence, std::uint64_t count) {
  std::string batch;
  for (std::uint64_t i = first_sequence; i < first_sequence + count; ++i) {
    batch += Line(i, static_cast<double>(i), 0.0, 0.0);
  }
  return batch;
}

std::string RecordingBatch(std::uint64_t first_sequence, std::uint64_t count) {
  return kRecording + StraightBatch(first_sequence, count);
}

std::string SquareBatch(std::uint64_t first_sequence, std::uint64_t count) {
  return SquareBatch(first_sequence, count, nullptr);
}

std::string SquareBatch(
    std::uint64_t first_sequence, std::uint64_t count,
    const std::function<std::int64_t(std::uint64_t)>& stamp) {
  constexpr double kQuarterTurn = 1.5707963267948966;
  std::string batch;
  for (std::uint64_t i = first_sequence; i < first_sequence + count; ++i) {
    const std::uint64_t side = (i - 1) / 20 % 4;
    const double along = static_cast<double>((i - 1) % 20);
    const double heading = kQuarterTurn * static_cast<double>(side);
    const double corners[4][2] = {{0, 0}, {20, 0}, {20, 20}, {0, 20}};
    batch += Line(i, corners[side][0] + along * std::cos(heading),
                  corners[side][1] + along * std::sin(heading), heading,
                  stamp ? std::make_optional(stamp(i)) : std::nullopt);
  }
  return batch;
}

}  // namespace revisit::server
