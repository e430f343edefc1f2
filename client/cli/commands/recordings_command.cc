#include "client/cli/commands/recordings_command.h"

#include <memory>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "client/answers/names.h"
#include "client/cli/commands/frame_columns.h"
#include "client/cli/commands/shared_flags.h"
#include "client/revisit/printable_text.h"
#include "client/trajectory/recording_starts.h"
#include "client/trajectory/stored_poses.h"
#include "revisit/v1/pose_graph_service.pb.h"

namespace revisit::client {
namespace {

std::vector<std::string> CellsOf(const v1::Recording& recording, bool wide) {
  std::vector<std::string> cells = {
      absl::StrCat(recording.first_sequence()),
      absl::StrCat(recording.last_sequence()),
      recording.label().empty() ? "-" : recording.label(),
      recording.has_start() ? RelationText(recording.start()) : "-"};
  AddFrameCells(recording, wide, &cells);
  return cells;
}

void PrintTable(const std::vector<v1::Recording>& all,
                const Terminal& terminal) {
  using Align = Table::Align;
  std::vector<Table::Column> columns = {{"FIRST", Align::kRight},
                                        {"LAST", Align::kRight},
                                        {"LABEL", Align::kLeft},
                                        {"START", Align::kLeft}};
  AddFrameColumns(terminal.wide(), &columns);
  Table table(std::move(columns));
  for (const v1::Recording& recording : all) {
    table.AddRow(CellsOf(recording, terminal.wide()));
  }
  table.Print(terminal.out, terminal.width);
}

}  // namespace

void AddRecordingsCommand(const Command& program) {
  const Command recordings = program.AddCommand(
      {"recordings", "Lists the recordings of a vehicle.", "", ""});
  const Command list = recordings.AddCommand(
      {"list", "Lists a vehicle's recordings, the oldest first.",
       absl::StrCat(
           "A recording is a stretch of poses in a frame of its own: one run "
           "of an "
           "odometry. The table\nhas the sequences of its first and last pose, "
           "what "
           "its first pose told of the frame\n(revisit stream --recording), "
           "and "
           "how the frame is tied to that of the last recording:\n"
           "  SAME         it is the last one\n",
           kFrameStatesHelp,
           "Its x, y and yaw are those of its origin in the frame of the last "
           "recording. -o wide has\ntheir standard deviations too, and the "
           "place "
           "in its own frame at which they hold."),
       "  revisit recordings list shuttle-7\n"
       "  revisit recordings list shuttle-7 -o wide"});
  const auto vehicle = std::make_shared<std::string>();
  AddVehicleName(list, vehicle.get());
  list.AlsoPrints({OutputFormat::kWide, OutputFormat::kName});
  list.Runs([vehicle](const Connection& server, const Terminal& terminal) {
    return RunRecordingsList(server.client, *vehicle, terminal);
  });
}

absl::Status RunRecordingsList(const Client& client, const std::string& vehicle,
                               const Terminal& terminal) {
  const auto all = ReadRecordings(client, VehicleName(vehicle));
  if (!all.ok()) return all.status();
  if (terminal.json()) {
    v1::ListRecordingsResponse response;
    response.mutable_recordings()->Assign(all->begin(), all->end());
    terminal.out << ToJson(response, true) << '\n';
  } else if (terminal.names()) {
    for (const v1::Recording& recording : *all) {
      terminal.out << Printable(recording.name()) << '\n';
    }
  } else {
    PrintTable(*all, terminal);
  }
  return absl::OkStatus();
}

}  // namespace revisit::client
