#include "client/cli/commands/member_commands.h"

#include <memory>

#include "absl/strings/str_cat.h"
#include "client/answers/names.h"
#include "client/answers/pages.h"
#include "client/cli/commands/printed_change.h"
#include "client/cli/commands/shared_flags.h"
#include "client/cli/commands/verified_measurement.h"

namespace revisit::client {
namespace {

constexpr char kDatumHelp[] =
    "A datum says where the frame of the vehicle's first recording lies in the "
    "one that the\ndatums of a group share, and how sure that is at its first "
    "pose. Vehicles whose positions\nare geodetic take none.";

std::string MemberName(const MemberReference& member) {
  return absl::StrCat(GroupName(member.group), "/members/",
                      IdOf(VehicleName(member.vehicle)));
}

void Fill(const GivenDatum& given, v1::GroupMember* member) {
  if (given.pose.empty()) return;
  v1::Datum* const datum = member->mutable_datum();
  datum->set_datum_id(given.id);
  FillPose(given.pose, datum->mutable_pose());
  *datum->mutable_covariance() = CovarianceOf(
      *given.size, given.pose.size() == 4 ? v1::STATE_SPACE_SPATIAL
                                          : v1::STATE_SPACE_PLANAR);
}

void AddReference(const Command& command, MemberReference* member) {
  AddGroupName(command, &member->group);
  command.AddText("VEHICLE", "TEXT", &member->vehicle, "Id, or name")
      .Required();
}

void AddDatum(const Command& command, GivenDatum* datum) {
  const Flag pose = command.AddNumbers(
      "--datum", "X,Y[,Z],HEADING", &datum->pose,
      "Where the frame's origin lies in the shared one, in metres, and how its "
      "x axis is turned, in radians counter-clockwise; with Z for a spatial "
      "vehicle");
  const Flag size = command.AddText(
      "--datum-sigma", kSizeWords,
      [datum](const std::string& text) {
        RecordingChoice::Size read;
        std::string allowed = ReadSize(text, &read);
        if (allowed.empty()) datum->size = read;
        return allowed;
      },
      "Standard deviations of the datum, of each coordinate and of the "
      "heading");
  const Flag id = command.AddText(
      "--datum-id", "TEXT", &datum->id,
      "Name of the datum: vehicles with the same one have its error in common");
  pose.Needs(size);
  size.Needs(pose);
  id.Needs(pose);
}

void AddAddMember(const Command& group) {
  const Command command = group.AddCommand(
      {"add",
       "Adds a vehicle to a group. Again with the same datum: the "
       "existing member.",
       kDatumHelp,
       "  revisit group add depot shuttle-7\n"
       "  revisit group add depot shuttle-8 --datum 12.5,-3,1.57 "
       "--datum-sigma 5m,2deg\n"
       "  revisit vehicle list -o name | xargs -n 1 revisit group add depot"});
  const auto member = std::make_shared<MemberReference>();
  const auto datum = std::make_shared<GivenDatum>();
  AddReference(command, member.get());
  AddDatum(command, datum.get());
  command.AlsoPrints({OutputFormat::kName});
  command.Runs(
      [=](const Connection& server, const Terminal& terminal) {
        return RunMemberAdd(server.client, *member, *datum, terminal);
      },
      [datum] { return CheckDatum(*datum); });
}

void AddSetDatum(const Command& group) {
  const Command command = group.AddCommand(
      {"set-datum", "Replaces the datum of a member, or removes it.",
       kDatumHelp,
       "  revisit group set-datum depot shuttle-8 --datum 12.5,-3,1.57 "
       "--datum-sigma 1m,1deg\n"
       "  revisit group set-datum depot shuttle-8 --none"});
  const auto member = std::make_shared<MemberReference>();
  const auto datum = std::make_shared<GivenDatum>();
  const auto none = std::make_shared<bool>(false);
  const auto revision = std::make_shared<std::uint64_t>(0);
  AddReference(command, member.get());
  AddDatum(command, datum.get());
  command.AddSwitch("--none", none.get(), "Remove the datum");
  AddExpectedRevision(command, revision.get());
  const Check check = [datum, none]() -> std::string {
    if (*none == !datum->pose.empty()) {
      return "One of --datum and --none is required";
    }
    return CheckDatum(*datum);
  };
  const Run run = [=](const Connection& server, const Terminal& terminal) {
    return RunMemberSetDatum(server.client, *member, *datum, *revision,
                             terminal);
  };
  command.AlsoPrints({OutputFormat::kName});
  command.Runs(run, check);
}

void AddRemoveMember(const Command& group) {
  const Command command = group.AddCommand(
      {"remove",
       "Removes a vehicle from a group, with its loop closures to the others.",
       "The vehicle stays. One that is deleted leaves all groups by itself.",
       "  revisit group remove depot shuttle-8"});
  const auto member = std::make_shared<MemberReference>();
  AddReference(command, member.get());
  command.AlsoPrints({OutputFormat::kName});
  command.Runs([member](const Connection& server, const Terminal& terminal) {
    return RunMemberRemove(server.client, *member, terminal);
  });
}

void AddListMembers(const Command& group) {
  const Command command = group.AddCommand(
      {"members", "Lists the vehicles of a group, with their datums.", "",
       "  revisit group members depot\n"
       "  revisit group members depot -o name"});
  const auto name = std::make_shared<std::string>();
  AddGroupName(command, name.get());
  command.AlsoPrints({OutputFormat::kName});
  command.Runs([name](const Connection& server, const Terminal& terminal) {
    return RunMembers(server.client, *name, terminal);
  });
}

void PrintTable(const v1::ListGroupMembersResponse& all,
                const Terminal& terminal) {
  using Align = Table::Align;
  Table table({{"VEHICLE", Align::kLeft},
               {"DATUM", Align::kLeft},
               {"X m", Align::kRight},
               {"Y m", Align::kRight},
               {"Z m", Align::kRight},
               {"YAW rad", Align::kRight}});
  for (const v1::GroupMember& member : all.members()) {
    std::vector<std::string> row = {member.vehicle(), "-", "-", "-", "-", "-"};
    if (member.has_datum()) {
      const v1::StatePose& pose = member.datum().pose();
      row = {member.vehicle(),          DatumText(member.datum()),
             Fixed(pose.x_meters(), 2), Fixed(pose.y_meters(), 2),
             Fixed(pose.z_meters(), 2), Fixed(pose.heading_radians(), 4)};
    }
    table.AddRow(std::move(row));
  }
  table.Print(terminal.out, terminal.width);
}

}  // namespace

void AddMemberCommands(const Command& group) {
  AddAddMember(group);
  AddSetDatum(group);
  AddRemoveMember(group);
  AddListMembers(group);
}

std::string CheckDatum(const GivenDatum& datum) {
  const std::size_t numbers = datum.pose.size();
  return numbers == 0 || numbers == 3 || numbers == 4
             ? ""
             : absl::StrCat(
                   "--datum: expected X,Y,HEADING or X,Y,Z,HEADING, got ",
                   numbers, numbers == 1 ? " number" : " numbers");
}

absl::Status RunMemberAdd(const Client& client, const MemberReference& member,
                          const GivenDatum& datum, const Terminal& terminal) {
  v1::AddGroupMemberRequest request;
  request.set_parent(GroupName(member.group));
  request.mutable_member()->set_vehicle(VehicleName(member.vehicle));
  Fill(datum, request.mutable_member());
  const auto response = client.AddGroupMember(request);
  if (!response.ok()) return response.status();
  PrintChange("added", response->member().name(), *response, terminal);
  return absl::OkStatus();
}

absl::Status RunMemberSetDatum(const Client& client,
                               const MemberReference& member,
                               const GivenDatum& datum,
                               std::uint64_t expected_revision,
                               const Terminal& terminal) {
  v1::UpdateGroupMemberRequest request;
  request.mutable_member()->set_name(MemberName(member));
  Fill(datum, request.mutable_member());
  request.set_expected_revision(expected_revision);
  const auto response = client.UpdateGroupMember(request);
  if (!response.ok()) return response.status();
  PrintChange("updated", response->member().name(), *response, terminal);
  return absl::OkStatus();
}

absl::Status RunMemberRemove(const Client& client,
                             const MemberReference& member,
                             const Terminal& terminal) {
  v1::RemoveGroupMemberRequest request;
  request.set_name(MemberName(member));
  const auto response = client.RemoveGroupMember(request);
  if (!response.ok()) return response.status();
  PrintRemoval("removed", request.name(), *response, terminal);
  return absl::OkStatus();
}

absl::Status RunMembers(const Client& client, const std::string& group,
                        const Terminal& terminal) {
  v1::ListGroupMembersRequest request;
  request.set_parent(GroupName(group));
  request.set_page_size(1000);
  v1::ListGroupMembersResponse all;
  const absl::Status listed = VisitPages(
      request,
      [&](const v1::ListGroupMembersRequest& asked) {
        return client.ListGroupMembers(asked);
      },
      [](const v1::ListGroupMembersResponse& page) -> const auto& {
        return page.members();
      },
      [&](const v1::ListGroupMembersResponse& page) -> absl::StatusOr<bool> {
        all.mutable_members()->MergeFrom(page.members());
        return true;
      });
  if (!listed.ok() && !absl::IsDataLoss(listed)) return listed;
  if (terminal.json()) {
    terminal.out << ToJson(all, true) << '\n';
  } else if (terminal.names()) {
    PrintNames(all.members(), terminal);
  } else {
    PrintTable(all, terminal);
  }
  return listed;
}

}  // namespace revisit::client
