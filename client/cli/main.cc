// revisit: the command line.

#include <unistd.h>

#include <iostream>
#include <string>

#include "absl/strings/str_cat.h"
#include "client/cli/commands/checks_command.h"
#include "client/cli/commands/context_command.h"
#include "client/cli/commands/contradictions_command.h"
#include "client/cli/commands/convert_command.h"
#include "client/cli/commands/deletions_command.h"
#include "client/cli/commands/demo_command.h"
#include "client/cli/commands/evaluate_command.h"
#include "client/cli/commands/export_command.h"
#include "client/cli/commands/find_command.h"
#include "client/cli/commands/findings_command.h"
#include "client/cli/commands/group_command.h"
#include "client/cli/commands/health_command.h"
#include "client/cli/commands/help_command.h"
#include "client/cli/commands/info_command.h"
#include "client/cli/commands/link_command.h"
#include "client/cli/commands/map_command.h"
#include "client/cli/commands/poses_command.h"
#include "client/cli/commands/recordings_command.h"
#include "client/cli/commands/review_command.h"
#include "client/cli/commands/revise_command.h"
#include "client/cli/commands/show_command.h"
#include "client/cli/commands/stream_command.h"
#include "client/cli/commands/vehicle_command.h"
#include "client/cli/commands/verify_command.h"
#include "client/cli/commands/watch_command.h"
#include "client/cli/connection_flags.h"
#include "client/cli/connection_hint.h"
#include "client/cli/flags.h"
#include "client/cli/grpc_log.h"
#include "client/cli/usage/help_text.h"
#include "client/revisit/channel.h"
#include "client/revisit/client.h"
#include "client/terminal/output_file.h"
#include "client/terminal/terminal.h"
#include "core/base/build_info.h"
#include "grpcpp/channel.h"

namespace revisit::client {
namespace {

constexpr char kSummary[] =
    "Loop-closure candidates from the shape of trajectories.";

constexpr char kExamples[] =
    "  revisit vehicle create shuttle-7\n"
    "  revisit stream drive.csv --vehicle shuttle-7\n"
    "  revisit find shuttle-7\n"
    "  revisit evaluate drive.csv --verbose --map map.svg";

constexpr char kNotes[] =
    "Exit codes:\n"
    "  0       done\n"
    "  1       a file, or something else on this machine, is at fault\n"
    "  64      wrong usage\n"
    "  64 + N  the server answered with the gRPC code N, such as 69 for\n"
    "          NOT_FOUND or 78 for UNAVAILABLE\n"
    "  130     interrupted\n\n"
    "revisit COMMAND --help tells more.";

// In the order of the help.
void AddCommands(const Command& program, const ConnectionFlags* connection,
                 const UsageSource& usage) {
  AddVehicleCommand(program);
  AddStreamCommand(program);
  AddFindCommand(program);
  AddChecksCommand(program);
  AddWatchCommand(program);
  AddReviewCommand(program);
  AddConfirmCommand(program);
  AddRejectCommand(program);
  AddClosuresCommand(program);
  AddRejectionsCommand(program);
  AddDeletionsCommand(program);
  AddContradictionsCommand(program);
  AddGroupCommand(program);
  AddLinkCommand(program);
  AddPosesCommand(program);
  AddRecordingsCommand(program);
  AddShowCommand(program);
  AddExportCommand(program);
  AddMapCommand(program);
  AddReviseCommand(program);
  AddConvertCommand(program);
  AddEvaluateCommand(program, connection);
  AddDemoCommand(program);
  AddContextCommand(program, connection);
  AddInfoCommand(program);
  AddHealthCommand(program);
  AddCompletionCommand(program, usage);
  AddHelpCommand(program, usage);
  AddManPagesCommand(program, usage,
                     {kBuildDate, std::string("revisit ") + kVersion});
}

absl::Status RunWithServer(const Run& run, const ChosenServer& server,
                           const Terminal& terminal) {
  const auto channel = MakeChannelTo(server);
  if (!channel.ok()) return channel.status();
  const absl::Status status =
      run({server.options, *channel, Client(*channel)}, terminal);
  const std::string hint = ConnectionHint(status, server);
  return hint.empty() ? status : WithHint(status, hint);
}

absl::Status RunChosen(const ParsedLine& line, const Command& program,
                       const ConnectionFlags& connection,
                       const Terminal& terminal) {
  if (line.version) {
    terminal.out << "revisit " << kVersionText << '\n';
    return absl::OkStatus();
  }
  if (line.help.has_value()) {
    terminal.out << HelpText(*line.help, HelpWidth(terminal.width));
    return absl::OkStatus();
  }
  if (line.run_alone != nullptr) return line.run_alone(terminal);
  const auto server = ChooseServer(program, connection);
  if (!server.ok()) return server.status();
  return RunWithServer(line.run, *server, terminal);
}

// In one write, so that nothing comes in between that a thread, or another
// program on the same terminal, writes at the same time.
void ReportError(const absl::Status& status, bool json) {
  if (json) {
    std::cerr << absl::StrCat(ErrorToJson(status), "\n");
    return;
  }
  // A wrong usage needs no name of the program.
  std::cerr << absl::StrCat(ExitCodeOf(status) == kExitUsage ? "" : "revisit: ",
                            ErrorText(status), "\n");
}

int Main(int argc, const char* const* argv) {
  ConnectionFlags connection;
  CommandLine command_line({"revisit", kSummary, "", kExamples, kNotes});
  AddConnectionFlags(command_line.program(), &connection);
  AddCommands(command_line.program(), &connection,
              [&command_line] { return command_line.Usage(); });
  const auto line = command_line.Parse(argc, argv);
  if (!line.ok()) {
    ReportError(line.status(), AsksForJson(argc, argv));
    return ExitCodeOf(line.status());
  }
  const Terminal terminal = {std::cout, std::cerr, isatty(STDERR_FILENO) == 1,
                             line->format, TerminalWidth(STDOUT_FILENO)};
  absl::Status status =
      RunChosen(*line, command_line.program(), connection, terminal);
  if (std::cout.flush(); status.ok()) status = CheckOutput(std::cout);
  if (!status.ok()) ReportError(status, terminal.json());
  return ExitCodeOf(status);
}

}  // namespace
}  // namespace revisit::client

int main(int argc, char** argv) {
  std::ios::sync_with_stdio(false);
  revisit::client::SilenceGrpcLog();
  return revisit::client::Main(argc, argv);
}
