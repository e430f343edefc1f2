#include "client/cli/commands/group_command.h"

#include <memory>
#include <utility>

#include "absl/strings/str_cat.h"
#include "client/answers/exact_text.h"
#include "client/answers/names.h"
#include "client/answers/pages.h"
#include "client/cli/commands/group_frames_command.h"
#include "client/cli/commands/member_commands.h"
#include "client/cli/commands/printed_change.h"
#include "client/cli/commands/shared_flags.h"
#include "client/revisit/printable_text.h"

namespace revisit::client {
namespace {

std::string CreateTime(const v1::Group& group) {
  return group.has_create_time() ? StampText(group.create_time()) : "unknown";
}

std::string BiasText(const v1::GroupSettings& settings) {
  return absl::StrCat(Exact(settings.fix_bias_meters()), " m");
}

void PrintGroup(const v1::Group& group, const Terminal& terminal) {
  std::vector<std::pair<std::string, std::string>> fields = {
      {"name", group.name()}};
  if (!group.display_name().empty()) {
    fields.emplace_back("display name", group.display_name());
  }
  fields.emplace_back("uid", group.uid());
  fields.emplace_back("created", CreateTime(group));
  fields.emplace_back("revision", absl::StrCat(group.revision()));
  const v1::GroupSettings& settings = group.settings();
  fields.emplace_back("geodetic origin",
                      settings.has_geodetic_origin()
                          ? GeodeticText(settings.geodetic_origin())
                          : "none");
  fields.emplace_back("fix bias", BiasText(settings));
  PrintFields(fields, terminal.out);
}

absl::Status Print(const v1::Group& group, const Terminal& terminal) {
  if (terminal.json()) {
    terminal.out << ToJson(group, true) << '\n';
  } else if (terminal.names()) {
    terminal.out << Printable(group.name()) << '\n';
  } else {
    PrintGroup(group, terminal);
  }
  return absl::OkStatus();
}

void PrintTable(const std::vector<v1::Group>& all, const Terminal& terminal) {
  using Align = Table::Align;
  Table table({{"GROUP", Align::kLeft},
               {"REVISION", Align::kRight},
               {"GEODETIC ORIGIN", Align::kLeft},
               {"FIX BIAS", Align::kRight},
               {"CREATED", Align::kLeft},
               {"DISPLAY NAME", Align::kLeft}});
  for (const v1::Group& group : all) {
    table.AddRow({group.name(), absl::StrCat(group.revision()),
                  group.settings().has_geodetic_origin()
                      ? GeodeticText(group.settings().geodetic_origin())
                      : "-",
                  BiasText(group.settings()), CreateTime(group),
                  group.display_name()});
  }
  table.Print(terminal.out, terminal.width);
}

void AddGroupId(const Command& command, std::string* id,
                const std::string& help) {
  command.AddText("ID", "TEXT", id, help).Required();
}

void AddDescription(const Command& command, GroupDescription* description) {
  command.AddText("--display-name", "TEXT", &description->display_name,
                  "Name for people, which need not be unique");
  command.AddNumbers(
      "--geodetic-origin", "LAT,LON,HEIGHT", &description->geodetic_origin,
      "Where the frame that datums share has its origin, in degrees and "
      "metres, with x to the east and y to the north: ties vehicles with fixes "
      "to those with a datum");
  command.AddNumber(
      "--fix-bias", "M",
      [description](double meters) { description->fix_bias_meters = meters; },
      "Standard deviation of the offset that all fixes of one vehicle have in "
      "common (0)");
}

// Writes what is given into the group.
void Describe(const GroupDescription& description, v1::Group* group) {
  if (description.display_name) {
    group->set_display_name(*description.display_name);
  }
  if (const auto& origin = description.geodetic_origin; !origin.empty()) {
    v1::GeodeticPosition* const at =
        group->mutable_settings()->mutable_geodetic_origin();
    at->set_latitude_degrees(origin[0]);
    at->set_longitude_degrees(origin[1]);
    at->set_height_meters(origin[2]);
  }
  if (description.fix_bias_meters) {
    group->mutable_settings()->set_fix_bias_meters(
        *description.fix_bias_meters);
  }
}

void AddCreateGroup(const Command& group) {
  const Command command = group.AddCommand(
      {"create",
       "Creates a group of vehicles. Again with the same settings: the "
       "existing one.",
       "The histories of a group's vehicles are searched together (revisit "
       "find --group). It has no\nmembers at first: revisit group add. Ids as "
       "for vehicles.",
       "  revisit group create depot\n"
       "  revisit group create site --geodetic-origin 48.2637,11.6684,480 "
       "--fix-bias 3"});
  const auto id = std::make_shared<std::string>();
  const auto description = std::make_shared<GroupDescription>();
  AddGroupId(command, id.get(), "Lower-case letters, digits, dashes");
  AddDescription(command, description.get());
  command.AlsoPrints({OutputFormat::kName});
  command.Runs(
      [=](const Connection& server, const Terminal& terminal) {
        return RunGroupCreate(server.client, *id, *description, terminal);
      },
      [description] { return CheckGroup(*description); });
}

void AddGetGroup(const Command& group) {
  const Command command = group.AddCommand(
      {"get", "Shows a group.",
       "Its revision grows with every change of the group, its members and "
       "the loop closures\nbetween them.",
       "  revisit group get depot"});
  const auto id = std::make_shared<std::string>();
  AddGroupId(command, id.get(), "");
  command.AlsoPrints({OutputFormat::kName});
  command.Runs([id](const Connection& server, const Terminal& terminal) {
    return RunGroupGet(server.client, *id, terminal);
  });
}

void AddListGroups(const Command& group) {
  const Command command = group.AddCommand({"list", "Lists all groups.", "",
                                            "  revisit group list\n"
                                            "  revisit group list -o name"});
  command.AlsoPrints({OutputFormat::kName});
  command.Runs([](const Connection& server, const Terminal& terminal) {
    return RunGroupList(server.client, terminal);
  });
}

void AddUpdateGroup(const Command& group) {
  const Command command = group.AddCommand(
      {"update", "Changes what is given, and nothing else.", "",
       "  revisit group update depot --fix-bias 5\n"
       "  revisit group update depot --no-geodetic-origin"});
  const auto id = std::make_shared<std::string>();
  const auto changes = std::make_shared<GroupChanges>();
  AddGroupId(command, id.get(), "");
  AddDescription(command, &changes->to);
  command.AddSwitch("--no-geodetic-origin", &changes->removes_origin,
                    "Leave open where the frame of datums lies on the Earth");
  AddExpectedRevision(command, &changes->expected_revision);
  command.AlsoPrints({OutputFormat::kName});
  command.Runs(
      [=](const Connection& server, const Terminal& terminal) {
        return RunGroupUpdate(server.client, *id, *changes, terminal);
      },
      [changes] { return CheckGroup(*changes); });
}

absl::StatusOr<std::string> ContentOfGroup(const Client& client,
                                           const std::string& name) {
  v1::GetGroupRequest request;
  request.set_name(name);
  const auto found = client.GetGroup(request);
  if (!found.ok()) return found.status();
  return std::string(
      " with the datums of its members, and the loop closures and rejected "
      "candidates between them");
}

absl::Status RemoveGroup(const Client& client, const std::string& name,
                         std::uint64_t expected_revision) {
  v1::DeleteGroupRequest request;
  request.set_name(name);
  request.set_expected_revision(expected_revision);
  return client.DeleteGroup(request).status();
}

constexpr DeletedKind kGroups = {&GroupName, &ContentOfGroup, &RemoveGroup,
                                 true};

}  // namespace

void AddGroupCommand(const Command& program) {
  const Command group = program.AddCommand(
      {"group",
       "Creates, shows, changes and deletes groups of vehicles, and their "
       "members.",
       "", ""});
  AddCreateGroup(group);
  AddGetGroup(group);
  AddListGroups(group);
  AddUpdateGroup(group);
  AddMemberCommands(group);
  AddGroupFramesCommand(group);
  AddDeletion(
      group,
      {"delete",
       "Deletes groups with the loop closures between their members. Cannot "
       "be undone.",
       "The vehicles stay. At a terminal, the id of each group has to be typed "
       "again; elsewhere,\n--yes is required.",
       "  revisit group delete depot --yes\n"
       "  revisit group delete depot --yes --expected-revision 12"},
      kGroups);
}

std::string CheckGroup(const GroupDescription& description) {
  const std::size_t numbers = description.geodetic_origin.size();
  return numbers == 0 || numbers == 3
             ? ""
             : absl::StrCat("--geodetic-origin: expected LAT,LON,HEIGHT, got ",
                            numbers, numbers == 1 ? " number" : " numbers");
}

std::string CheckGroup(const GroupChanges& changes) {
  const GroupDescription& to = changes.to;
  if (changes.removes_origin && !to.geodetic_origin.empty()) {
    return "--no-geodetic-origin goes without --geodetic-origin";
  }
  if (!changes.removes_origin && !to.display_name && !to.fix_bias_meters &&
      to.geodetic_origin.empty()) {
    return "A setting to change is required";
  }
  return CheckGroup(to);
}

absl::Status RunGroupCreate(const Client& client, const std::string& id,
                            const GroupDescription& description,
                            const Terminal& terminal) {
  v1::CreateGroupRequest request;
  request.set_group_id(id);
  Describe(description, request.mutable_group());
  const auto response = client.CreateGroup(request);
  if (!response.ok()) return response.status();
  return Print(response->group(), terminal);
}

absl::Status RunGroupGet(const Client& client, const std::string& id,
                         const Terminal& terminal) {
  v1::GetGroupRequest request;
  request.set_name(GroupName(id));
  const auto response = client.GetGroup(request);
  if (!response.ok()) return response.status();
  return Print(response->group(), terminal);
}

absl::Status RunGroupUpdate(const Client& client, const std::string& id,
                            const GroupChanges& changes,
                            const Terminal& terminal) {
  const GroupDescription& to = changes.to;
  v1::UpdateGroupRequest request;
  request.mutable_group()->set_name(GroupName(id));
  request.set_expected_revision(changes.expected_revision);
  Describe(to, request.mutable_group());
  google::protobuf::FieldMask* const mask = request.mutable_update_mask();
  if (to.display_name) mask->add_paths("display_name");
  if (to.fix_bias_meters) mask->add_paths("settings.fix_bias_meters");
  if (changes.removes_origin || !to.geodetic_origin.empty()) {
    mask->add_paths("settings.geodetic_origin");
  }
  const auto response = client.UpdateGroup(request);
  if (!response.ok()) return response.status();
  return Print(response->group(), terminal);
}

absl::Status RunGroupList(const Client& client, const Terminal& terminal) {
  v1::ListGroupsRequest request;
  request.set_page_size(1000);
  const auto all = ReadPages(
      request,
      [&](const v1::ListGroupsRequest& asked) {
        return client.ListGroups(asked);
      },
      [](const v1::ListGroupsResponse& page) -> const auto& {
        return page.groups();
      });
  if (!all.ok()) return all.status();
  if (terminal.json()) {
    v1::ListGroupsResponse response;
    response.mutable_groups()->Assign(all->begin(), all->end());
    terminal.out << ToJson(response, true) << '\n';
  } else if (terminal.names()) {
    PrintNames(*all, terminal);
  } else {
    PrintTable(*all, terminal);
  }
  return absl::OkStatus();
}

absl::Status RunGroupDelete(const Client& client,
                            const std::vector<std::string>& ids, const Ask& ask,
                            const Terminal& terminal) {
  return RunDeletion(client, kGroups, ids, ask, terminal);
}

}  // namespace revisit::client
