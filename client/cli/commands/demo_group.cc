#include "client/cli/commands/demo_group.h"

#include <cstddef>
#include <filesystem>
#include <set>
#include <vector>

#include "absl/status/status.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "client/answers/names.h"
#include "client/evaluation/drawings.h"
#include "client/evaluation/evaluation_report.h"
#include "client/evaluation/group_evaluation.h"
#include "client/evaluation/simulation.h"
#include "client/map/server_map.h"
#include "client/revisit/channel.h"
#include "client/revisit/client.h"
#include "grpcpp/channel.h"

namespace revisit::client {
namespace {

constexpr char kKnown[] = "demo-day-1";

constexpr char kTwoVehicles[] =
    "\nThe two days once more, as two vehicles of one group: day 2 counts from "
    "its own\nfirst pose, as another odometry does, and looks for its places "
    "in day 1 alone.\n";

// The sample before which the drive pauses for longest.
std::size_t LongestPause(const Drive& drive) {
  std::size_t behind = 0;
  double longest = 0.0;
  for (std::size_t i = 1; i < drive.samples.size(); ++i) {
    const double pause =
        SecondsOf(drive.samples[i]) - SecondsOf(drive.samples[i - 1]);
    if (pause <= longest) continue;
    longest = pause;
    behind = i;
  }
  return behind;
}

// These samples, counted from the first of them.
Drive PartOf(const Drive& drive, std::size_t begin, std::size_t end,
             const std::string& name) {
  Drive part;
  part.name = name;
  for (std::size_t i = begin; i < end; ++i) {
    part.samples.push_back(drive.samples[i]);
    part.samples.back().estimate =
        Between(drive.samples[begin].estimate, drive.samples[i].estimate);
    part.truth.push_back(drive.truth[i]);
  }
  return part;
}

// How the frames were tied for the candidates that came first.
std::string FramesText(const std::vector<JudgedCheck>& checks) {
  std::set<std::string> states;
  for (const JudgedCheck& check : checks) {
    if (check.answer.candidates.empty()) continue;
    states.insert(NameOf(check.answer.candidates[0].frame_state));
  }
  return states.empty() ? "-" : absl::StrJoin(states, ", ");
}

void AddRow(const std::string& name, const std::vector<JudgedCheck>& checks,
            Table* table) {
  const Tally tally = Count(checks);
  table->AddRow({name, absl::StrCat(tally.checks),
                 absl::StrCat(tally.true_loops), absl::StrCat(tally.accepted),
                 absl::StrCat(tally.accepted_correct),
                 FigureText(tally.precision(), 3),
                 FigureText(tally.recall(), 3), FramesText(checks)});
}

void Print(const GroupResult& result, const Terminal& terminal) {
  terminal.out << kTwoVehicles;
  if (result.linked_after_meters.has_value()) {
    terminal.out << "After " << Fixed(*result.linked_after_meters, 0)
                 << " m its first accepted candidate that is right became a "
                    "loop closure\nbetween them. The checks behind it, before "
                    "and after that:\n\n";
  } else {
    terminal.out << "None of its accepted candidates is right:\n\n";
  }
  using Align = Table::Align;
  Table table({{"", Align::kLeft},
               {"CHECKS", Align::kRight},
               {"LOOPS", Align::kRight},
               {"ACCEPTED", Align::kRight},
               {"RIGHT", Align::kRight},
               {"PRECISION", Align::kRight},
               {"RECALL", Align::kRight},
               {"FRAME", Align::kLeft}});
  AddRow("before", result.before, &table);
  if (result.linked_after_meters.has_value()) {
    AddRow("after", result.after, &table);
  }
  table.Print(terminal.out, terminal.width);
}

// "demo.svg" becomes "demo-group.svg".
std::string MapBeside(const std::string& map) {
  std::filesystem::path path(map);
  path.replace_filename(
      absl::StrCat(path.stem().string(), "-group", path.extension().string()));
  return path.string();
}

// Both days in the frame of the second, with what that finds in the first.
absl::Status DrawBoth(const Client& client, const std::string& file,
                      const Terminal& terminal) {
  CheckSearches searches;
  searches.options.mutable_scope()->set_group(GroupName(kDemoGroup));
  searches.options.mutable_scope()->set_exclude_own(true);
  auto map = ReadGroupMap(client, VehicleName(kDemoAsking),
                          GroupName(kDemoGroup), terminal);
  if (!map.ok()) return map.status();
  if (absl::Status added = AddChecks(client, searches, terminal, &*map);
      !added.ok()) {
    return added;
  }
  return WriteMapFile(file, map->contents);
}

}  // namespace

absl::StatusOr<std::string> RunDemoGroup(const EvaluateOptions& options,
                                         const std::string& address,
                                         const Terminal& terminal) {
  const auto drive = ReadDriveFile(options.files[0], options.reader);
  if (!drive.ok()) return LocalError(drive.status());
  ChannelOptions server;
  server.address = address;
  const auto channel = MakeChannel(server);
  if (!channel.ok()) return LocalError(channel.status());
  GroupRun run;
  run.group_id = kDemoGroup;
  run.settings = options.settings;
  run.judging = options.judging;
  const Client client(*channel);
  const std::size_t second = LongestPause(*drive);
  const auto result =
      EvaluateGroup(*channel, client, PartOf(*drive, 0, second, kKnown),
                    PartOf(*drive, second, drive->samples.size(), kDemoAsking),
                    run, terminal);
  if (!result.ok()) return result.status();
  Print(*result, terminal);
  std::string file = MapBeside(options.map);
  if (absl::Status drawn = DrawBoth(client, file, terminal); !drawn.ok()) {
    return drawn;
  }
  return file;
}

}  // namespace revisit::client
