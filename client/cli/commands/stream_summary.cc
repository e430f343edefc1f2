#include "client/cli/commands/stream_summary.h"

#include <cmath>
#include <optional>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "nlohmann/json.hpp"

namespace revisit::client {
namespace {

constexpr double kPauseSeconds = 60.0;

void PrintJson(const StreamSummary& summary, std::ostream& out) {
  nlohmann::ordered_json json;
  json["vehicle"] = summary.vehicle;
  json["vehicleUid"] = summary.vehicle_uid;
  json["poses"] = summary.poses;
  json["recordings"] = summary.recordings;
  json["lengthMeters"] = summary.drive.length_meters();
  json["durationSeconds"] = summary.drive.seconds();
  json["pausedSeconds"] = summary.drive.paused_seconds();
  json["leftOut"] = {{"standing", summary.left_out.standing},
                     {"wrongChecksums", summary.left_out.wrong_checksums}};
  json["uncertainty"] = summary.uncertainty;
  json["alreadyDurable"] = summary.already_durable;
  json["durableSequence"] = summary.durable;
  json["revision"] = summary.revision;
  json["jumps"] = summary.jumps;
  json["reconnects"] = summary.reconnects;
  json["seconds"] = summary.seconds;
  if (summary.checks.has_value()) json["checks"] = *summary.checks;
  out << JsonText(json, false) << '\n';
}

std::string DriveText(const DriveExtent& drive) {
  const double length = drive.length_meters();
  std::string text = absl::StrCat(Fixed(length, 1), " m");
  if (drive.seconds() > 0.0) {
    absl::StrAppend(&text, " in ", Fixed(drive.seconds(), 1), " s");
  }
  if (const std::optional<double> speed = drive.mean_speed()) {
    absl::StrAppend(&text, ", ", Fixed(*speed, 2), " m/s on average");
  }
  if (drive.paused_seconds() > 0.0) {
    absl::StrAppend(&text, " without pauses of ",
                    Fixed(drive.paused_seconds(), 1), " s");
  }
  return text;
}

void PrintText(const StreamSummary& summary, std::ostream& out) {
  const std::uint64_t sent = summary.durable - summary.already_durable;
  const double rate =
      summary.seconds > 0.0 ? static_cast<double>(sent) / summary.seconds : 0.0;
  std::vector<std::pair<std::string, std::string>> fields = {
      {"vehicle", summary.vehicle},
      {"vehicle uid", summary.vehicle_uid},
      {"drive", DriveText(summary.drive)}};
  if (const std::string left_out = Describe(summary.left_out);
      !left_out.empty()) {
    fields.emplace_back("left out", left_out);
  }
  if (summary.recordings > 0) {
    fields.emplace_back("recordings begun", absl::StrCat(summary.recordings));
  }
  fields.insert(
      fields.end(),
      {{"uncertainty", summary.uncertainty},
       {"already durable", absl::StrCat(summary.already_durable)},
       {"streamed", absl::StrCat(sent, " poses in ", Fixed(summary.seconds, 2),
                                 " s, ", Fixed(rate, 0), "/s")},
       {"durable sequence", absl::StrCat(summary.durable)},
       {"revision", absl::StrCat(summary.revision)},
       {"jumps", absl::StrCat(summary.jumps)},
       {"reconnects", absl::StrCat(summary.reconnects)}});
  if (summary.checks.has_value()) {
    fields.emplace_back(
        "checks",
        absl::StrCat(*summary.checks,
                     summary.same_direction_only
                         ? ", of places passed in the same direction; "
                           "--direction either looks at both"
                         : ""));
  }
  PrintFields(fields, out);
}

}  // namespace

void DriveExtent::Add(const Sample& sample) {
  if (previous_.has_value()) {
    const double meters = std::hypot(sample.estimate.x - previous_->estimate.x,
                                     sample.estimate.y - previous_->estimate.y);
    length_meters_ += meters;
    if (sample.time_nanoseconds.has_value() &&
        previous_->time_nanoseconds.has_value()) {
      const double seconds = SecondsOf(sample) - SecondsOf(*previous_);
      seconds_ += seconds;
      if (seconds > kPauseSeconds) {
        paused_meters_ += meters;
        paused_seconds_ += seconds;
      }
    }
  }
  previous_ = sample;
}

std::optional<double> DriveExtent::mean_speed() const {
  const double seconds = seconds_ - paused_seconds_;
  if (seconds <= 0.0) return std::nullopt;
  return (length_meters_ - paused_meters_) / seconds;
}

std::string Describe(const LeftOut& left_out) {
  std::string text;
  if (left_out.standing > 0) {
    text = absl::StrCat(left_out.standing,
                        left_out.standing == 1 ? " position" : " positions",
                        " at which the vehicle stood");
  }
  if (left_out.wrong_checksums > 0) {
    absl::StrAppend(&text, text.empty() ? "" : ", ", left_out.wrong_checksums,
                    left_out.wrong_checksums == 1 ? " sentence" : " sentences",
                    " with a wrong checksum");
  }
  return text;
}

void Print(const StreamSummary& summary, const Terminal& terminal) {
  if (terminal.json()) {
    PrintJson(summary, terminal.out);
  } else {
    PrintText(summary, terminal.out);
  }
}

}  // namespace revisit::client
