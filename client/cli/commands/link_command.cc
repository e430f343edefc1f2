#include "client/cli/commands/link_command.h"

#include <memory>
#include <utility>

#include "absl/status/statusor.h"
#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "absl/strings/str_replace.h"
#include "client/answers/exact_text.h"
#include "client/answers/names.h"
#include "client/cli/commands/printed_change.h"
#include "client/cli/commands/shared_flags.h"
#include "client/revisit/printable_text.h"
#include "client/trajectory/stored_groups.h"

namespace revisit::client {
namespace {

using Links = v1::ListInterVehicleLoopClosuresResponse;
using Rejections = v1::ListInterVehicleRejectedCandidatesResponse;

constexpr char kEndWords[] = "VEHICLE@SEQUENCE, such as shuttle-7@2068";

std::string EndText(const v1::MemberPose& pose) {
  return absl::StrCat(IdOf(pose.vehicle()), "@", pose.sequence());
}

void Fill(const LinkEnd& end, v1::MemberPose* pose) {
  pose->set_vehicle(VehicleName(end.vehicle));
  pose->set_sequence(end.sequence);
}

bool IsAt(const LinkEnd& end, const v1::MemberPose& pose) {
  return pose.vehicle() == VehicleName(end.vehicle) &&
         pose.sequence() == end.sequence;
}

const auto& ItemsOf(const Links& all) { return all.loop_closures(); }
const auto& ItemsOf(const Rejections& all) { return all.rejected_candidates(); }

// "1.20 m, -0.40 m, 0.030 rad": x and y, z where it is not 0, and the heading.
std::string MeasurementText(const v1::InterVehicleLoopClosure& link) {
  if (!link.has_measurement()) return "-";
  const v1::LoopClosureMeasurement& measured = link.measurement();
  return absl::StrCat(Fixed(measured.x_meters(), 2), " m, ",
                      Fixed(measured.y_meters(), 2), " m, ",
                      measured.z_meters() == 0.0
                          ? ""
                          : absl::StrCat(Fixed(measured.z_meters(), 2), " m, "),
                      Fixed(measured.heading_radians(), 3), " rad");
}

std::string DeciderOf(const std::string& decided_by) {
  return decided_by.empty() ? "-" : decided_by;
}

std::string InOneLine(const std::string& note) {
  return absl::StrReplaceAll(note, {{"\n", " "}, {"\t", " "}});
}

void PrintTable(const Rejections& all, const Terminal& terminal) {
  using Align = Table::Align;
  Table table({{"ID", Align::kLeft},
               {"QUERY", Align::kLeft},
               {"MATCHED", Align::kLeft},
               {"CREATED", Align::kLeft},
               {"DECIDED_BY", Align::kLeft},
               {"NOTE", Align::kLeft}});
  for (const auto& rejected : all.rejected_candidates()) {
    table.AddRow(
        {IdOf(rejected.name()), EndText(rejected.query()),
         EndText(rejected.matched()), StampText(rejected.create_time()),
         DeciderOf(rejected.decided_by()), InOneLine(rejected.note())});
  }
  table.Print(terminal.out, terminal.width);
}

void PrintTable(const Links& all, const Terminal& terminal) {
  using Align = Table::Align;
  // The note is last, since it is as long as whoever wrote it wanted.
  Table table({{"ID", Align::kLeft},
               {"QUERY", Align::kLeft},
               {"MATCHED", Align::kLeft},
               {"MEASURED", Align::kLeft},
               {"SCORE", Align::kRight},
               {"CREATED", Align::kLeft},
               {"DECIDED_BY", Align::kLeft},
               {"NOTE", Align::kLeft}});
  for (const v1::InterVehicleLoopClosure& link : all.loop_closures()) {
    table.AddRow({IdOf(link.name()), EndText(link.query()),
                  EndText(link.matched()), MeasurementText(link),
                  link.has_score() ? Exact(link.score()) : "-",
                  StampText(link.create_time()), DeciderOf(link.decided_by()),
                  InOneLine(link.note())});
  }
  table.Print(terminal.out, terminal.width);
}

// The words for what a list of this kind holds.
constexpr const char* NounOf(const Links&) { return "loop closure"; }
constexpr const char* NounOf(const Rejections&) { return "rejected candidate"; }
constexpr const char* FlagOf(const Links&) { return ""; }
constexpr const char* FlagOf(const Rejections&) { return " --rejected"; }

// The name of the only one between these poses. `All`: Links or Rejections.
template <typename All>
absl::StatusOr<std::string> NameBetween(const Client& client,
                                        const std::string& group,
                                        const LinkEnd& query,
                                        const LinkEnd& matched) {
  All all;
  const absl::Status listed = ReadPairs(client, GroupName(group), &all);
  if (!listed.ok() && !absl::IsDataLoss(listed)) return listed;
  std::vector<std::string> names;
  for (const auto& pair : ItemsOf(all)) {
    if (IsAt(query, pair.query()) && IsAt(matched, pair.matched())) {
      names.push_back(pair.name());
    }
  }
  if (names.size() == 1) return names.front();
  if (names.empty() && !listed.ok()) return listed;
  if (names.empty()) {
    return WithHint(
        absl::NotFoundError(absl::StrCat(GroupName(group), " has no ",
                                         NounOf(all), " between these poses")),
        absl::StrCat("revisit link list ", group, FlagOf(all),
                     " shows those that it has; the query comes first"));
  }
  return WithHint(absl::FailedPreconditionError(
                      absl::StrCat(GroupName(group), " has ", names.size(), " ",
                                   NounOf(all), "s between these poses")),
                  absl::StrCat("name one by its id: ",
                               Printable(absl::StrJoin(names, ", "))));
}

// The name of what is to be deleted, in `collection`.
template <typename All>
absl::StatusOr<std::string> NameOfReferred(const Client& client,
                                           const LinkReference& link,
                                           const char* collection) {
  const std::string& word = link.words.front();
  if (link.words.size() == 2) {
    LinkEnd query;
    LinkEnd matched;
    ReadLinkEnd(link.words[0], &query);
    ReadLinkEnd(link.words[1], &matched);
    return NameBetween<All>(client, link.group, query, matched);
  }
  if (word.find('/') != std::string::npos) return word;
  return absl::StrCat(GroupName(link.group), "/", collection, "/", word);
}

template <typename All>
absl::Status PrintAll(const Client& client, const std::string& group,
                      const Terminal& terminal) {
  All all;
  const absl::Status listed = ReadPairs(client, GroupName(group), &all);
  if (!listed.ok() && !absl::IsDataLoss(listed)) return listed;
  if (terminal.json()) {
    terminal.out << ToJson(all, true) << '\n';
  } else if (terminal.names()) {
    PrintNames(ItemsOf(all), terminal);
  } else {
    PrintTable(all, terminal);
  }
  return listed;
}

void AddEnd(const Command& command, const std::string& word,
            const std::string& help, LinkEnd* end) {
  command
      .AddText(
          word, "VEHICLE@SEQUENCE",
          [end](const std::string& text) { return ReadLinkEnd(text, end); },
          help)
      .Required();
}

void AddAddLink(const Command& link) {
  const Command command = link.AddCommand(
      {"add",
       "Tells that two poses of two vehicles were found to be one place.",
       "Both are members of the group. It ties the frames of the two "
       "recordings. Again: the\nexisting one. A mistaken one is undone by "
       "revisit link delete. revisit find --group\n-o name prints both words.",
       "  revisit link add depot shuttle-8@310 shuttle-7@1072\n"
       "  revisit link add depot shuttle-8@310 shuttle-7@1072 "
       "--relative 1.2,-0.4,0.03 --covariance 0.04,0,0,0.04,0,0.0004"});
  const auto added = std::make_shared<NewLink>();
  AddGroupName(command, &added->group);
  AddEnd(command, "QUERY", "The pose that asked", &added->query);
  AddEnd(command, "MATCHED", "The pose of the other vehicle", &added->matched);
  AddMeasurement(command, "The query as seen from the matched pose",
                 &added->measured);
  command.AddText("--id", "ID", &added->id,
                  "Last part of its name; made of the two poses if left out");
  command.AlsoPrints({OutputFormat::kName});
  command.Runs(
      [added](const Connection& server, const Terminal& terminal) {
        return RunLinkAdd(server.client, *added, terminal);
      },
      [added] { return CheckMeasurement(added->measured); });
}

void AddRejectLink(const Command& link) {
  const Command command = link.AddCommand(
      {"reject",
       "Tells that two poses of two vehicles were found not to be one place.",
       "Searches in the group do not offer the candidate again. Again: the "
       "existing rejection. A\nmistaken one is undone by revisit link delete "
       "--rejected. revisit find --group -o name\nprints both words.",
       "  revisit link reject depot shuttle-8@310 shuttle-7@1072\n"
       "  revisit link reject depot shuttle-8@310 shuttle-7@1072 "
       "--note \"another hall\""});
  const auto rejected = std::make_shared<NewRejection>();
  AddGroupName(command, &rejected->group);
  AddEnd(command, "QUERY", "The pose that asked", &rejected->query);
  AddEnd(command, "MATCHED", "The pose of the other vehicle",
         &rejected->matched);
  command.AddText("--note", "TEXT", &rejected->note,
                  "For people: why it is not one place, for example");
  command.AddText("--id", "ID", &rejected->id,
                  "Last part of its name; made of the two poses if left out");
  command.AlsoPrints({OutputFormat::kName});
  command.Runs([rejected](const Connection& server, const Terminal& terminal) {
    return RunLinkReject(server.client, *rejected, terminal);
  });
}

void AddListLinks(const Command& link) {
  const Command command = link.AddCommand(
      {"list", "Lists the loop closures between a group's vehicles.", "",
       "  revisit link list depot\n"
       "  revisit link list depot --rejected"});
  const auto group = std::make_shared<std::string>();
  const auto rejected = std::make_shared<bool>(false);
  AddGroupName(command, group.get());
  command.AddSwitch("--rejected", rejected.get(),
                    "The rejected candidates instead");
  command.AlsoPrints({OutputFormat::kName});
  command.Runs(
      [group, rejected](const Connection& server, const Terminal& terminal) {
        return *rejected ? RunLinkRejections(server.client, *group, terminal)
                         : RunLinkList(server.client, *group, terminal);
      });
}

void AddDeleteLink(const Command& link) {
  const Command command = link.AddCommand(
      {"delete", "Deletes a loop closure: undoes a mistaken link add.", "",
       "  revisit link delete depot shuttle-8@310 shuttle-7@1072\n"
       "  revisit link delete depot shuttle-8@310 shuttle-7@1072 "
       "--rejected"});
  const auto deleted = std::make_shared<LinkReference>();
  AddGroupName(command, &deleted->group);
  command
      .AddTexts("WHICH", "TEXT", &deleted->words,
                "QUERY and MATCHED, as they were added; or its id")
      .Required();
  command.AddSwitch("--rejected", &deleted->is_rejected,
                    "A rejected candidate: undoes a mistaken link reject");
  command.AlsoPrints({OutputFormat::kName});
  command.Runs(
      [deleted](const Connection& server, const Terminal& terminal) {
        return RunLinkDelete(server.client, *deleted, terminal);
      },
      [deleted] { return CheckLink(*deleted); });
}

}  // namespace

void AddLinkCommand(const Command& program) {
  const Command link = program.AddCommand(
      {"link",
       "Adds, lists and deletes loop closures between vehicles of a group.", "",
       ""});
  AddAddLink(link);
  AddRejectLink(link);
  AddListLinks(link);
  AddDeleteLink(link);
}

std::string ReadLinkEnd(const std::string& text, LinkEnd* end) {
  const std::size_t at = text.rfind('@');
  std::int64_t sequence = 0;
  if (at == text.npos || at == 0 ||
      text.find_first_not_of("0123456789", at + 1) != text.npos ||
      !absl::SimpleAtoi(text.substr(at + 1), &sequence) ||
      sequence < kSequences.lowest) {
    return kEndWords;
  }
  *end = {text.substr(0, at), static_cast<std::uint64_t>(sequence)};
  return "";
}

std::string CheckLink(const LinkReference& link) {
  const std::vector<std::string>& words = link.words;
  LinkEnd end;
  if (words.size() == 1) {
    // A name says which group it belongs to.
    const bool other = words[0].find('/') != std::string::npos &&
                       words[0].rfind(GroupName(link.group) + "/", 0) != 0;
    return other ? absl::StrCat("got \"", words[0],
                                "\", which does not belong to ",
                                GroupName(link.group))
                 : "";
  }
  if (words.size() == 2 && ReadLinkEnd(words[0], &end).empty() &&
      ReadLinkEnd(words[1], &end).empty()) {
    return "";
  }
  return absl::StrCat("got \"", absl::StrJoin(words, " "),
                      "\"; allowed is an id, or two of ", kEndWords);
}

absl::Status RunLinkAdd(const Client& client, const NewLink& link,
                        const Terminal& terminal) {
  v1::AddInterVehicleLoopClosureRequest request;
  request.set_parent(GroupName(link.group));
  request.set_loop_closure_id(link.id);
  v1::InterVehicleLoopClosure* const closure = request.mutable_loop_closure();
  Fill(link.query, closure->mutable_query());
  Fill(link.matched, closure->mutable_matched());
  Fill(link.measured, closure);
  const auto response = client.AddInterVehicleLoopClosure(request);
  if (!response.ok()) return response.status();
  PrintChange("linked", response->loop_closure().name(), *response, terminal);
  return absl::OkStatus();
}

absl::Status RunLinkReject(const Client& client, const NewRejection& rejection,
                           const Terminal& terminal) {
  v1::RejectInterVehicleCandidateRequest request;
  request.set_parent(GroupName(rejection.group));
  request.set_rejected_candidate_id(rejection.id);
  v1::InterVehicleRejectedCandidate* const rejected =
      request.mutable_rejected_candidate();
  Fill(rejection.query, rejected->mutable_query());
  Fill(rejection.matched, rejected->mutable_matched());
  rejected->set_note(rejection.note);
  const auto response = client.RejectInterVehicleCandidate(request);
  if (!response.ok()) return response.status();
  PrintChange("rejected", response->rejected_candidate().name(), *response,
              terminal);
  return absl::OkStatus();
}

absl::Status RunLinkList(const Client& client, const std::string& group,
                         const Terminal& terminal) {
  return PrintAll<Links>(client, group, terminal);
}

absl::Status RunLinkRejections(const Client& client, const std::string& group,
                               const Terminal& terminal) {
  return PrintAll<Rejections>(client, group, terminal);
}

absl::Status RunLinkDelete(const Client& client, const LinkReference& link,
                           const Terminal& terminal) {
  const auto name =
      link.is_rejected
          ? NameOfReferred<Rejections>(client, link, "rejectedCandidates")
          : NameOfReferred<Links>(client, link, "loopClosures");
  if (!name.ok()) return name.status();
  if (link.is_rejected) {
    v1::DeleteInterVehicleRejectedCandidateRequest request;
    request.set_name(*name);
    const auto response = client.DeleteInterVehicleRejectedCandidate(request);
    if (!response.ok()) return response.status();
    PrintRemoval("deleted", *name, *response, terminal);
    return absl::OkStatus();
  }
  v1::DeleteInterVehicleLoopClosureRequest request;
  request.set_name(*name);
  const auto response = client.DeleteInterVehicleLoopClosure(request);
  if (!response.ok()) return response.status();
  PrintRemoval("deleted", *name, *response, terminal);
  return absl::OkStatus();
}

}  // namespace revisit::client
