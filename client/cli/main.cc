// revisit: the command line.

#include <unistd.h>

#include <algorithm>
#include <iostream>
#include <string>

#include "client/cli/commands/convert_command.h"
#include "client/cli/commands/demo_command.h"
#include "client/cli/commands/evaluate_command.h"
#include "client/cli/commands/export_command.h"
#include "client/cli/commands/find_command.h"
#include "client/cli/commands/findings_command.h"
#include "client/cli/commands/health_command.h"
#include "client/cli/commands/help_command.h"
#include "client/cli/commands/info_command.h"
#include "client/cli/commands/map_command.h"
#include "client/cli/commands/poses_command.h"
#include "client/cli/commands/revise_command.h"
#include "client/cli/commands/show_command.h"
#include "client/cli/commands/stream_command.h"
#include "client/cli/commands/vehicle_command.h"
#include "client/cli/commands/verify_command.h"
#include "client/cli/connection_hint.h"
#include "client/cli/flags.h"
#include "client/cli/usage/help_text.h"
#include "client/revisit/channel.h"
#include "client/revisit/client.h"
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

// Flags that every command takes.
struct GlobalFlags {
  ChannelOptions channel;
  bool json = false;
};

void AddGlobalFlags(const Command& program, GlobalFlags* flags) {
  ChannelOptions& channel = flags->channel;
  // A server listens here by default.
  channel.address = "127.0.0.1:50051";
  program.AddText("--server", "ADDR", &channel.address, "Address of the server")
      .OrEnvironment("REVISIT_SERVER")
      .ShowDefault();
  const Flag authorities =
      program
          .AddText(
              "--tls-ca", "FILE", &channel.tls_authorities_file,
              "Speak TLS; who may have issued the server's certificate (PEM)")
          .OrEnvironment("REVISIT_TLS_CA");
  const Flag certificate =
      program
          .AddText("--tls-cert", "FILE", &channel.tls_certificate_file,
                   "Certificate of this client (PEM)")
          .OrEnvironment("REVISIT_TLS_CERT");
  const Flag key = program
                       .AddText("--tls-key", "FILE", &channel.tls_key_file,
                                "Private key of --tls-cert (PEM)")
                       .OrEnvironment("REVISIT_TLS_KEY");
  certificate.Needs(key).Needs(authorities);
  key.Needs(certificate);
  program
      .AddText("--token-file", "FILE", &channel.token_file,
               "Bearer token; read again for each call")
      .OrEnvironment("REVISIT_TOKEN_FILE");
  program.AddSwitch("--json", &flags->json,
                    "Print JSON; messages of the service as protobuf JSON");
}

// In the order of the help.
void AddCommands(const Command& program, const UsageSource& usage) {
  AddVehicleCommand(program);
  AddStreamCommand(program);
  AddFindCommand(program);
  AddConfirmCommand(program);
  AddRejectCommand(program);
  AddClosuresCommand(program);
  AddRejectionsCommand(program);
  AddPosesCommand(program);
  AddShowCommand(program);
  AddExportCommand(program);
  AddMapCommand(program);
  AddReviseCommand(program);
  AddConvertCommand(program);
  AddEvaluateCommand(program);
  AddDemoCommand(program);
  AddInfoCommand(program);
  AddHealthCommand(program);
  AddCompletionCommand(program, usage);
  AddHelpCommand(program, usage);
  AddManPagesCommand(program, usage, {kBuildDate, "revisit " REVISIT_VERSION});
}

absl::Status RunChosen(const ParsedLine& line, const ChannelOptions& options,
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
  const auto channel = MakeChannel(options);
  if (!channel.ok()) return LocalError(channel.status());
  return line.run({options, *channel, Client(*channel)}, terminal);
}

void ReportError(const absl::Status& error, const GlobalFlags& flags) {
  const std::string hint = ConnectionHint(error, flags.channel);
  const absl::Status status = hint.empty() ? error : WithHint(error, hint);
  if (flags.json) {
    std::cerr << ErrorToJson(status) << '\n';
    return;
  }
  // A wrong usage needs no name of the program.
  std::cerr << (ExitCodeOf(status) == kExitUsage ? "" : "revisit: ")
            << ErrorText(status) << '\n';
}

// Also where the command line cannot be parsed.
bool AsksForJson(int argc, const char* const* argv) {
  const std::string json = "--json";
  return std::find(argv, argv + argc, json) != argv + argc;
}

int Main(int argc, const char* const* argv) {
  GlobalFlags flags;
  CommandLine command_line({"revisit", kSummary, "", kExamples, kNotes});
  AddGlobalFlags(command_line.program(), &flags);
  AddCommands(command_line.program(),
              [&command_line] { return command_line.Usage(); });
  const auto line = command_line.Parse(argc, argv);
  if (!line.ok()) {
    flags.json = AsksForJson(argc, argv);
    ReportError(line.status(), flags);
    return ExitCodeOf(line.status());
  }
  const Terminal terminal = {std::cout, std::cerr, isatty(STDERR_FILENO) == 1,
                             flags.json, TerminalWidth(STDOUT_FILENO)};
  absl::Status status = RunChosen(*line, flags.channel, terminal);
  if (std::cout.flush(); status.ok() && !std::cout) {
    status = LocalError(absl::UnknownError("the output cannot be written"));
  }
  if (!status.ok()) ReportError(status, flags);
  return ExitCodeOf(status);
}

}  // namespace
}  // namespace revisit::client

int main(int argc, char** argv) {
  std::ios::sync_with_stdio(false);
  return revisit::client::Main(argc, argv);
}
