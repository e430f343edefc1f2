#include "client/cli/commands/stream_command.h"

#include <algorithm>
#include <filesystem>
#include <sstream>
#include <system_error>
#include <utility>
#include <vector>

#include "absl/strings/ascii.h"
#include "absl/strings/str_cat.h"
#include "client/answers/candidate_text.h"
#include "client/answers/names.h"
#include "client/cli/commands/reader_flags.h"
#include "client/cli/commands/sample_sender.h"
#include "client/cli/commands/shared_flags.h"
#include "client/cli/commands/stream_summary.h"
#include "client/formats/text_lines.h"
#include "client/revisit/pose_stream.h"
#include "client/revisit/printable_text.h"
#include "client/revisit/status.h"
#include "client/trajectory/drive_poses.h"
#include "core/base/mutex.h"
#include "grpcpp/channel.h"
#include "nlohmann/json.hpp"

namespace revisit::client {
namespace {

using Clock = std::chrono::steady_clock;

// Counts over the answers of a stream.
struct Tally {
  Mutex mutex;
  std::uint64_t revision ABSL_GUARDED_BY(mutex) = 0;
  std::int64_t jumps ABSL_GUARDED_BY(mutex) = 0;
  std::int64_t checks ABSL_GUARDED_BY(mutex) = 0;
  // Which members of a group the last check has not searched, in words.
  std::string unsearched ABSL_GUARDED_BY(mutex);
};

// All of `tally`, `progress` and `terminal` must outlive the stream.
PoseStreamCallbacks MakeCallbacks(Tally* tally, Progress* progress,
                                  const Terminal& terminal) {
  PoseStreamCallbacks callbacks;
  callbacks.ack = [tally, progress](const v1::Ack& ack) {
    progress->Update(ack.durable_sequence());
    const MutexLock lock(&tally->mutex);
    tally->revision = ack.revision();
    tally->jumps += ack.jumps_size();
    for (const v1::Jump& jump : ack.jumps()) {
      progress->Note(JumpText(jump));
    }
    for (const v1::Warning& warning : ack.warnings()) {
      progress->Note(WarningText(warning));
    }
  };
  callbacks.candidates = [tally, &terminal](const v1::CandidateSet& set) {
    const MutexLock lock(&tally->mutex);
    ++tally->checks;
    if (terminal.json()) {
      terminal.out << ToJson(set, false) << '\n';
    } else {
      std::ostringstream unsearched;
      PrintUnsearched(set, unsearched);
      if (tally->unsearched != unsearched.str())
        terminal.out << unsearched.str();
      tally->unsearched = unsearched.str();
      PrintCheck(set, terminal.out);
    }
  };
  callbacks.disconnected = [progress](const absl::Status& status,
                                      std::chrono::nanoseconds wait) {
    progress->Note(
        absl::StrCat(ReadsHistories(status) ? "not opened" : "connection lost",
                     ", trying again in ",
                     Fixed(std::chrono::duration<double>(wait).count(), 1),
                     " s: ", Describe(status)));
  };
  return callbacks;
}

constexpr char kStreamDetails[] =
    "Pose i of all FILEs gets sequence i; - is the standard input, whose "
    "poses are sent as\nthey arrive. A broken connection is made again. "
    "Stopped, by Ctrl-C too, and run again, it goes on where\nthe server's "
    "durable poses "
    "end, after the server has compared the last of them with the\nfile's. "
    "Truth in the file is not sent.\n\n"
    "Compressed files (gzip, zstd) are read too. Receivers' fixes (rtklib, "
    "gpx, nmea) become\ngeodetic poses that face where they move; where "
    "they do not move, they are left out. What\nlooks like wrong axes, "
    "units or orders is refused; the message says which flag mends it.\n\n"
    "Covariances of the file are claimed where they grow along the drive; the "
    "last lines say what was claimed, and how long the drive is.\n\n"
    "An odometry that was switched off and on again goes on in a frame of its "
    "own: there a\nrecording begins, and searches look in those before it. A "
    "file whose first pose does not go\non where the one before it ended "
    "begins one by itself, and so does an odometry of ROS that\nis back at its "
    "start; a line says so, and --recording says what is known of the frame.";

constexpr char kStreamExamples[] =
    "  revisit stream drive.csv --vehicle shuttle-7\n"
    "  revisit stream poses.txt --axes camera --times times.txt --vehicle "
    "shuttle-7 --create\n"
    "  revisit stream log.csv --columns t=time,x=east,y=north,yaw=psi "
    "--vehicle shuttle-7\n"
    "  revisit stream log.txt --columns t=1,x=2,y=3,yaw=4 --vehicle "
    "shuttle-7\n"
    "  revisit stream tuesday.pos --vehicle shuttle-7 --append --session "
    "tuesday\n"
    "  revisit stream monday.csv tuesday.csv --vehicle shuttle-7 "
    "--recording datum:10m,1deg\n"
    "  ros2 topic echo --csv /odom | revisit stream - --vehicle shuttle-7\n"
    "  revisit stream drive.csv --vehicle shuttle-7 --candidates "
    "--direction either --json\n"
    "  revisit stream drive.csv --vehicle shuttle-8 --candidates "
    "--group depot --exclude-own";

// Adds the flags that say what becomes of the poses.
void AddVehicleFlags(const Command& command, StreamOptions* options) {
  command.AddSwitch("--create", &options->create,
                    "Create the vehicle if there is none, with the server's "
                    "default settings");
  command.AddChoice(
      "--correlation-model", WordsOf(v1::CorrelationModel_descriptor()),
      [options](int model) {
        options->settings.set_correlation_model(
            static_cast<v1::CorrelationModel>(model));
      },
      "Of the vehicle that --create makes (dead-reckoning; independent for "
      "fixes)");
  command.AddSwitch("--append", &options->append,
                    "Give the first pose the sequence behind the durable ones "
                    "and compare nothing: another recording of the vehicle");
  AddRecording(command, &options->recording);
  command.AddText("--session", "NAME", &options->session,
                  "Keep the range of these poses as the vehicle's label "
                  "session.NAME");
  command.AddSwitch("--candidates", &options->candidates,
                    "Print the candidates of every check that falls due");
  AddDirection(command, &options->candidate_options);
  AddScope(command, &options->candidate_options);
}

// A label's key is session. and the name.
std::string CheckSession(const std::string& name) {
  const auto is_inner = [](char c) {
    return absl::ascii_islower(c) || absl::ascii_isdigit(c) || c == '.' ||
           c == '_' || c == '/' || c == '-';
  };
  constexpr std::size_t kMostBytes = 55;
  if (name.empty() || (name.size() <= kMostBytes &&
                       std::all_of(name.begin(), name.end(), is_inner) &&
                       absl::ascii_isalnum(name.back()))) {
    return "";
  }
  return absl::StrCat("--session: got \"", name, "\"; allowed are 1 to ",
                      kMostBytes,
                      " of a-z, 0-9, '.', '_', '/' and '-', a letter or digit "
                      "last");
}

// Adds the flags of sending, and of what is known from an earlier life.
void AddResuming(const Command& command, StreamOptions* options) {
  command
      .AddWholeNumber("--batch", {1, 1'000'000}, &options->batch_poses,
                      "Most poses of one message")
      .ShowDefault();
  command.AddWholeNumber("--acked-sequence", WholeRange(),
                         &options->acked_sequence,
                         "Highest sequence known to be durable; if the server "
                         "has less, it answers DATA_LOSS");
  command.AddText(
      "--vehicle-uid", "UID", &options->vehicle_uid,
      "Uid of the vehicle that is meant; another of its name is refused, and "
      "with it --acked-sequence proves a loss to the server, which then "
      "refuses writes until accept-loss");
}

// Settles which words are files and which is the vehicle. Says what is wrong
// with the flags taken together; empty if nothing is.
std::string FinishOptions(const Command& command, StreamOptions* options) {
  options->uncertainty_given = command.Given("--uncertainty");
  if (options->vehicle.empty() && options->files.size() > 1) {
    options->vehicle = options->files.back();
    options->files.pop_back();
  }
  if (options->vehicle.empty()) return "--vehicle is required";
  for (const char* flag : {"--direction", "--group"}) {
    if (command.Given(flag) && !options->candidates) {
      return absl::StrCat(flag, ": goes with --candidates");
    }
  }
  if (std::string problem = CheckSession(options->session); !problem.empty()) {
    return problem;
  }
  std::error_code error;
  if (options->files.back() == options->vehicle &&
      !std::filesystem::exists(options->vehicle, error)) {
    return absl::StrCat("--vehicle: ", options->vehicle, " is named twice");
  }
  const auto pipes =
      std::count(options->files.begin(), options->files.end(), "-");
  return pipes > 1 ? "FILE: the standard input can be read once only" : "";
}

// A file that is not there shows before the first one is sent. Those that are
// there may be pipes, which can be opened once only.
absl::Status CheckThatFilesAreThere(const std::vector<std::string>& files) {
  for (const std::string& file : files) {
    std::error_code error;
    if (file == "-" || std::filesystem::exists(file, error)) continue;
    const auto bytes = OpenBytes(file, nullptr);
    if (!bytes.ok()) return LocalError(bytes.status());
  }
  return absl::OkStatus();
}

// Sends a file to its end. An error is how the stream has ended before that.
absl::Status SendFile(const std::string& file, const ReaderOptions& options,
                      SampleSender* sender, StreamSummary* summary) {
  sender->BeginFile(file);
  summary->drive.BeginFile();
  const auto reader = OpenSamples(file, options);
  if (!reader.ok()) return sender->FinishAfter(reader.status());
  for (;;) {
    const auto sample = (*reader)->Next();
    if (!sample.ok()) return sender->FinishAfter(sample.status());
    if (!sample->has_value()) break;
    summary->drive.Add(**sample);
    if (!sender->Take(**sample).ok()) return sender->Finish();
  }
  const LeftOut left_out = (*reader)->left_out();
  summary->left_out.standing += left_out.standing;
  summary->left_out.wrong_checksums += left_out.wrong_checksums;
  return absl::OkStatus();
}

// Adds what the sender and the answers know in the end.
void FinishSummary(const StreamOptions& options, const SampleSender& sender,
                   Tally* tally, StreamSummary* summary) {
  summary->vehicle = sender.vehicle().name();
  summary->vehicle_uid = sender.stream().vehicle_uid();
  summary->poses = sender.taken();
  summary->recordings = sender.recordings();
  summary->uncertainty = sender.uncertainty();
  summary->already_durable = sender.already_durable();
  summary->durable = sender.stream().acked_sequence();
  summary->reconnects = sender.stream().reconnects();
  const MutexLock lock(&tally->mutex);
  summary->revision = std::max(tally->revision, sender.vehicle().revision());
  summary->jumps = tally->jumps;
  if (!options.candidates) return;
  summary->checks = tally->checks;
  const v1::Direction direction = options.candidate_options.direction();
  summary->same_direction_only =
      direction == v1::DIRECTION_UNSPECIFIED || direction == v1::DIRECTION_SAME;
}

}  // namespace

void AddStreamCommand(const Command& program) {
  const Command command = program.AddCommand(
      {"stream", "Streams the poses of files or of a pipe into a vehicle.",
       kStreamDetails, kStreamExamples});
  const auto options = std::make_shared<StreamOptions>();
  const auto give_up_seconds = std::make_shared<double>(60.0);
  command
      .AddTexts("FILE", "TEXT", &options->files,
                "Recordings, one after the other; - for the standard input")
      .Required();
  command.AddText("--vehicle", "ID", &options->vehicle,
                  "Id, or name such as vehicles/ID; without it, the last word "
                  "after FILE");
  AddVehicleFlags(command, options.get());
  AddResuming(command, options.get());
  command.AddNumber("--give-up-after", "S", give_up_seconds.get(),
                    "Seconds without progress; 0 tries for ever");
  AddReaderFlags(command, &options->reader);
  AddUncertainty(command, &options->uncertainty);
  const Check check = [command, options] {
    return FinishOptions(command, options.get());
  };
  const Run run = [options, give_up_seconds](const Connection& server,
                                             const Terminal& terminal) {
    if (*give_up_seconds > 0.0) {
      options->give_up_after =
          std::chrono::duration_cast<std::chrono::milliseconds>(
              std::chrono::duration<double>(*give_up_seconds));
    }
    return RunStream(server.channel, *options, terminal);
  };
  command.Runs(run, check);
}

absl::Status RunStream(const std::shared_ptr<grpc::Channel>& channel,
                       const StreamOptions& options, const Terminal& terminal) {
  Progress progress(terminal, StemOf(options.files[0]), 0, "poses");
  Tally tally;
  const PoseStreamCallbacks callbacks =
      MakeCallbacks(&tally, &progress, terminal);
  SampleSender sender(channel, options, callbacks, terminal, &progress);
  ReaderOptions reader_options = options.reader;
  reader_options.before_wait = [&sender] { return sender.BeforeWait(); };
  const auto start = Clock::now();
  if (absl::Status there = CheckThatFilesAreThere(options.files); !there.ok()) {
    return there;
  }
  StreamSummary summary;
  for (const std::string& file : options.files) {
    const absl::Status sent = SendFile(file, reader_options, &sender, &summary);
    if (!sent.ok()) return sent;
  }
  if (sender.taken() == 0) {
    return LocalError(absl::InvalidArgumentError(
        absl::StrCat(options.files[0], ": the vehicle never moves")));
  }
  if (absl::Status finished = sender.Finish(); !finished.ok()) return finished;
  if (absl::Status kept = sender.KeepSession(); !kept.ok()) return kept;
  summary.seconds = std::chrono::duration<double>(Clock::now() - start).count();
  FinishSummary(options, sender, &tally, &summary);
  Print(summary, terminal);
  return absl::OkStatus();
}

}  // namespace revisit::client
