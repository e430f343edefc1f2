#include "client/cli/commands/demo_command.h"

#include <unistd.h>

#include <filesystem>
#include <memory>
#include <string>
#include <system_error>

#include "absl/status/statusor.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/substitute.h"
#include "client/cli/commands/demo_group.h"
#include "client/cli/commands/vehicle_settings.h"
#include "client/evaluation/evaluate_options.h"
#include "client/evaluation/run_evaluation.h"

namespace revisit::client {
namespace {

constexpr char kVehicle[] = "boreas";

constexpr char kDrive[] =
    "The path is real: two days over the same streets of Toronto (Boreas data "
    "set,\nCC BY 4.0). The estimate is simulated dead reckoning: seeded noise "
    "of wheels and a\ngyroscope, with the covariance that goes with it. The "
    "server sees the estimate only.\n\n";

// How to go on with a server that stays: the address, the vehicle, the path of
// this program, and the vehicle that asks in a group with that group.
constexpr char kHints[] =
    "\nAsk it yourself:\n\n"
    "  export REVISIT_SERVER=$0\n"
    "  $2 find $1\n"
    "  $2 find $3 --group $4 --exclude-own\n"
    "  $2 map $1 --output $1.html\n"
    "  $2 map $3 --group $4 --exclude-own --output $4.html\n"
    "  grpcurl -plaintext $0 list\n"
    "  grpcurl -plaintext $0 describe revisit.v1.Candidate\n"
    "  grpcurl -plaintext -d '{\"vehicle\": \"vehicles/$1\", \"sequence\": "
    "1500}' \\\n"
    "    $0 revisit.v1.PoseGraphService/FindCandidates\n\n"
    "In a browser, with the console of a source tree:\n\n"
    "  deploy/console --server $0\n\n"
    "The server stays up until Ctrl-C.\n";

struct DemoOptions {
  std::string map = "demo.svg";
  bool keep = false;
};

// The shipped drive, which lies beside the programs where they are built and
// where they are installed.
absl::StatusOr<std::string> FindDrive(const std::filesystem::path& program) {
  std::error_code error;
  const auto path = program.parent_path().parent_path() /
                    "share/revisit/demo/boreas_glen_shields.csv";
  if (!std::filesystem::exists(path, error)) {
    return absl::NotFoundError(
        absl::StrCat(path.string(),
                     ": the drive that is installed with revisit is missing"));
  }
  return path.string();
}

absl::Status RunDemo(const DemoOptions& demo, const Terminal& terminal) {
  std::error_code error;
  const auto program = std::filesystem::read_symlink("/proc/self/exe", error);
  if (error) {
    return LocalError(
        absl::UnknownError(absl::StrCat("/proc/self/exe: ", error.message())));
  }
  const auto drive = FindDrive(program);
  if (!drive.ok()) return LocalError(drive.status());
  EvaluateOptions options;
  options.files = {*drive};
  SetUsualSettings(&options.settings);
  options.uncertainty.source = UncertaintyOptions::Source::kFile;
  options.uncertainty_given = true;
  options.verbose = terminal.json();
  options.map = demo.map;
  options.vehicle = kVehicle;
  options.keep_vehicles = true;
  options.before_undoing = [&](const std::string& address) -> absl::Status {
    if (terminal.json()) return absl::OkStatus();
    const auto group_map = RunDemoGroup(options, address, terminal);
    if (!group_map.ok()) return group_map.status();
    terminal.out << "\nThe map of the drive is in " << demo.map
                 << ", that of its days as two vehicles in " << *group_map
                 << ".\n"
                 << (demo.keep
                         ? absl::Substitute(kHints, address, kVehicle,
                                            program.string(), kDemoAsking,
                                            kDemoGroup)
                         : "With --keep the server stays up, and the demo "
                           "ends with commands to ask it yourself.\n")
                 << std::flush;
    // The interrupt that ends this stops the server and ends the process.
    while (demo.keep) pause();
    return absl::OkStatus();
  };
  if (!terminal.json()) terminal.out << *drive << "\n" << kDrive << std::flush;
  return RunEvaluate(options, terminal);
}

}  // namespace

void AddDemoCommand(const Command& program) {
  const Command command = program.AddCommand(
      {"demo", "Finds the loops of a real drive on a server of its own.",
       "Starts a server on a free port of 127.0.0.1 with a store of its own, "
       "streams the drive\nthat is installed with revisit to it (15.9 km on "
       "two days), asks every 50 m where the\nvehicle has been before, "
       "compares "
       "the answers with the truth as `revisit evaluate`\ndoes, and draws the "
       "map. Then the two days are two vehicles of one group, and the\nsecond "
       "is asked where it is in the first, before and after a loop closure "
       "between\nthem, and both are drawn in one map. It takes some seconds.",
       "  revisit demo\n"
       "  revisit demo --map demo.html --keep"});
  const auto options = std::make_shared<DemoOptions>();
  command.AddText(
      "--map", "FILE", &options->map,
      "Where to draw the map: a page for a browser if the name ends "
      "in .html, otherwise SVG (demo.svg); that of the two vehicles has -group "
      "in its name");
  command.AddSwitch("--keep", &options->keep,
                    "Leave the server up, with the drive and the group in it, "
                    "until Ctrl-C");
  command.RunsAlone([options](const Terminal& terminal) {
    return RunDemo(*options, terminal);
  });
}

}  // namespace revisit::client
