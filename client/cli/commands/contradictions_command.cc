#include "client/cli/commands/contradictions_command.h"

#include <memory>
#include <unordered_map>
#include <utility>
#include <vector>

#include "absl/status/statusor.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_replace.h"
#include "client/answers/names.h"
#include "client/revisit/printable_text.h"
#include "client/trajectory/stored_poses.h"
#include "google/protobuf/util/time_util.h"

namespace revisit::client {
namespace {

using google::protobuf::util::TimeUtil;

// The cells of a loop closure behind its id and p-value; dashes if it is gone.
std::vector<std::string> CellsOf(const v1::LoopClosure* closure) {
  if (closure == nullptr) return {"-", "-", "-", "-", ""};
  return {absl::StrCat(closure->query_sequence()),
          absl::StrCat(closure->matched_sequence()),
          TimeUtil::ToString(closure->create_time()),
          closure->decided_by().empty() ? "-" : closure->decided_by(),
          absl::StrReplaceAll(closure->note(), {{"\n", " "}, {"\t", " "}})};
}

absl::Status Print(const Client& client, const std::string& vehicle,
                   const v1::FindContradictionsResponse& found,
                   const Terminal& terminal) {
  using Align = Table::Align;
  std::unordered_map<std::string, v1::LoopClosure> closures;
  if (!found.contradictions().empty()) {
    auto all = ReadLoopClosures(client, VehicleName(vehicle));
    if (!all.ok()) return all.status();
    for (v1::LoopClosure& closure : *all) {
      std::string name = closure.name();
      closures.emplace(std::move(name), std::move(closure));
    }
  }
  // The note is last, since it is as long as whoever wrote it wanted.
  Table table({{"ID", Align::kLeft},
               {"P-VALUE", Align::kRight},
               {"QUERY_SEQ", Align::kRight},
               {"MATCHED_SEQ", Align::kRight},
               {"CREATED", Align::kLeft},
               {"DECIDED_BY", Align::kLeft},
               {"NOTE", Align::kLeft}});
  for (const v1::Contradiction& contradiction : found.contradictions()) {
    const std::string& name = contradiction.loop_closure();
    std::vector<std::string> row = {IdOf(name),
                                    absl::StrCat(contradiction.p_value())};
    const auto closure = closures.find(name);
    for (std::string& cell :
         CellsOf(closure == closures.end() ? nullptr : &closure->second)) {
      row.push_back(std::move(cell));
    }
    table.AddRow(std::move(row));
  }
  table.Print(terminal.out, terminal.width);
  return absl::OkStatus();
}

}  // namespace

void AddContradictionsCommand(const Command& program) {
  const Command command = program.AddCommand(
      {"contradictions",
       "Lists the loop closures that contradict others, for a second look.",
       "Each of them says something else than others that agree with each "
       "other, so the verifier was most likely wrong: P-VALUE is the "
       "probability of so large a difference if it is right. Nothing is "
       "changed. revisit closures delete gives one up.",
       "  revisit contradictions shuttle-7\n"
       "  revisit contradictions shuttle-7 -o name"});
  const auto vehicle = std::make_shared<std::string>();
  command.AddText("VEHICLE", "TEXT", vehicle.get(), "Id, or name").Required();
  command.AlsoPrints({OutputFormat::kName});
  command.Runs([vehicle](const Connection& server, const Terminal& terminal) {
    return RunContradictions(server.client, *vehicle, terminal);
  });
}

absl::Status RunContradictions(const Client& client, const std::string& vehicle,
                               const Terminal& terminal) {
  v1::FindContradictionsRequest request;
  request.set_vehicle(VehicleName(vehicle));
  const auto found = client.FindContradictions(request);
  if (!found.ok()) return found.status();
  if (terminal.json()) {
    terminal.out << ToJson(*found, true) << '\n';
    return absl::OkStatus();
  }
  if (terminal.names()) {
    for (const v1::Contradiction& contradiction : found->contradictions()) {
      terminal.out << Printable(contradiction.loop_closure()) << '\n';
    }
    return absl::OkStatus();
  }
  return Print(client, vehicle, *found, terminal);
}

}  // namespace revisit::client
