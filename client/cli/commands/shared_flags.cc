#include "client/cli/commands/shared_flags.h"

#include <cmath>
#include <string>
#include <utility>

#include "absl/strings/numbers.h"
#include "absl/strings/str_split.h"
#include "client/answers/names.h"
#include "client/formats/angles.h"
#include "client/revisit/status.h"

namespace revisit::client {

void AddVehicleName(const Command& command, std::string* vehicle) {
  command
      .AddText("VEHICLE,--vehicle", "ID", vehicle,
               "Id, or name such as vehicles/ID")
      .Required();
}

void AddGroupName(const Command& command, std::string* group) {
  command.AddText("GROUP", "ID", group, "Id, or name such as groups/ID")
      .Required();
}

void AddExpectedRevision(const Command& command, std::uint64_t* revision) {
  command.AddWholeNumber(
      "--expected-revision", kSequences, revision,
      "Change nothing if the group has another revision by now");
}

void AddPoseView(const Command& command, v1::PoseView* view) {
  const Words views = {{"current", v1::POSE_VIEW_CURRENT},
                       {"as-sent", v1::POSE_VIEW_AS_SENT}};
  command.AddChoice("--view", views, view,
                    "The poses as they were last revised (current), or as they "
                    "were sent");
}

void AddDirection(const Command& command, v1::CandidateOptions* options) {
  command.AddChoice(
      "--direction", WordsOf(v1::Direction_descriptor()),
      [options](int direction) {
        options->set_direction(static_cast<v1::Direction>(direction));
      },
      "Which way the place was passed before, against the way it is passed now "
      "(same)");
}

Flag AddMembers(const Command& command, const char* help,
                std::function<void(const std::string& vehicle)> add) {
  return command.AddText(
      "--in", "VEHICLE,...",
      [add = std::move(add)](const std::string& ids) -> std::string {
        for (const auto& id : absl::StrSplit(ids, ',')) {
          if (id.empty()) return "ids of members, separated by commas";
          add(VehicleName(std::string(id)));
        }
        return "";
      },
      help);
}

void AddScope(const Command& command, v1::CandidateOptions* options) {
  const Command scope = command.Under("Histories of other vehicles");
  const Flag group = scope.AddText(
      "--group", "GROUP",
      [options](const std::string& id) -> std::string {
        if (id.empty()) return "an id, or a name such as groups/ID";
        options->mutable_scope()->set_group(GroupName(id));
        return "";
      },
      "Look in the histories of this group's vehicles too");
  const Flag in =
      AddMembers(scope, "Of these vehicles, only in those that are named here",
                 [options](const std::string& vehicle) {
                   options->mutable_scope()->add_vehicles(vehicle);
                 });
  const Flag exclude_own = scope.AddSwitch(
      "--exclude-own",
      [options](bool exclude) {
        options->mutable_scope()->set_exclude_own(exclude);
      },
      "Not in the vehicle's own history");
  const Flag partial = scope.AddSwitch(
      "--partial",
      [options](bool allow) {
        options->mutable_scope()->set_allow_partial(allow);
      },
      "Do not wait until the server has read all histories: answer with those "
      "that it has, and name the others");
  for (const Flag& flag : {in, exclude_own, partial}) flag.Needs(group);
}

absl::Status WithPartialHint(const absl::Status& status) {
  if (!ReadsHistories(status)) return status;
  return WithHint(status,
                  "the server goes on reading: ask again, or take what it has "
                  "by now with --partial");
}

void AddCandidateFilter(const Command& command, v1::CandidateFilter* filter) {
  command.AddRepeatedChoice(
      "--state", WordsOf(v1::CandidateState_descriptor()),
      [filter](int state) {
        filter->add_states(static_cast<v1::CandidateState>(state));
      },
      "Candidates in this state; once for each that is wanted, all if left "
      "out");
  AddCandidateThresholds(command, filter);
}

void AddCandidateThresholds(const Command& command,
                            v1::CandidateFilter* filter) {
  command.AddRepeatedChoice(
      "--verdict", WordsOf(v1::Verdict_descriptor()),
      [filter](int verdict) {
        filter->add_verdicts(static_cast<v1::Verdict>(verdict));
      },
      "Candidates of this verdict; once for each that is wanted, all if left "
      "out");
  command.AddNumber(
      "--least-probability", "P",
      [filter](double least) { filter->set_least_probability(least); },
      "Candidates at least so probable");
  command.AddText(
      "--least-value", "M2",
      [filter](const std::string& text) -> std::string {
        double least = 0.0;
        if (!absl::SimpleAtod(text, &least) || !std::isfinite(least) ||
            least < 0.0) {
          return "a finite number that is not negative";
        }
        filter->set_least_value_square_meters(least);
        return "";
      },
      "Candidates of which a look is worth at least so many square metres of "
      "the variance of positions");
}

void AddUncertainty(const Command& command, UncertaintyOptions* options) {
  using Source = UncertaintyOptions::Source;
  const Words sources = {{"model", static_cast<int>(Source::kModel)},
                         {"file", static_cast<int>(Source::kFile)},
                         {"fixes", static_cast<int>(Source::kFixes)}};
  const Command group = command.Under("Claimed uncertainty");
  group.AddChoice(
      "--uncertainty", sources, &options->source,
      "Dead reckoning with the sigmas below (model), the file's covariances "
      "plus the start's uncertainty, carried along (file), or the file's as "
      "they are (fixes, the default for receivers and filters)");
  group.AddNumber(
      "--sigma-along", "M", &options->along,
      "Standard deviation of odometry along the path, per square root of a "
      "metre");
  group.AddNumber(
      "--sigma-across", "M", &options->across,
      "Standard deviation of odometry across the path, per square root of "
      "a metre");
  group.AddNumber(
      "--sigma-up", "M", &options->up,
      "Standard deviation of odometry upwards, per square root of a metre; "
      "for spatial vehicles");
  group.AddNumber(
      "--sigma-heading-degrees", "DEG",
      [options](double degrees) {
        options->heading = degrees * kRadiansPerDegree;
      },
      "Standard deviation of odometry in heading, per square root of a metre "
      "(0.1)");
  group.AddNumber("--fix-sigma", "M", &options->fix_position,
                  "Standard deviation of a receiver's fixes, east and north, "
                  "where the file states none");
  group.AddNumber(
      "--start-sigma-position", "M",
      [options](double meters) {
        options->start_position = meters;
        options->start_is_given = true;
      },
      "Standard deviation of the first position; where it is given, also of "
      "that of each further recording, in the frame of those before (0.1)");
  group.AddNumber(
      "--start-sigma-heading", "RAD",
      [options](double radians) {
        options->start_heading = radians;
        options->start_is_given = true;
      },
      "Standard deviation of the first heading, likewise (0.01)");
}

}  // namespace revisit::client
