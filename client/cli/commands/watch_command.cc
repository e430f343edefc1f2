#include "client/cli/commands/watch_command.h"

#include <algorithm>
#include <atomic>
#include <cerrno>
#include <chrono>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <system_error>
#include <thread>
#include <utility>
#include <vector>

#include "absl/strings/ascii.h"
#include "absl/strings/str_cat.h"
#include "client/answers/names.h"
#include "client/cli/commands/candidate_decisions.h"
#include "client/cli/commands/shared_flags.h"
#include "client/revisit/candidate_watch.h"
#include "client/revisit/printable_text.h"
#include "client/revisit/status.h"
#include "client/terminal/file_error.h"
#include "client/terminal/interrupt_guard.h"
#include "client/terminal/output_file.h"
#include "client/terminal/replaced_file.h"
#include "client/terminal/shell_command.h"
#include "grpcpp/channel.h"
#include "nlohmann/json.hpp"

namespace revisit::client {
namespace {

namespace fs = std::filesystem;
using Json = nlohmann::ordered_json;

constexpr char kDetails[] =
    "Tells every change of the candidates of stored checks (vehicle create "
    "--checks stored), of these vehicles or of all, until it is interrupted. "
    "Each is a line of JSON: \"candidate\" or \"vehicleDeleted\", the "
    "\"cursor\" behind it, and whether it is \"resynchronised\": of the list "
    "with which the watch began, or began anew because the server no longer "
    "had what lies behind the cursor.\n\n"
    "Lost connections are made again. With --cursor-file, the next run goes on "
    "where this one ended; an event of which it is not known that it was "
    "worked off comes again, with the same vehicleUid and number.\n\n"
    "--exec runs a command for each open candidate, with the line on its "
    "standard input. Its exit code decides:\n"
    "  0        the two poses are one place, as revisit confirm tells\n"
    "  10       they are not, as revisit reject tells\n"
    "  20       nobody decides yet\n"
    "  another  the watch ends with an error, and the event comes again in the "
    "next run\n\n"
    "A candidate of a loop closure that contradicts others "
    "(\"CANDIDATE_CAUSE_CONTRADICTION\") is open once more: 0 upholds the "
    "closure, 10 deletes it.\n\n"
    "What it prints goes to standard error. Programs that fail end with 1 or "
    "2, "
    "as a rule, which therefore decide nothing.";

// The exit codes of a command that has looked at a candidate and does not
// confirm it: none with which programs end that fail.
constexpr int kRejects = 10;
constexpr int kLeaves = 20;

// Returns the line of JSON that the command prints for an event.
std::string LineOf(const WatchedEvent& event) {
  const Json message =
      Json::parse(ToJson(event.message, false), nullptr, false);
  Json line;
  line["cursor"] = event.message.cursor();
  line["resynchronised"] = event.resynchronised;
  for (const char* const kind : {"candidate", "vehicleDeleted"}) {
    if (message.contains(kind)) line[kind] = message[kind];
  }
  return JsonText(line, false) + "\n";
}

// Works off the events of a watch.
class Worker {
 public:
  Worker(const Client& client, const WatchOptions& options,
         const Terminal& terminal)
      : client_(client), options_(options), terminal_(terminal) {}

  absl::Status WorkOff(const WatchedEvent& event) {
    const std::string line = LineOf(event);
    terminal_.out << line << std::flush;
    if (absl::Status told = CheckOutput(terminal_.out); !told.ok()) {
      return told;
    }
    if (options_.command.empty() || !event.message.has_candidate() ||
        event.message.candidate().candidate().state() !=
            v1::CANDIDATE_STATE_OPEN) {
      return absl::OkStatus();
    }
    return LetDecide(event.message.candidate(), line);
  }

  absl::Status Keep(const std::string& cursor) const {
    return options_.cursor_file.empty()
               ? absl::OkStatus()
               : WriteCursorFile(options_.cursor_file, cursor);
  }

  void Note(const std::string& text) const {
    terminal_.progress << text << '\n' << std::flush;
  }

  // From the thread of the signals.
  void Interrupt() { interrupted_ = true; }
  bool interrupted() const { return interrupted_; }

 private:
  absl::Status LetDecide(const v1::CandidateEvent& event,
                         const std::string& line) const {
    const auto end = RunShellCommand(options_.command, line);
    if (!end.ok()) return end.status();
    if (end->signal == 0 && end->exit_code == 0) {
      return Decided(
          ConfirmCandidate(client_, event.candidate(), event.evidence(), "")
              .status(),
          event);
    }
    if (end->signal == 0 && end->exit_code == kRejects) {
      return Decided(
          RejectCandidate(client_, event.candidate(), event.evidence(), "")
              .status(),
          event);
    }
    if (end->signal == 0 && end->exit_code == kLeaves) return absl::OkStatus();
    if (WasInterrupted()) return absl::CancelledError("interrupted");
    return LocalError(absl::AbortedError(
        absl::StrCat("the command of --exec ended with ", end->text(), " for ",
                     event.candidate().name())));
  }

  absl::Status Decided(const absl::Status& status,
                       const v1::CandidateEvent& event) const {
    if (!IsTooLate(status)) return status;
    Note(absl::StrCat("too late for ", Printable(event.candidate().name()),
                      ": ", Describe(status)));
    return absl::OkStatus();
  }

  // A terminal interrupts the command and this process at the same time, and
  // the command may be the first to end.
  bool WasInterrupted() const {
    constexpr std::chrono::milliseconds kStep{10};
    constexpr int kSteps = 30;
    for (int step = 0; step < kSteps && !interrupted_; ++step) {
      std::this_thread::sleep_for(kStep);
    }
    return interrupted_;
  }

  const Client& client_;
  const WatchOptions& options_;
  const Terminal& terminal_;
  std::atomic<bool> interrupted_{false};
};

absl::Status WithCursorHint(const absl::Status& status,
                            const std::string& cursor_file) {
  if (cursor_file.empty() || DetailsOf(status).reason != "INVALID_CURSOR") {
    return status;
  }
  return WithHint(status, absl::StrCat(Printable(cursor_file),
                                       " holds something else; without it, "
                                       "--from-start begins anew"));
}

}  // namespace

void AddWatchCommand(const Command& program) {
  const Command command = program.AddCommand(
      {"watch", "Tells what becomes of stored candidates, as it happens.",
       kDetails,
       "  revisit watch\n"
       "  revisit watch shuttle-7 --state open --cursor-file shuttle-7.cursor\n"
       "  revisit watch --from-start --cursor-file all.cursor --exec "
       "'./compare_scans'"});
  const auto options = std::make_shared<WatchOptions>();
  const auto vehicles = std::make_shared<std::vector<std::string>>();
  command.AddTexts("VEHICLE", "TEXT", vehicles.get(),
                   "Ids, or names; all vehicles if left out");
  command.AddText("--cursor-file", "FILE", &options->cursor_file,
                  "Keeps how far the events were worked off, from run to run");
  command.AddSwitch("--from-start", &options->from_start,
                    "With nothing in that file: begin with the open candidates "
                    "that there are already");
  AddCandidateFilter(command, &options->filter);
  command.AddText("--exec", "COMMAND", &options->command,
                  "Run by the shell for each open candidate, to decide");
  const Check check = [options]() -> std::string {
    const auto& states = options->filter.states();
    const bool has_open =
        states.empty() || std::find(states.begin(), states.end(),
                                    v1::CANDIDATE_STATE_OPEN) != states.end();
    return options->command.empty() || has_open
               ? ""
               : "--exec: decides about open candidates, which --state leaves "
                 "out";
  };
  command.Runs(
      [options, vehicles](const Connection& server, const Terminal& terminal) {
        for (const std::string& vehicle : *vehicles) {
          options->filter.add_vehicles(VehicleName(vehicle));
        }
        return RunWatch(server.channel, server.client, *options, terminal);
      },
      check);
}

absl::Status RunWatch(const std::shared_ptr<grpc::Channel>& channel,
                      const Client& client, const WatchOptions& options,
                      const Terminal& terminal) {
  CandidateWatchOptions watching;
  watching.filter = options.filter;
  watching.begin_with_list = options.from_start;
  watching.backoff = options.backoff;
  if (!options.cursor_file.empty()) {
    auto cursor = ReadCursorFile(options.cursor_file);
    if (!cursor.ok()) return cursor.status();
    watching.cursor = *std::move(cursor);
  }
  Worker worker(client, options, terminal);
  CandidateWatchCallbacks callbacks;
  callbacks.event = [&](const WatchedEvent& event) {
    return worker.WorkOff(event);
  };
  callbacks.moved = [&](const std::string& cursor) {
    return worker.Keep(cursor);
  };
  callbacks.resynchronised = [&](const absl::Status& why) {
    worker.Note("events are lost, listing what there is: " + Describe(why));
  };
  callbacks.disconnected = [&](const absl::Status& why,
                               std::chrono::nanoseconds wait) {
    worker.Note(
        absl::StrCat("connection lost, trying again in ",
                     Fixed(std::chrono::duration<double>(wait).count(), 1),
                     " s: ", Describe(why)));
  };
  CandidateWatch watch(channel, watching, callbacks);
  const InterruptGuard guard(
      [&] {
        worker.Interrupt();
        watch.Cancel();
      },
      InterruptGuard::After::kGoOn);
  const absl::Status status = watch.Run();
  if (absl::IsCancelled(status) && worker.interrupted()) {
    return absl::OkStatus();
  }
  return WithCursorHint(status, options.cursor_file);
}

absl::StatusOr<std::string> ReadCursorFile(const std::string& path) {
  std::error_code error;
  if (!fs::exists(path, error) && !error) return std::string();
  std::ifstream file(path, std::ios::binary);
  const std::string text{std::istreambuf_iterator<char>(file),
                         std::istreambuf_iterator<char>()};
  if (!file.is_open() || file.bad()) return FileError(path, errno);
  return std::string(absl::StripAsciiWhitespace(text));
}

absl::Status WriteCursorFile(const std::string& path,
                             const std::string& cursor) {
  std::error_code error;
  const fs::path file = fs::weakly_canonical(path, error);
  if (error) {
    return LocalError(
        absl::UnknownError(absl::StrCat(path, ": ", error.message())));
  }
  return ReplaceFile(file.string(), cursor + "\n");
}

}  // namespace revisit::client
