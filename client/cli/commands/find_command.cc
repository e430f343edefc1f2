#include "client/cli/commands/find_command.h"

#include "client/cli/names.h"

namespace revisit::client {

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
        {std::to_string(candidate.rank()), std::to_string(matched.sequence()),
         Fixed(matched.travelled_meters(), 1),
         Fixed(matched.pose().x_meters(), 2),
         Fixed(matched.pose().y_meters(), 2), NameOf(candidate.direction()),
         Fixed(candidate.score(), 2),
         Fixed(gate.squared_mahalanobis_distance(), 3),
         Fixed(gate.threshold(), 3), Fixed(gate.p_value(), 4),
         candidate.has_probability() ? Fixed(candidate.probability(), 4) : "-",
         NameOf(candidate.verdict())});
  }
  table.Print(console.out);
  const double inflation = set.candidates(0).gate().inflation();
  if (inflation > 1.0) {
    console.out << "claimed standard deviations were multiplied by "
                << Fixed(inflation, 2) << '\n';
  }
  return absl::OkStatus();
}

}  // namespace revisit::client
