#include "client/cli/commands/verified_measurement.h"

#include <cstddef>

#include "absl/strings/str_cat.h"

namespace revisit::client {

void AddMeasurement(const Command& command, const std::string& relative_help,
                    VerifiedMeasurement* measured) {
  const Flag relative = command.AddNumbers(
      "--relative", "X,Y[,Z],HEADING", &measured->relative,
      absl::StrCat(relative_help,
                   ": metres ahead, to the left (and up), and radians "
                   "counter-clockwise"));
  const Flag covariance = command.AddNumbers(
      "--covariance", "NUMBERS", &measured->covariance,
      "Covariance of its errors, in the same axes: the upper triangle by rows "
      "over x, y, "
      "heading (6) or x, y, z, heading (10), or the 36 of ROS");
  relative.Needs(covariance);
  covariance.Needs(relative);
  command.AddText("--note", "TEXT", &measured->note,
                  "For people: what found it, for example");
  command.AddNumber(
      "--score", "NUMBER",
      [measured](double score) { measured->score = score; },
      "How sure the verifier is, on a scale of its own");
}

std::string CheckMeasurement(const VerifiedMeasurement& measurement) {
  const std::size_t numbers = measurement.relative.size();
  const std::size_t variances = measurement.covariance.size();
  if (numbers == 0 && variances == 0) return "";
  if (numbers != 3 && numbers != 4) {
    return absl::StrCat(
        "--relative: expected X,Y,HEADING or X,Y,Z,HEADING, "
        "got ",
        numbers, " numbers");
  }
  if (variances != 6 && variances != 10 && variances != 36) {
    return absl::StrCat("--covariance: expected 6, 10 or 36 numbers, got ",
                        variances);
  }
  return "";
}

v1::Covariance MakeCovariance(const std::vector<double>& numbers) {
  v1::Covariance covariance;
  const std::size_t count = numbers.size();
  covariance.set_form(count == 6    ? v1::COVARIANCE_FORM_PLANAR_6
                      : count == 10 ? v1::COVARIANCE_FORM_SPATIAL_10
                                    : v1::COVARIANCE_FORM_ROS_36);
  covariance.mutable_values()->Assign(numbers.begin(), numbers.end());
  return covariance;
}

}  // namespace revisit::client
