// The flags by which commands that add loop closures take what a verifier tells
// of two poses that it found to be one place.
#ifndef REVISIT_CLIENT_CLI_COMMANDS_VERIFIED_MEASUREMENT_H_
#define REVISIT_CLIENT_CLI_COMMANDS_VERIFIED_MEASUREMENT_H_

#include <optional>
#include <string>
#include <vector>

#include "client/cli/flags.h"
#include "revisit/v1/geometry.pb.h"
#include "revisit/v1/loop_closure.pb.h"

namespace revisit::client {

// The verifier's measurement; empty where it measured nothing.
struct VerifiedMeasurement {
  // The query pose as seen from the matched one: x, y, heading, or x, y, z,
  // heading, as in v1::LoopClosureMeasurement.
  std::vector<double> relative;
  // 6, 10 or 36 numbers, as the forms of v1::Covariance have.
  std::vector<double> covariance;
  std::string note;
  std::optional<double> score;
};

// Adds --relative, --covariance, --note and --score. `relative_help` says which
// pose is seen from which.
void AddMeasurement(const Command& command, const std::string& relative_help,
                    VerifiedMeasurement* measured);

// Says what is wrong with the measurement's numbers; empty if nothing is.
std::string CheckMeasurement(const VerifiedMeasurement& measurement);

// x, y, heading, or x, y, z, heading, as a pose or a measurement has them.
// REQUIRES: 3 or 4 numbers.
template <typename Pose>
void FillPose(const std::vector<double>& numbers, Pose* pose) {
  pose->set_x_meters(numbers[0]);
  pose->set_y_meters(numbers[1]);
  if (numbers.size() == 4) pose->set_z_meters(numbers[2]);
  pose->set_heading_radians(numbers.back());
}

// Takes 6, 10 or 36 numbers, which say the form.
v1::Covariance MakeCovariance(const std::vector<double>& numbers);

// Writes all of it into a loop closure of one vehicle or between two.
// REQUIRES: CheckMeasurement().
template <typename Closure>
void Fill(const VerifiedMeasurement& measured, Closure* closure) {
  closure->set_note(measured.note);
  if (measured.score) closure->set_score(*measured.score);
  if (measured.relative.empty()) return;
  v1::LoopClosureMeasurement* const measurement =
      closure->mutable_measurement();
  FillPose(measured.relative, measurement);
  *measurement->mutable_covariance() = MakeCovariance(measured.covariance);
}

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_COMMANDS_VERIFIED_MEASUREMENT_H_
