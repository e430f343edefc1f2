// revisit: the command line. Flags become plain structs here, and nothing else
// happens here: each command has a file of its own.

#include <unistd.h>

#include <charconv>
#include <chrono>
#include <cmath>
#include <functional>
#include <iostream>
#include <limits>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "CLI/CLI.hpp"
#include "client/cli/commands/evaluate_command.h"
#include "client/cli/commands/export_command.h"
#include "client/cli/commands/find_command.h"
#include "client/cli/commands/show_command.h"
#include "client/cli/commands/stream_command.h"
#include "client/cli/commands/vehicle_command.h"
#include "client/cli/commands/verify_command.h"
#include "client/cli/connection_hint.h"
#include "client/cli/console.h"
#include "client/cli/evaluation/simulation.h"
#include "client/revisit/channel.h"
#include "client/revisit/client.h"
#include "grpcpp/channel.h"

namespace revisit::client {
namespace {

constexpr double kRadiansPerDegree = 3.14159265358979323846 / 180.0;

// What all commands share.
struct Common {
  // Where a server listens unless it is told otherwise.
  Common() { channel.address = "127.0.0.1:50051"; }

  ChannelOptions channel;
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
const Words kAlignments = {{"relative", v1::ALIGNMENT_RELATIVE},
                           {"composite", v1::ALIGNMENT_COMPOSITE}};
const Words kCoordinateFrames = {{"local", v1::COORDINATE_FRAME_LOCAL},
                                 {"geodetic", v1::COORDINATE_FRAME_GEODETIC}};
const Words kDirections = {{"same", v1::DIRECTION_SAME},
                           {"opposite", v1::DIRECTION_OPPOSITE},
                           {"either", v1::DIRECTION_EITHER}};
const Words kDriveFormats = {{"drive", static_cast<int>(DriveFormat::kDrive)},
                             {"tum", static_cast<int>(DriveFormat::kTum)}};
const Words kEvaluationFormats = {
    {"drive", static_cast<int>(EvaluateOptions::Format::kDrive)},
    {"rtklib", static_cast<int>(EvaluateOptions::Format::kRtklib)}};
const Words kPassDirections = {
    {"same", static_cast<int>(PassDirection::kSame)},
    {"opposite", static_cast<int>(PassDirection::kOpposite)},
    {"either", static_cast<int>(PassDirection::kEither)}};
const Words kUncertaintySources = {
    {"model", static_cast<int>(UncertaintyOptions::Source::kModel)},
    {"file", static_cast<int>(UncertaintyOptions::Source::kFile)}};
const Words kExportFormats = {
    {"jsonl", static_cast<int>(ExportFormat::kJsonLines)},
    {"nodes-csv", static_cast<int>(ExportFormat::kNodesCsv)},
    {"edges-csv", static_cast<int>(ExportFormat::kEdgesCsv)}};

// Sequences of poses are from 1 to this, as the service counts them.
constexpr std::int64_t kMaxSequence = std::numeric_limits<std::int64_t>::max();

// Takes decimal digits only: CLI11 by itself reads -1 as the largest number
// there is, and 010 as 8.
CLI::Validator WholeNumber(std::int64_t lowest, std::int64_t highest) {
  return {[=](std::string& text) {
            std::int64_t value = 0;
            const char* const end = text.data() + text.size();
            const auto [stop, error] = std::from_chars(text.data(), end, value);
            if (error != std::errc() || stop != end || value < lowest ||
                value > highest) {
              return "got \"" + text + "\"; allowed is a whole number in [" +
                     std::to_string(lowest) + ", " + std::to_string(highest) +
                     "]";
            }
            text = std::to_string(value);
            return std::string();
          },
          ""};
}

CLI::Validator FiniteNumber(bool positive = false) {
  return {[=](std::string& text) {
            double value = 0.0;
            if (CLI::detail::lexical_cast(text, value) &&
                std::isfinite(value) && (!positive || value > 0.0)) {
              return std::string();
            }
            return "got \"" + text + "\"; allowed is a finite number" +
                   (positive ? " above 0" : "");
          },
          ""};
}

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
      ->check(FiniteNumber())
      ->group(flags.heading);
}

// A number with a default in place, which the help shows.
void AddDouble(const Flags& flags, const std::string& name,
               const std::string& unit, double* value,
               const std::string& description) {
  flags.app->add_option(name, *value, description)
      ->type_name(unit)
      ->check(FiniteNumber())
      ->group(flags.heading)
      ->capture_default_str();
}

// Flags that VehicleSettings and CandidateOptions have in common. Those that
// are not given leave `settings` as it is.
template <typename Settings>
void AddSearchSettings(const Flags& g, Settings* settings,
                       const Words& models) {
  AddChoice(
      g, "--alignment", kAlignments,
      [=](int v) { settings->set_alignment(static_cast<v1::Alignment>(v)); },
      "Shared drift counted once, or the paper's sum over all pairs of nodes "
      "(relative)");
  AddNumber(
      g, "--acceptance-probability", "P",
      [=](double v) { settings->set_acceptance_probability(v); },
      "Relative: least probability of an accepted candidate (0.4)");
  AddNumber(
      g, "--road-spacing", "M",
      [=](double v) { settings->set_road_spacing_meters(v); },
      "Relative: mean distance between roads not driven (200)");
  AddNumber(
      g, "--shape-tolerance-position", "M",
      [=](double v) {
        settings->mutable_shape_tolerance()->set_position_meters(v);
      },
      "Relative: how far two passes of a road stray within a sequence (1)");
  AddNumber(
      g, "--shape-tolerance-heading", "RAD",
      [=](double v) {
        settings->mutable_shape_tolerance()->set_heading_radians(v);
      },
      "The same for heading (0.06)");
  AddNumber(
      g, "--shape-correlation", "M",
      [=](double v) { settings->set_shape_correlation_meters(v); },
      "Relative: distance over which that straying is one and the same (10)");
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
      ->transform(WholeNumber(1, 100))
      ->group(g.heading);
}

// The messages of the service take a tolerance whole: of one that is given in
// half, the rest would be 0.
void RequireWholeTolerances(CLI::App* app) {
  for (const std::string name : {"--tolerance", "--shape-tolerance"}) {
    CLI::Option* position = app->get_option(name + "-position");
    CLI::Option* heading = app->get_option(name + "-heading");
    position->needs(heading);
    heading->needs(position);
  }
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
  app->add_flag_function(
         "--apply-inflation,!--no-apply-inflation",
         [=](std::int64_t count) { settings->set_apply_inflation(count > 0); },
         "Widen the claimed uncertainty as confirmed loop closures ask for")
      ->group(g.heading);
  AddNumber(
      g, "--max-inflation", "FACTOR",
      [=](double v) { settings->set_max_inflation(v); },
      "The most it is widened by (10)");
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

// Bare, in its place among the command's other words, or as a flag.
void RequireVehicle(CLI::App* command, std::string* vehicle) {
  command
      ->add_option("VEHICLE,--vehicle", *vehicle,
                   "Id, or name such as vehicles/ID")
      ->type_name("ID")
      ->required();
}

// Where a command is wanted, CLI11 says that one is missing even if another
// word stands there.
std::string UsageMessage(const CLI::App* app, const CLI::Error& error) {
  const CLI::App* chosen = app;
  while (!chosen->get_subcommands().empty()) {
    chosen = chosen->get_subcommands().front();
  }
  std::string text = error.what();
  const auto commands =
      chosen->get_subcommands([](const CLI::App*) { return true; });
  if (error.get_name() == "RequiredError" && !commands.empty()) {
    const std::vector<std::string> words = app->remaining(true);
    text = words.empty() ? "a command is missing"
                         : "got \"" + words.front() + "\"";
    for (const CLI::App* command : commands) {
      text += (command == commands.front() ? "; allowed is " : ", ") +
              command->get_name();
    }
  }
  return text + "\nRun with --help for more information.\n";
}

class Program {
 public:
  Program() : app_("Loop-closure candidates from the shape of trajectories.") {
    app_.name("revisit");
    app_.footer(
        "Examples:\n"
        "  revisit vehicle create shuttle-7\n"
        "  revisit stream drive.csv --vehicle shuttle-7\n"
        "  revisit find shuttle-7\n"
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
    app_.failure_message(UsageMessage);
    common_.server_option =
        app_.add_option("--server", common_.channel.address,
                        "Address of the server (env REVISIT_SERVER)")
            ->type_name("ADDR")
            ->envname("REVISIT_SERVER")
            ->capture_default_str();
    CLI::Option* const authorities =
        AddFile("--tls-ca",
                "Speak TLS; who may have issued the server's certificate (PEM)",
                &common_.channel.tls_authorities_file);
    CLI::Option* const certificate =
        AddFile("--tls-cert", "Own certificate (PEM)",
                &common_.channel.tls_certificate_file);
    CLI::Option* const key = AddFile("--tls-key", "Its private key (PEM)",
                                     &common_.channel.tls_key_file);
    certificate->needs(key)->needs(authorities);
    key->needs(certificate);
    AddFile("--token-file", "Bearer token; read again for each call",
            &common_.channel.token_file);
    app_.add_flag("--json", common_.json,
                  "Print JSON; messages of the service as protobuf JSON");
    AddVehicle();
    AddStream();
    AddFind();
    AddVerified("confirm", "Tells that two poses were found to be one place.",
                "Adds a loop closure. Again: the existing one.",
                "  revisit confirm shuttle-7 2068 1072", &RunConfirm);
    AddVerified("reject",
                "Tells that two poses were found not to be one place.",
                "The candidate is not offered again. Again: the existing "
                "rejection.",
                "  revisit reject shuttle-7 2068 1155", &RunReject);
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
    const auto channel = MakeChannel(common_.channel);
    absl::Status status;
    if (channel.ok()) {
      channel_ = *channel;
      status = run_(console);
    } else {
      status = LocalError(channel.status());
    }
    if (std::cout.flush(); status.ok() && !std::cout) {
      status = LocalError(absl::UnknownError("the output cannot be written"));
    }
    if (!status.ok()) {
      std::cerr << (common_.json ? ErrorToJson(status)
                                 : "revisit: " + ErrorText(status))
                << '\n';
      const std::string hint = ConnectionHint(status, common_.channel);
      if (!common_.json && !hint.empty()) std::cerr << hint << '\n';
    }
    return ExitCodeOf(status);
  }

 private:
  Client MakeClient() const { return Client(channel_); }

  CLI::Option* AddFile(const std::string& flag, const std::string& description,
                       std::string* value) {
    return app_.add_option(flag, *value, description)->type_name("FILE");
  }

  void AddVehicle() {
    CLI::App* vehicle =
        AddCommand(&app_, "vehicle",
                   "Creates, shows, changes and deletes vehicles.", "", "");
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
    RequireWholeTolerances(create);
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

    CLI::App* update = AddCommand(
        vehicle, "update",
        "Changes the settings that are given, and no others.",
        "Once a vehicle has poses, its state space and its frame are fixed, "
        "and "
        "so is\nwhether its correlation model is filter.",
        "  revisit vehicle update shuttle-7 --apply-inflation\n"
        "  revisit vehicle update shuttle-7 --acceptance-probability 0.9");
    update->add_option("ID", vehicle_id_)->required();
    AddVehicleSettings(update, &changed_settings_, true);
    RequireWholeTolerances(update);
    update->callback([this] {
      if (changed_settings_.ByteSizeLong() == 0) {
        throw CLI::RequiredError("A setting to change");
      }
      run_ = [this](const Console& console) {
        return RunVehicleUpdate(MakeClient(), vehicle_id_, changed_settings_,
                                console);
      };
    });

    CLI::App* accept = AddCommand(
        vehicle, "accept-loss",
        "Lets a vehicle in the state DATA_LOSS take poses again.",
        "A client held an acknowledgement for poses that the store has not "
        "got. Whoever calls\nthis accepts that all after DURABLE_SEQ are "
        "gone; the client then sends them again, or\ngoes on from there. "
        "Restore a newer backup instead if there is one.",
        "  revisit vehicle get shuttle-7   # its state, its durable poses\n"
        "  revisit vehicle accept-loss shuttle-7 1200");
    accept->add_option("ID", vehicle_id_)->required();
    accept
        ->add_option("DURABLE_SEQ", durable_sequence_,
                     "The vehicle's durable poses, to show that you know them")
        ->type_name("N")
        ->transform(WholeNumber(0, kMaxSequence))
        ->required();
    accept->callback([this] {
      run_ = [this](const Console& console) {
        return RunVehicleAcceptLoss(MakeClient(), vehicle_id_,
                                    durable_sequence_, console);
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
        ->transform(WholeNumber(1, 1'000'000))
        ->capture_default_str();
    command
        ->add_option("--acked-sequence", stream_.acked_sequence,
                     "Highest sequence known to be durable; if the server has "
                     "less, it answers DATA_LOSS")
        ->type_name("N")
        ->transform(WholeNumber(0, kMaxSequence));
    command
        ->add_option("--vehicle-uid", stream_.vehicle_uid,
                     "Uid of the vehicle that is meant; another of its name is "
                     "refused, and with it --acked-sequence proves a loss to "
                     "the server, which then refuses writes until accept-loss")
        ->type_name("UID");
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
        return RunStream(channel_, stream_, console);
      };
    });
  }

  void AddFind() {
    CLI::App* command = AddCommand(
        &app_, "find", "Asks for loop-closure candidates at one pose.", "",
        "  revisit find shuttle-7\n"
        "  revisit find shuttle-7 --sequence 2000 "
        "--max-candidates 10 --json\n"
        "  revisit find shuttle-7 --direction either "
        "--acceptance-probability 0.9");
    RequireVehicle(command, &find_vehicle_);
    command
        ->add_option_function<std::uint64_t>(
            "--sequence", [this](std::uint64_t v) { find_.set_sequence(v); },
            "Pose to ask at, with what lay before it as history; the newest if "
            "left out")
        ->type_name("N")
        ->transform(WholeNumber(1, kMaxSequence));
    command->add_flag_callback(
        "--aligned-path",
        [this] { find_.mutable_options()->set_include_aligned_path(true); },
        "Let the JSON have the aligned pairs");
    command->add_flag_callback(
        "--exhaustive",
        [this] { find_.mutable_options()->set_exhaustive(true); },
        "Look at all of history, and answer also what is too improbable to be "
        "accepted");
    AddChoice(
        {command}, "--direction", kDirections,
        [this](int v) {
          find_.mutable_options()->set_direction(static_cast<v1::Direction>(v));
        },
        "Which way the place was passed before, against the way it is passed "
        "now (same)");
    AddSearchSettings(Flags{command, "Instead of the vehicle's settings"},
                      find_.mutable_options(), kCorrelationModels);
    RequireWholeTolerances(command);
    command->callback([this] {
      find_.set_vehicle(find_vehicle_);
      run_ = [this](const Console& console) {
        return RunFind(MakeClient(), find_, console);
      };
    });
  }

  // `revisit confirm` and `revisit reject`.
  void AddVerified(const std::string& name, const std::string& description,
                   const std::string& details, const std::string& examples,
                   absl::Status (*run)(const Client&, const VerifiedPair&,
                                       const Console&)) {
    CLI::App* command = AddCommand(&app_, name, description, details, examples);
    command->add_option("VEHICLE", verified_.vehicle, "Id, or name")
        ->required();
    command
        ->add_option("QUERY_SEQ", verified_.query_sequence,
                     "Sequence of the later pose")
        ->type_name("N")
        ->transform(WholeNumber(1, kMaxSequence))
        ->required();
    command
        ->add_option("MATCHED_SEQ", verified_.matched_sequence,
                     "Sequence of the earlier pose")
        ->type_name("N")
        ->transform(WholeNumber(1, kMaxSequence))
        ->required();
    command->callback([this, run] {
      run_ = [this, run](const Console& console) {
        return run(MakeClient(), verified_, console);
      };
    });
  }

  void AddShow() {
    CLI::App* command =
        AddCommand(&app_, "show", "Summarises a vehicle's pose graph.", "",
                   "  revisit show shuttle-7");
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
        "  revisit export shuttle-7 > graph.jsonl\n"
        "  revisit export shuttle-7 --format nodes-csv --output "
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
        "not sent. Unless\n--server or REVISIT_SERVER names a server, a "
        "private "
        "one is started and stopped.\n\n"
        "A check is a true loop if a node before the excluded recent path lies "
        "within the loop\ndistance and loop heading of the current true pose; "
        "a candidate is right by the same\ntest. Precision and recall count "
        "the first candidate of a check, if its verdict is ACCEPTED:\n"
        "  precision   accepted and right / accepted\n"
        "  recall      accepted and right / true loops\n"
        "  top-1       right in first place / true loops, verdict aside\n"
        "  recall@5    right among the first five / true loops, verdict aside\n"
        "  verify/loop accepted candidates of any rank / loops found by them\n"
        "  ECE         expected calibration error of the stated probabilities",
        "  revisit evaluate kitti_05.csv\n"
        "  revisit evaluate drives/*.csv --baselines --plots plots\n"
        "  revisit evaluate drives/*.csv --sequence-lengths "
        "100,150,200,300,400\n"
        "  revisit evaluate drives/*.csv --simulate 1-5 --claimed-scale 0.5 "
        "--verify --apply-inflation\n"
        "  revisit evaluate drive.csv --verbose --map map.svg\n"
        "  revisit evaluate day1.pos day2.pos --format rtklib --one-vehicle "
        "--truth ref1.csv ref2.csv");
    command->add_option("FILE", evaluate_.files, "Drive files with truth")
        ->required();
    AddChoice(
        {command}, "--format", kEvaluationFormats,
        [this](int v) {
          evaluate_.format = static_cast<EvaluateOptions::Format>(v);
        },
        "Comma-separated columns by name (drive, the default), or an RTKLIB "
        "solution with velocities (rtklib), taken as independent fixes with "
        "the covariances it states");
    command
        ->add_option("--truth", evaluate_.truth_files,
                     "rtklib: the reference trajectory of each FILE, "
                     "comma-separated columns by name")
        ->type_name("FILE");
    command->add_flag("--one-vehicle", evaluate_.one_vehicle,
                      "Stream all files into one vehicle, one after the other");
    command->add_flag("--verbose", evaluate_.verbose,
                      "Print each check's best candidate");
    command
        ->add_option("--map", evaluate_.map,
                     "Draw the map of the drive (one drive only)")
        ->type_name("FILE.svg");
    command
        ->add_option("--plots", evaluate_.plots,
                     "Draw precision_recall.svg and reliability.svg there")
        ->type_name("DIR");
    command
        ->add_option("--repeat", evaluate_.repeats,
                     "Do it all N times, fail unless all answers are the same, "
                     "and time them all")
        ->type_name("N")
        ->transform(WholeNumber(1, 1000))
        ->capture_default_str();
    command->add_flag("--keep-vehicles", evaluate_.keep_vehicles,
                      "Leave the vehicles on the server that was named");
    command
        ->add_option("--vehicle", evaluate_.vehicle,
                     "Id of the vehicle to create, where there is one only; "
                     "otherwise ids are made up")
        ->type_name("ID");

    const Flags measured = {command, "What is measured"};
    command
        ->add_flag("--baselines", evaluate_.baselines,
                   "Beside the settings: nearest position, single pose, and "
                   "the paper's alignment without and with cross-covariance")
        ->group(measured.heading);
    command
        ->add_option("--sequence-lengths", evaluate_.sequence_lengths,
                     "Each of these instead of --sequence-length; each is the "
                     "excluded recent path too")
        ->type_name("M,M,...")
        ->delimiter(',')
        ->allow_extra_args(false)
        ->check(FiniteNumber(/*positive=*/true))
        ->group(measured.heading);
    command
        ->add_flag("--exhaustive", evaluate_.exhaustive,
                   "Let searches look at all of history, and answer also what "
                   "is too improbable to be accepted")
        ->group(measured.heading);
    AddChoice(
        measured, "--direction", kPassDirections,
        [this](int v) {
          evaluate_.judging.direction = static_cast<PassDirection>(v);
        },
        "Which way the vehicle may have passed before (same)");
    command
        ->add_option("--simulate", simulated_seeds_,
                     "Draw each drive's estimate anew from the noise below "
                     "along its truth, once for each seed, such as 1-5")
        ->type_name("SEEDS")
        ->group(measured.heading);
    command
        ->add_flag("--verify", evaluate_.verify,
                   "Play the verifier: tell the service which accepted first "
                   "candidates are right and which are wrong")
        ->group(measured.heading);

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
    AddDouble({command, "Claimed uncertainty"}, "--claimed-scale", "FACTOR",
              &evaluate_.uncertainty.claimed_scale,
              "Claim every standard deviation this many times as large");
    command->callback([this, command] {
      FinishEvaluate(command);
      run_ = [this](const Console& console) {
        return RunEvaluate(evaluate_, console);
      };
    });
  }

  // What the flags of an evaluation say of each other.
  void FinishEvaluate(CLI::App* command) {
    if (!simulated_seeds_.empty()) {
      auto seeds = ParseSeeds(simulated_seeds_);
      if (!seeds.ok()) {
        throw CLI::ValidationError("--simulate",
                                   std::string(seeds.status().message()));
      }
      evaluate_.seeds = *std::move(seeds);
      if (evaluate_.uncertainty.source != UncertaintyOptions::Source::kModel) {
        throw CLI::ValidationError("--simulate",
                                   "goes with --uncertainty model only");
      }
    }
    if (evaluate_.format == EvaluateOptions::Format::kRtklib) {
      if (!evaluate_.seeds.empty()) {
        throw CLI::ValidationError("--simulate",
                                   "goes with --format drive only");
      }
      if (command->get_option("--uncertainty")->count() > 0) {
        throw CLI::ValidationError("--uncertainty",
                                   "goes with --format drive only");
      }
      if (evaluate_.truth_files.size() != evaluate_.files.size()) {
        throw CLI::ValidationError(
            "--truth", "expected one for each FILE of --format rtklib");
      }
      if (command->get_option("--correlation-model")->count() == 0) {
        evaluate_.settings.set_correlation_model(
            v1::CORRELATION_MODEL_INDEPENDENT);
      }
    } else if (!evaluate_.truth_files.empty()) {
      throw CLI::ValidationError("--truth", "goes with --format rtklib only");
    }
    const bool one_drive =
        (evaluate_.files.size() == 1 || evaluate_.one_vehicle) &&
        evaluate_.seeds.size() <= 1;
    if (!evaluate_.map.empty() && !one_drive) {
      throw CLI::ValidationError("--map", "takes one drive only");
    }
    if (!evaluate_.vehicle.empty() &&
        (!one_drive || evaluate_.baselines || evaluate_.repeats > 1 ||
         evaluate_.sequence_lengths.size() > 1)) {
      throw CLI::ValidationError("--vehicle",
                                 "goes with what takes one vehicle only");
    }
    if (!(evaluate_.settings.node_spacing_meters() > 0.0)) {
      throw CLI::ValidationError("--node-spacing", "must be positive");
    }
    if (!(evaluate_.uncertainty.claimed_scale > 0.0)) {
      throw CLI::ValidationError("--claimed-scale", "must be positive");
    }
    if (common_.server_option->count() > 0) evaluate_.server = common_.channel;
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
    settings->set_alignment(v1::ALIGNMENT_RELATIVE);
    settings->set_acceptance_probability(0.4);
    settings->set_road_spacing_meters(200.0);
    settings->mutable_shape_tolerance()->set_position_meters(1.0);
    settings->mutable_shape_tolerance()->set_heading_radians(0.06);
    settings->set_shape_correlation_meters(10.0);
    settings->set_apply_inflation(false);
    settings->set_max_inflation(10.0);
  }

  CLI::App app_;
  Common common_;
  // To the server that is named; it connects when it is used.
  std::shared_ptr<grpc::Channel> channel_;
  Run run_;
  std::string vehicle_id_;
  std::vector<std::string> vehicle_ids_;
  std::uint64_t durable_sequence_ = 0;
  v1::VehicleSettings created_settings_;
  v1::VehicleSettings changed_settings_;
  VerifiedPair verified_;
  StreamOptions stream_;
  double give_up_seconds_ = 60.0;
  std::string find_vehicle_;
  v1::FindCandidatesRequest find_;
  ExportOptions export_;
  EvaluateOptions evaluate_;
  std::string simulated_seeds_;
};

}  // namespace
}  // namespace revisit::client

int main(int argc, char** argv) {
  std::ios::sync_with_stdio(false);
  return revisit::client::Program().Main(argc, argv);
}
