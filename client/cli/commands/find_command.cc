#include "client/cli/commands/find_command.h"

#include <cstdint>
#include <memory>

#include "absl/strings/str_cat.h"
#include "client/cli/commands/shared_flags.h"
#include "client/cli/commands/vehicle_settings.h"
#include "client/cli/names.h"

namespace revisit::client {

void AddFindCommand(const Command& program) {
  const Command command = program.AddCommand(
      {"find", "Asks for loop-closure candidates at one pose.", "",
       "  revisit find shuttle-7\n"
       "  revisit find shuttle-7 --sequence 2000 --max-candidates 10 --json\n"
       "  revisit find shuttle-7 --direction either "
       "--acceptance-probability 0.9"});
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
  command.AddChoice(
      "--direction", WordsOf(v1::Direction_descriptor()),
      [options](int direction) {
        options->set_direction(static_cast<v1::Direction>(direction));
      },
      "Which way the place was passed before, against the way it is passed now "
      "(same)");
  AddSearchSettings(command, options);
  command.Runs([request](const Connection& server, const Console& console) {
    return RunFind(server.client, *request, console);
  });
}

absl::Status RunFind(const Client& client, v1::FindCandidatesRequest request,
                     const Console& console) {
  request.set_vehicle(VehicleName(request.vehicle()));
  const auto response = client.FindCandidates(request);
  if (!response.ok()) return response.status();
  const v1::CandidateSet& set = response->candidates();
  if (console.json) {
    console.out << ToJson(set, true) << '\n';
    return absl::OkStatus();
  }
  if (set.has_query()) {
    const v1::Node& query = set.query();
    console.out << "query: node " << query.index() << ", sequence "
                << query.sequence() << ", "
                << Fixed(query.travelled_meters(), 1) << " m travelled, at ("
                << Fixed(query.pose().x_meters(), 2) << ", "
                << Fixed(query.pose().y_meters(), 2) << ") m\n";
  }
  if (set.has_new_place_probability()) {
    console.out << "new place: probability "
                << Fixed(set.new_place_probability(), 4) << '\n';
  }
  if (set.candidates().empty()) {
    console.out << "no candidates: " << Explain(set.empty_reason()) << '\n';
    return absl::OkStatus();
  }
  using Align = Table::Align;
  Table table({{"RANK", Align::kRight},
               {"SEQUENCE", Align::kRight},
               {"TRAVELLED m", Align::kRight},
               {"X m", Align::kRight},
               {"Y m", Align::kRight},
               {"DIRECTION", Align::kLeft},
               {"SCORE", Align::kRight},
               {"D2", Align::kRight},
               {"THRESHOLD", Align::kRight},
               {"P-VALUE", Align::kRight},
               {"PROBABILITY", Align::kRight},
               {"VERDICT", Align::kLeft}});
  for (const v1::Candidate& candidate : set.candidates()) {
    const v1::Node& matched = candidate.matched();
    const v1::Gate& gate = candidate.gate();
    table.AddRow(
        {absl::StrCat(candidate.rank()), absl::StrCat(matched.sequence()),
         Fixed(matched.travelled_meters(), 1),
         Fixed(matched.pose().x_meters(), 2),
         Fixed(matched.pose().y_meters(), 2), NameOf(candidate.direction()),
         Fixed(candidate.score(), 2),
         Fixed(gate.squared_mahalanobis_distance(), 3),
         Fixed(gate.threshold(), 3), Fixed(gate.p_value(), 4),
         candidate.has_probability() ? Fixed(candidate.probability(), 4) : "-",
         NameOf(candidate.verdict())});
  }
  table.Print(console.out, console.width);
  const double inflation = set.candidates(0).gate().inflation();
  if (inflation > 1.0) {
    console.out << "claimed standard deviations were multiplied by "
                << Fixed(inflation, 2) << '\n';
  }
  return absl::OkStatus();
}

}  // namespace revisit::client
