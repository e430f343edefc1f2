// revisit: the command line. Flags become plain structs here, and nothing else
// happens here: each command has a file of its own.

#include <unistd.h>

#include <chrono>
#include <functional>
#include <iostream>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "CLI/CLI.hpp"
#include "client/cli/console.h"
#include "client/cli/evaluate_command.h"
#include "client/cli/export_command.h"
#include "client/cli/find_command.h"
#include "client/cli/show_command.h"
#include "client/cli/stream_command.h"
#include "client/cli/vehicle_command.h"
#include "client/revisit/channel.h"
#include "client/revisit/client.h"
#include "client/revisit/status.h"
#include "grpcpp/channel.h"

namespace revisit::client {
namespace {

constexpr double kRadiansPerDegree = 3.14159265358979323846 / 180.0;

// What all commands share.
struct Common {
  std::string server = "127.0.0.1:50051";
  CLI::Option* server_option = nullptr;
  bool json = false;
};

// What the chosen command does.
using Run = std::function<absl::Status(const Console&)>;

using Words = std::map<std::string, int>;

const Words kStateSpaces = {{"planar", v1::STATE_SPACE_PLANAR},
                            {"spatial", v1::STATE_SPACE_SPATIAL}};
const Words kCorrelationModels = {
    {"dead-reckoning", v1::CORRELATION_MODEL_DEAD_RECKONING},
    {"independent", v1::CORRELATION_MODEL_INDEPENDENT},
    {"filter", v1::CORRELATION_MODEL_FILTER}};
// Drive files hold no error transitions, so FILTER is not for evaluations.
const Words kFileCorrelationModels = {
    {"dead-reckoning", v1::CORRELATION_MODEL_DEAD_RECKONING},
    {"independent", v1::CORRELATION_MODEL_INDEPENDENT}};
const Words kLikelihoodForms = {{"gaussian", v1::LIKELIHOOD_FORM_GAUSSIAN},
                                {"as-printed", v1::LIKELIHOOD_FORM_AS_PRINTED}};
const Words kCoordinateFrames = {{"local", v1::COORDINATE_FRAME_LOCAL},
                                 {"geodetic", v1::COORDINATE_FRAME_GEODETIC}};
const Words kDriveFormats = {{"drive", static_cast<int>(DriveFormat::kDrive)},
                             {"tum", static_cast<int>(DriveFormat::kTum)}};
const Words kUncertaintySources = {
    {"model", static_cast<int>(UncertaintyOptions::Source::kModel)},
    {"file", static_cast<int>(UncertaintyOptions::Source::kFile)}};
const Words kExportFormats = {
    {"jsonl", static_cast<int>(ExportFormat::kJsonLines)},
    {"nodes-csv", static_cast<int>(ExportFormat::kNodesCsv)},
    {"edges-csv", static_cast<int>(ExportFormat::kEdgesCsv)}};

// Where flags go: a command, and the heading they stand under in its help.
struct Flags {
  CLI::App* app;
  std::string heading = "Options";
};

// A flag with a fixed set of words for its values.
void AddChoice(const Flags& flags, const std::string& name, const Words& words,
               std::function<void(int)> set, const std::string& description) {
  std::string type;
  std::vector<std::string> known;
  for (const auto& [word, value] : words) {
    type += (type.empty() ? "" : "|") + word;
    known.push_back(word);
  }
  flags.app
      ->add_option_function<std::string>(
          name,
          [set = std::move(set), words](const std::string& word) {
            set(words.at(word));
          },
          description)
      ->type_name(type)
      ->check(CLI::IsMember(known).description(""))
      ->group(flags.heading);
}

void AddNumber(const Flags& flags, const std::string& name,
               const std::string& unit, std::function<void(double)> set,
               const std::string& description) {
  flags.app->add_option_function<double>(name, std::move(set), description)
      ->type_name(unit)
      ->group(flags.heading);
}

// A number with a default in place, which the help shows.
void AddDouble(const Flags& flags, const std::string& name,
               const std::string& unit, double* value,
               const std::string& description) {
  flags.app->add_option(name, *value, description)
      ->type_name(unit)
      ->group(flags.heading)
      ->capture_default_str();
}

// Flags that VehicleSettings and CandidateOptions have in common. Those that
// are not given leave `settings` as it is.
template <typename Settings>
void AddSearchSettings(const Flags& g, Settings* settings,
                       const Words& models) {
  AddChoice(
      g, "--correlation-model", models,
      [=](int v) {
        settings->set_correlation_model(static_cast<v1::CorrelationModel>(v));
      },
      "How errors of two poses hang together (dead-reckoning)");
  AddChoice(
      g, "--likelihood", kLikelihoodForms,
      [=](int v) {
        settings->set_likelihood_form(static_cast<v1::LikelihoodForm>(v));
      },
      "Form of the log-similarity (gaussian)");
  AddNumber(
      g, "--sequence-length", "M",
      [=](double v) { settings->set_sequence_length_meters(v); },
      "Travelled distance that is aligned with the history (150)");
  AddNumber(
      g, "--gate-probability", "P",
      [=](double v) { settings->set_gate_probability(v); },
      "Probability with which a true revisit passes the gate (0.95)");
  AddNumber(
      g, "--tolerance-position", "M",
      [=](double v) {
        settings->mutable_place_tolerance()->set_position_meters(v);
      },
      "Standard deviation between two passes of one place (2)");
  AddNumber(
      g, "--tolerance-heading", "RAD",
      [=](double v) {
        settings->mutable_place_tolerance()->set_heading_radians(v);
      },
      "The same for heading (0.1)");
  AddNumber(
      g, "--candidate-separation", "M",
      [=](double v) { settings->set_candidate_separation_meters(v); },
      "Least distance along the path between candidates (10)");
  g.app
      ->add_option_function<int>(
          "--max-candidates", [=](int v) { settings->set_max_candidates(v); },
          "Most candidates of one answer (5)")
      ->type_name("N")
      ->group(g.heading);
}

void AddVehicleSettings(CLI::App* app, v1::VehicleSettings* settings,
                        bool all) {
  const Flags g = {app, "Settings of the vehicle (and their defaults)"};
  AddSearchSettings(g, settings,
                    all ? kCorrelationModels : kFileCorrelationModels);
  AddNumber(
      g, "--node-spacing", "M",
      [=](double v) { settings->set_node_spacing_meters(v); },
      "Travelled distance between nodes (2)");
  AddNumber(
      g, "--check-interval", "M",
      [=](double v) { settings->set_check_interval_meters(v); },
      "Travelled distance between checks (50)");
  AddNumber(
      g, "--max-step", "M", [=](double v) { settings->set_max_step_meters(v); },
      "A longer step between two poses is a jump (100)");
  if (!all) return;
  AddChoice(
      g, "--state-space", kStateSpaces,
      [=](int v) { settings->set_state_space(static_cast<v1::StateSpace>(v)); },
      "Coordinates that take part (planar)");
  AddChoice(
      g, "--frame", kCoordinateFrames,
      [=](int v) {
        settings->set_coordinate_frame(static_cast<v1::CoordinateFrame>(v));
      },
      "Kind of positions that are streamed (local)");
}

void AddUncertainty(CLI::App* app, UncertaintyOptions* options) {
  const Flags g = {app, "Claimed uncertainty"};
  AddChoice(
      g, "--uncertainty", kUncertaintySources,
      [=](int v) {
        options->source = static_cast<UncertaintyOptions::Source>(v);
      },
      "Dead reckoning with the sigmas below (model, the default), or the "
      "file's columns plus the start's uncertainty, carried along (file)");
  AddDouble(g, "--sigma-along", "M", &options->along,
            "Per square root of a metre, along the path");
  AddDouble(g, "--sigma-across", "M", &options->across,
            "The same across the path");
  AddDouble(g, "--sigma-up", "M", &options->up,
            "The same upwards, for spatial vehicles");
  AddNumber(
      g, "--sigma-heading-degrees", "DEG",
      [=](double v) { options->heading = v * kRadiansPerDegree; },
      "The same in heading (0.1)");
  AddDouble(g, "--start-sigma-position", "M", &options->start_position,
            "Of the first pose");
  AddDouble(g, "--start-sigma-heading", "RAD", &options->start_heading,
            "Of the first pose");
}

// `details` and `examples` stand below the flags in the command's help.
CLI::App* AddCommand(CLI::App* app, const std::string& name,
                     const std::string& description, const std::string& details,
                     const std::string& examples) {
  CLI::App* command = app->add_subcommand(name, description);
  std::string footer = details;
  if (!examples.empty()) {
    footer += (footer.empty() ? "" : "\n\n") + ("Examples:\n" + examples);
  }
  command->footer(footer);
  return command;
}

void RequireVehicle(CLI::App* command, std::string* vehicle) {
  command->add_option("--vehicle", *vehicle, "Id, or name such as vehicles/ID")
      ->type_name("ID")
      ->required();
}

class Program {
 public:
  Program() : app_("Loop-closure candidates from the shape of trajectories.") {
    app_.name("revisit");
    app_.footer(
        "Examples:\n"
        "  revisit vehicle create shuttle-7\n"
        "  revisit stream drive.csv --vehicle shuttle-7\n"
        "  revisit find --vehicle shuttle-7\n"
        "  revisit evaluate drive.csv --verbose --map map.svg\n\n"
        "Exit codes:\n"
        "  0       done\n"
        "  1       a file, or something else on this machine, is at fault\n"
        "  64      wrong usage\n"
        "  64 + N  the server answered with the gRPC code N, such as 69 for\n"
        "          NOT_FOUND or 78 for UNAVAILABLE\n"
        "  130     interrupted\n\n"
        "revisit COMMAND --help tells more.");
    app_.set_version_flag("--version", "revisit " REVISIT_VERSION);
    app_.require_subcommand(1);
    app_.fallthrough();
    common_.server_option =
        app_.add_option("--server", common_.server,
                        "Address of the server (env REVISIT_SERVER)")
            ->type_name("ADDR")
            ->envname("REVISIT_SERVER")
            ->capture_default_str();
    app_.add_flag("--json", common_.json,
                  "Print JSON; messages of the service as protobuf JSON");
    AddVehicle();
    AddStream();
    AddFind();
    AddShow();
    AddExport();
    AddEvaluate();
  }

  int Main(int argc, char** argv) {
    try {
      app_.parse(argc, argv);
    } catch (const CLI::ParseError& error) {
      // Help and version are "errors" that exit with 0.
      return app_.exit(error) == 0 ? kExitOk : kExitUsage;
    }
    const Console console = {std::cout, std::cerr, isatty(STDERR_FILENO) == 1,
                             common_.json};
    absl::Status status = run_(console);
    if (std::cout.flush(); status.ok() && !std::cout) {
      status = LocalError(absl::UnknownError("the output cannot be written"));
    }
    if (!status.ok()) {
      std::cerr << (common_.json ? ErrorToJson(status)
                                 : "revisit: " + Describe(status))
                << '\n';
    }
    return ExitCodeOf(status);
  }

 private:
  Client MakeClient() const {
    return Client(MakeInsecureChannel(common_.server));
  }

  void AddVehicle() {
    CLI::App* vehicle = AddCommand(
        &app_, "vehicle", "Creates, shows and deletes vehicles.", "", "");
    vehicle->require_subcommand(1);
    vehicle->fallthrough();

    CLI::App* create = AddCommand(
        vehicle, "create",
        "Creates a vehicle. Again with the same settings: the existing one.",
        "",
        "  revisit vehicle create shuttle-7\n"
        "  revisit vehicle create drone-1 --state-space spatial "
        "--node-spacing 0.5");
    create->add_option("ID", vehicle_id_, "Lower-case letters, digits, dashes")
        ->required();
    AddVehicleSettings(create, &created_settings_, true);
    create->callback([this] {
      run_ = [this](const Console& console) {
        return RunVehicleCreate(MakeClient(), vehicle_id_, created_settings_,
                                console);
      };
    });

    CLI::App* get = AddCommand(vehicle, "get", "Shows a vehicle.", "",
                               "  revisit vehicle get shuttle-7 --json");
    get->add_option("ID", vehicle_id_)->required();
    get->callback([this] {
      run_ = [this](const Console& console) {
        return RunVehicleGet(MakeClient(), vehicle_id_, console);
      };
    });

    CLI::App* list = AddCommand(vehicle, "list", "Lists all vehicles.", "",
                                "  revisit vehicle list");
    list->callback([this] {
      run_ = [this](const Console& console) {
        return RunVehicleList(MakeClient(), console);
      };
    });

    CLI::App* remove =
        AddCommand(vehicle, "delete",
                   "Deletes vehicles with all their poses. Cannot be undone.",
                   "", "  revisit vehicle delete shuttle-7 shuttle-8");
    remove->add_option("ID", vehicle_ids_)->required();
    remove->callback([this] {
      run_ = [this](const Console& console) {
        return RunVehicleDelete(MakeClient(), vehicle_ids_, console);
      };
    });
  }

  void AddStream() {
    CLI::App* command = AddCommand(
        &app_, "stream", "Streams the poses of a file into a vehicle.",
        "Pose i of the file gets sequence i. A broken connection is made "
        "again. "
        "Stopped and run\nagain, it goes on where the server's durable poses "
        "end, "
        "after the server has compared\nthe last of them with the file's. "
        "Truth in "
        "the file is not sent.",
        "  revisit stream drive.csv --vehicle shuttle-7\n"
        "  revisit stream poses.txt --format tum --vehicle shuttle-7 --create\n"
        "  revisit stream drive.csv --vehicle shuttle-7 --candidates --json");
    command->add_option("FILE", stream_.file, "Drive file")->required();
    RequireVehicle(command, &stream_.vehicle);
    AddChoice(
        {command}, "--format", kDriveFormats,
        [this](int v) { stream_.format = static_cast<DriveFormat>(v); },
        "Comma-separated columns by name (drive, the default), or t x y z qx "
        "qy "
        "qz qw (tum)");
    command->add_flag("--create", stream_.create,
                      "Create the vehicle if there is none, with the server's "
                      "default settings");
    command->add_flag("--candidates", stream_.candidates,
                      "Print the candidates of every check that falls due");
    command->add_option("--batch", stream_.batch_poses, "Poses of one message")
        ->type_name("N")
        ->check(CLI::Range(1, 1'000'000).description(""))
        ->capture_default_str();
    command
        ->add_option("--acked-sequence", stream_.acked_sequence,
                     "Highest sequence known to be durable; if the server has "
                     "less, it answers DATA_LOSS")
        ->type_name("N");
    AddDouble({command}, "--give-up-after", "S", &give_up_seconds_,
              "Seconds without progress; 0 tries for ever");
    AddUncertainty(command, &stream_.uncertainty);
    command->callback([this] {
      if (give_up_seconds_ > 0.0) {
        stream_.give_up_after =
            std::chrono::duration_cast<std::chrono::milliseconds>(
                std::chrono::duration<double>(give_up_seconds_));
      }
      run_ = [this](const Console& console) {
        return RunStream(MakeInsecureChannel(common_.server), stream_, console);
      };
    });
  }

  void AddFind() {
    CLI::App* command = AddCommand(
        &app_, "find", "Asks for loop-closure candidates at one pose.", "",
        "  revisit find --vehicle shuttle-7\n"
        "  revisit find --vehicle shuttle-7 --sequence 4000 "
        "--max-candidates 10 --json");
    RequireVehicle(command, &find_vehicle_);
    command
        ->add_option_function<std::uint64_t>(
            "--sequence", [this](std::uint64_t v) { find_.set_sequence(v); },
            "Pose to ask at, with what lay before it as history; the newest if "
            "left out")
        ->type_name("N");
    command->add_flag_callback(
        "--aligned-path",
        [this] { find_.mutable_options()->set_include_aligned_path(true); },
        "Let the JSON have the aligned pairs");
    AddSearchSettings(Flags{command, "Instead of the vehicle's settings"},
                      find_.mutable_options(), kCorrelationModels);
    command->callback([this] {
      find_.set_vehicle(find_vehicle_);
      run_ = [this](const Console& console) {
        return RunFind(MakeClient(), find_, console);
      };
    });
  }

  void AddShow() {
    CLI::App* command =
        AddCommand(&app_, "show", "Summarises a vehicle's pose graph.", "",
                   "  revisit show --vehicle shuttle-7");
    RequireVehicle(command, &vehicle_id_);
    command->callback([this] {
      run_ = [this](const Console& console) {
        return RunShow(MakeClient(), vehicle_id_, console);
      };
    });
  }

  void AddExport() {
    CLI::App* command = AddCommand(
        &app_, "export", "Writes out a vehicle's pose graph.",
        "Formats:\n"
        "  jsonl      a JSON object a line: {\"vehicle\": ...}, then "
        "{\"node\": "
        "...} for each node,\n"
        "             then {\"edge\": ...} for each edge; protobuf JSON\n"
        "  nodes-csv  comma-separated with a header line: index,sequence,"
        "fraction,t_s,\n"
        "             travelled_m,x_m,y_m,z_m,heading_rad and the covariance's "
        "upper triangle\n"
        "  edges-csv  the same: from_index,to_index,kind\n"
        "Numbers read back to the same bits.",
        "  revisit export --vehicle shuttle-7 > graph.jsonl\n"
        "  revisit export --vehicle shuttle-7 --format nodes-csv --output "
        "nodes.csv");
    RequireVehicle(command, &export_.vehicle);
    AddChoice(
        {command}, "--format", kExportFormats,
        [this](int v) { export_.format = static_cast<ExportFormat>(v); },
        "What to write (jsonl)");
    command
        ->add_option("--output", export_.output,
                     "File to write instead of standard output")
        ->type_name("FILE");
    command->callback([this] {
      if (common_.json && export_.format != ExportFormat::kJsonLines) {
        throw CLI::ValidationError("--json", "goes with --format jsonl only");
      }
      run_ = [this](const Console& console) {
        return RunExport(MakeClient(), export_, console);
      };
    });
  }

  void AddEvaluate() {
    CLI::App* command = AddCommand(
        &app_, "evaluate",
        "Measures candidates on recorded drives whose truth is known.",
        "Streams the estimates of each drive through the service; the truth is "
        "not "
        "sent. Unless\n--server or REVISIT_SERVER names a server, a private "
        "one is "
        "started and stopped.\n\n"
        "A check is a true loop if a node before the excluded recent path lies "
        "within the loop\ndistance and loop heading of the current true pose; "
        "a "
        "candidate is correct by the same\ntest. Precision and recall count "
        "the "
        "first candidate of a check, if the gate accepted it:\n"
        "  precision = accepted and correct / accepted\n"
        "  recall    = accepted and correct / true loops",
        "  revisit evaluate kitti_05.csv\n"
        "  revisit evaluate drives/*.csv --json\n"
        "  revisit evaluate drive.csv --verbose --map map.svg\n"
        "  revisit evaluate drive.csv --correlation-model independent");
    command->add_option("FILE", evaluate_.files, "Drive files with truth")
        ->required();
    command->add_flag("--verbose", evaluate_.verbose,
                      "Print each check's best candidate");
    command
        ->add_option("--map", evaluate_.map,
                     "Draw the map of the drive (one file only)")
        ->type_name("FILE.svg");
    command->add_flag("--keep-vehicles", evaluate_.keep_vehicles,
                      "Leave the vehicles on the server that was named");
    command
        ->add_option("--vehicle", evaluate_.vehicle,
                     "Id of the vehicle to create (one file only); otherwise "
                     "ids are made up")
        ->type_name("ID");
    const Flags truth = {command, "Judging"};
    AddDouble(truth, "--first-check", "M",
              &evaluate_.judging.first_check_meters,
              "Earlier checks do not count; before two sequence lengths there "
              "are none");
    AddDouble(truth, "--exclude", "M", &evaluate_.exclude_meters,
              "Recent path that is no history");
    AddDouble(truth, "--loop-distance", "M",
              &evaluate_.judging.loop_distance_meters,
              "One place: true positions this near");
    AddNumber(
        truth, "--loop-heading-degrees", "DEG",
        [this](double v) {
          evaluate_.judging.loop_heading_radians = v * kRadiansPerDegree;
        },
        "One place: true headings this near (45)");
    SetProtocol(&evaluate_.settings);
    AddVehicleSettings(command, &evaluate_.settings, false);
    AddUncertainty(command, &evaluate_.uncertainty);
    command->callback([this] {
      if (evaluate_.files.size() > 1 &&
          !(evaluate_.map.empty() && evaluate_.vehicle.empty())) {
        throw CLI::ValidationError(
            evaluate_.map.empty() ? "--vehicle" : "--map",
            "takes one FILE only");
      }
      if (!(evaluate_.settings.node_spacing_meters() > 0.0)) {
        throw CLI::ValidationError("--node-spacing", "must be positive");
      }
      if (common_.server_option->count() > 0) {
        evaluate_.server = common_.server;
      }
      run_ = [this](const Console& console) {
        return RunEvaluate(evaluate_, console);
      };
    });
  }

  // An evaluation says all it depends on, whatever the server's defaults.
  static void SetProtocol(v1::VehicleSettings* settings) {
    settings->set_state_space(v1::STATE_SPACE_PLANAR);
    settings->set_correlation_model(v1::CORRELATION_MODEL_DEAD_RECKONING);
    settings->set_likelihood_form(v1::LIKELIHOOD_FORM_GAUSSIAN);
    settings->set_coordinate_frame(v1::COORDINATE_FRAME_LOCAL);
    settings->set_node_spacing_meters(2.0);
    settings->set_sequence_length_meters(150.0);
    settings->set_check_interval_meters(50.0);
    settings->set_max_step_meters(100.0);
    settings->set_gate_probability(0.95);
    settings->mutable_place_tolerance()->set_position_meters(2.0);
    settings->mutable_place_tolerance()->set_heading_radians(0.1);
    settings->set_candidate_separation_meters(10.0);
    settings->set_max_candidates(5);
  }

  CLI::App app_;
  Common common_;
  Run run_;
  std::string vehicle_id_;
  std::vector<std::string> vehicle_ids_;
  v1::VehicleSettings created_settings_;
  StreamOptions stream_;
  double give_up_seconds_ = 60.0;
  std::string find_vehicle_;
  v1::FindCandidatesRequest find_;
  ExportOptions export_;
  EvaluateOptions evaluate_;
};

}  // namespace
}  // namespace revisit::client

int main(int argc, char** argv) {
  std::ios::sync_with_stdio(false);
  return revisit::client::Program().Main(argc, argv);
}
