// The report on a stream of recordings that has ended well.
#ifndef REVISIT_CLIENT_CLI_COMMANDS_STREAM_SUMMARY_H_
#define REVISIT_CLIENT_CLI_COMMANDS_STREAM_SUMMARY_H_

#include <cstddef>
#include <cstdint>
#include <optional>
#include <string>

#include "client/formats/reader.h"
#include "client/formats/sample.h"
#include "client/terminal/terminal.h"

namespace revisit::client {

// How far a drive goes and how long it takes, over recordings of which each
// begins anew.
class DriveExtent {
 public:
  // The samples that follow come from another recording.
  void BeginFile() { previous_.reset(); }
  void Add(const Sample& sample);

  double length_meters() const { return length_meters_; }
  // 0 without times.
  double seconds() const { return seconds_; }
  // The part of it that steps of more than a minute take: nothing was recorded
  // then, as between two days in one file.
  double paused_seconds() const { return paused_seconds_; }
  // Over what is no pause; nothing without times.
  std::optional<double> mean_speed() const;

 private:
  std::optional<Sample> previous_;
  double length_meters_ = 0.0;
  double seconds_ = 0.0;
  double paused_meters_ = 0.0;
  double paused_seconds_ = 0.0;
};

struct StreamSummary {
  std::string vehicle;
  std::string vehicle_uid;
  std::size_t poses = 0;
  // How many of the poses begin a recording.
  int recordings = 0;
  DriveExtent drive;
  LeftOut left_out;
  // The word of --uncertainty for what was claimed.
  std::string uncertainty;
  std::uint64_t already_durable = 0;
  std::uint64_t durable = 0;
  std::uint64_t revision = 0;
  std::int64_t jumps = 0;
  int reconnects = 0;
  double seconds = 0.0;
  // Absent where candidates were not asked for.
  std::optional<std::int64_t> checks;
  // Whether checks looked for passes in the same direction only.
  bool same_direction_only = false;
};

// "12 positions at which the vehicle stood, 1 sentence with a wrong checksum";
// empty if nothing was left out.
std::string Describe(const LeftOut& left_out);

void Print(const StreamSummary& summary, const Terminal& terminal);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_COMMANDS_STREAM_SUMMARY_H_
