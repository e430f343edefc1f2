#include "client/cli/commands/find_command.h"

#include <cstdint>
#include <memory>
#include <string>

#include "client/answers/candidate_text.h"
#include "client/answers/names.h"
#include "client/cli/commands/shared_flags.h"
#include "client/cli/commands/vehicle_settings.h"
#include "client/revisit/status.h"

namespace revisit::client {

void AddFindCommand(const Command& program) {
  const Command command = program.AddCommand(
      {"find", "Asks for loop-closure candidates at one pose.",
       "-o wide has every number of a candidate. -o name has a pair of "
       "sequences for each, asked-matched, as closures are named; and for one "
       "of another vehicle the two words that revisit link add takes.",
       "  revisit find shuttle-7\n"
       "  revisit find shuttle-7 --sequence 2000 --max-candidates 10 --json\n"
       "  revisit find shuttle-7 --direction either "
       "--acceptance-probability 0.9\n"
       "  revisit find shuttle-7 -o wide\n"
       "  revisit find shuttle-8 --group depot\n"
       "  revisit find shuttle-8 --group depot --in shuttle-7 --exclude-own"});
  const auto request = std::make_shared<v1::FindCandidatesRequest>();
  v1::CandidateOptions* const options = request->mutable_options();
  AddVehicleName(command, request->mutable_vehicle());
  command.AddWholeNumber(
      "--sequence", kSequences,
      [request](std::int64_t sequence) {
        request->set_sequence(static_cast<std::uint64_t>(sequence));
      },
      "Pose to ask at, with what lay before it as history; the newest if left "
      "out");
  command.AddSwitch(
      "--aligned-path",
      [options](bool include) { options->set_include_aligned_path(include); },
      "Let the JSON have the aligned pairs");
  command.AddSwitch(
      "--exhaustive",
      [options](bool exhaustive) { options->set_exhaustive(exhaustive); },
      "Look at all of history, and answer also what is too improbable to be "
      "accepted");
  AddScope(command, options);
  AddDirection(command, options);
  AddSearchSettings(command, options);
  command.AlsoPrints({OutputFormat::kWide, OutputFormat::kName});
  command.Runs([request](const Connection& server, const Terminal& terminal) {
    return RunFind(server.client, *request, terminal);
  });
}

absl::Status RunFind(const Client& client, v1::FindCandidatesRequest request,
                     const Terminal& terminal) {
  request.set_vehicle(VehicleName(request.vehicle()));
  const auto response = client.FindCandidates(request);
  if (!response.ok()) return WithPartialHint(response.status());
  const v1::CandidateSet& set = response->candidates();
  if (terminal.json()) {
    terminal.out << ToJson(set, true) << '\n';
    return absl::OkStatus();
  }
  if (terminal.names()) {
    PrintPairs(request.vehicle(), set, terminal.out);
    return absl::OkStatus();
  }
  PrintCandidates(set, terminal);
  return absl::OkStatus();
}

}  // namespace revisit::client
