#include "client/cli/commands/recordings_command.h"

#include <memory>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "client/answers/deviation_text.h"
#include "client/answers/names.h"
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
      recording.has_start() ? RelationText(recording.start()) : "-",
      NameOf(recording.frame_state())};
  const v1::StatePose& pose = recording.frame_pose();
  for (const auto& [value, digits] :
       {std::pair(pose.x_meters(), 2), std::pair(pose.y_meters(), 2),
        std::pair(pose.heading_radians(), 4)}) {
    cells.push_back(recording.has_frame_pose() ? Fixed(value, digits) : "-");
  }
  if (!wide) return cells;
  for (std::string& deviation : DeviationTexts(recording.frame_covariance())) {
    cells.push_back(std::move(deviation));
  }
  const v1::StatePose& at = recording.frame_reference();
  for (const double value : {at.x_meters(), at.y_meters()}) {
    cells.push_back(recording.has_frame_reference() ? Fixed(value, 2) : "-");
  }
  return cells;
}

void PrintTable(const std::vector<v1::Recording>& all,
                const Terminal& terminal) {
  using Align = Table::Align;
  std::vector<Table::Column> columns = {
      {"FIRST", Align::kRight},     {"LAST", Align::kRight},
      {"LABEL", Align::kLeft},      {"START", Align::kLeft},
      {"FRAME", Align::kLeft},      {"FRAME X m", Align::kRight},
      {"FRAME Y m", Align::kRight}, {"FRAME YAW rad", Align::kRight}};
  if (terminal.wide()) {
    for (const char* title :
         {"SD X m", "SD Y m", "SD Z m", "SD YAW rad", "AT X m", "AT Y m"}) {
      columns.push_back({title, Align::kRight});
    }
  }
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
       "A recording is a stretch of poses in a frame of its own: one run of an "
       "odometry. The table\nhas the sequences of its first and last pose, "
       "what "
       "its first pose told of the frame\n(revisit stream --recording), and "
       "how the frame is tied to that of the last recording:\n"
       "  SAME         it is the last one\n"
       "  AFTER        it ended where the next one began, and so on\n"
       "  DATUM        both were placed in a frame that they share\n"
       "  PROVISIONAL  by loop closures, but by fewer than three that agree\n"
       "  KNOWN        by three loop closures or more that agree\n"
       "  NONE         by nothing: only shapes are compared\n"
       "Its x, y and yaw are those of its origin in the frame of the last "
       "recording. -o wide has\ntheir standard deviations too, and the place "
       "in its own frame at which they hold.",
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
