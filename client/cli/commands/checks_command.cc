#include "client/cli/commands/checks_command.h"

#include <algorithm>
#include <iterator>
#include <memory>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "client/answers/candidate_text.h"
#include "client/answers/exact_text.h"
#include "client/answers/names.h"
#include "client/answers/pages.h"
#include "client/cli/commands/shared_flags.h"
#include "client/revisit/candidate_watch.h"
#include "client/revisit/printable_text.h"

namespace revisit::client {
namespace {

constexpr char kEveryVehicle[] = "-";

constexpr v1::CandidateState kStates[] = {
    v1::CANDIDATE_STATE_OPEN, v1::CANDIDATE_STATE_CONFIRMED,
    v1::CANDIDATE_STATE_REJECTED, v1::CANDIDATE_STATE_WITHDRAWN};

// Returns the part of a name after its last slash.
std::string LastPart(const std::string& name) {
  return name.substr(name.rfind('/') + 1);
}

// All checks of all pages in one response.
absl::StatusOr<v1::ListChecksResponse> ListAllChecks(
    const Client& client, const ChecksOptions& options) {
  constexpr int kPageChecks = 1000;
  v1::ListChecksRequest request;
  request.set_parent(VehicleName(options.vehicle));
  request.set_page_size(kPageChecks);
  *request.mutable_filter() = options.filter;
  v1::ListChecksResponse all;
  const absl::Status visited = VisitPages(
      request,
      [&](const v1::ListChecksRequest& asked) {
        return client.ListChecks(asked);
      },
      [](const v1::ListChecksResponse& page) -> const auto& {
        return page.checks();
      },
      [&](const v1::ListChecksResponse& page) -> absl::StatusOr<bool> {
        all.mutable_checks()->MergeFrom(page.checks());
        if (all.watch_cursor().empty()) {
          all.set_watch_cursor(page.watch_cursor());
        }
        return true;
      });
  if (!visited.ok()) return visited;
  return all;
}

// The best of the candidates that the filter lets through: they are kept in the
// order of rank. Null if there is none.
const v1::Candidate* BestOf(const v1::CandidateFilter& filter,
                            const v1::Check& check) {
  for (const v1::CheckCandidate& candidate : check.states()) {
    if (Matches(filter, check, candidate)) return EvidenceOf(check, candidate);
  }
  return nullptr;
}

void PrintChecks(const v1::ListChecksResponse& all,
                 const ChecksOptions& options, const Terminal& terminal) {
  using Align = Table::Align;
  const bool every_vehicle = options.vehicle == kEveryVehicle;
  std::vector<Table::Column> columns;
  if (every_vehicle) columns.push_back({"VEHICLE", Align::kLeft});
  columns.push_back({"SEQUENCE", Align::kRight});
  for (const v1::CandidateState state : kStates) {
    columns.push_back({NameOf(state), Align::kRight});
  }
  columns.insert(columns.end(), {{"MATCHED_SEQ", Align::kRight},
                                 {"PROBABILITY", Align::kRight},
                                 {"VERDICT", Align::kLeft},
                                 {"STORED", Align::kLeft}});
  Table table(columns);
  for (const v1::Check& check : all.checks()) {
    std::vector<std::string> row;
    if (every_vehicle) {
      row.push_back(check.name().substr(0, check.name().rfind("/checks/")));
    }
    row.push_back(LastPart(check.name()));
    for (const v1::CandidateState state : kStates) {
      row.push_back(absl::StrCat(
          std::count_if(check.states().begin(), check.states().end(),
                        [state](const v1::CheckCandidate& candidate) {
                          return candidate.state() == state;
                        })));
    }
    const v1::Candidate* const best = BestOf(options.filter, check);
    row.push_back(best == nullptr ? "-"
                                  : absl::StrCat(best->matched().sequence()));
    row.push_back(best == nullptr || !best->has_probability()
                      ? "-"
                      : Fixed(best->probability(), 4));
    row.push_back(best == nullptr ? "-" : NameOf(best->verdict()));
    row.push_back(StampText(check.create_time()));
    table.AddRow(std::move(row));
  }
  table.Print(terminal.out, terminal.width);
}

void PrintStates(const v1::Check& check, const Terminal& terminal) {
  using Align = Table::Align;
  Table table({{"CANDIDATE", Align::kRight},
               {"RANK", Align::kRight},
               {"STATE", Align::kLeft},
               {"CAUSE", Align::kLeft},
               {"SINCE", Align::kLeft},
               {"ACTOR", Align::kLeft},
               {"DECISION", Align::kLeft}});
  const auto or_dash = [](const std::string& text) {
    return text.empty() ? "-" : text;
  };
  for (const v1::CheckCandidate& candidate : check.states()) {
    table.AddRow({LastPart(candidate.name()), absl::StrCat(candidate.rank()),
                  NameOf(candidate.state()), NameOf(candidate.cause()),
                  StampText(candidate.update_time()),
                  or_dash(candidate.actor()), or_dash(candidate.decision())});
  }
  table.Print(terminal.out, terminal.width);
}

}  // namespace

void AddChecksCommand(const Command& program) {
  const Command command = program.AddCommand(
      {"checks", "Lists the stored checks of a vehicle, or shows one.",
       "Of vehicles whose checks are stored (vehicle create --checks stored): "
       "a check that found candidates worth keeping, how many of these are in "
       "each state, and the best one of those that the flags let through. - "
       "stands for all vehicles. --sequence shows one check with all that it "
       "found.",
       "  revisit checks shuttle-7\n"
       "  revisit checks - --state open --least-probability 0.5\n"
       "  revisit checks shuttle-7 --sequence 2068"});
  const auto options = std::make_shared<ChecksOptions>();
  const auto sequence = std::make_shared<std::uint64_t>(0);
  command
      .AddText("VEHICLE", "TEXT", &options->vehicle,
               "Id, or name; - for all vehicles")
      .Required();
  command.AddWholeNumber("--sequence", kSequences, sequence.get(),
                         "The one check that was due at this pose");
  AddCandidateFilter(command, &options->filter);
  const Check check = [=]() -> std::string {
    return *sequence != 0 && options->vehicle == kEveryVehicle
               ? "--sequence: names a check of one vehicle, not of all"
               : "";
  };
  command.AlsoPrints({OutputFormat::kWide, OutputFormat::kName});
  command.Runs(
      [=](const Connection& server, const Terminal& terminal) {
        return *sequence == 0 ? RunChecksList(server.client, *options, terminal)
                              : RunChecksGet(server.client, options->vehicle,
                                             *sequence, terminal);
      },
      check);
}

absl::Status RunChecksList(const Client& client, const ChecksOptions& options,
                           const Terminal& terminal) {
  const auto all = ListAllChecks(client, options);
  if (!all.ok()) return all.status();
  if (terminal.json()) {
    terminal.out << ToJson(*all, true) << '\n';
  } else if (terminal.names()) {
    for (const v1::Check& check : all->checks()) {
      terminal.out << Printable(check.name()) << '\n';
    }
  } else {
    PrintChecks(*all, options, terminal);
  }
  return absl::OkStatus();
}

absl::Status RunChecksGet(const Client& client, const std::string& vehicle,
                          std::uint64_t sequence, const Terminal& terminal) {
  v1::GetCheckRequest request;
  request.set_name(absl::StrCat(VehicleName(vehicle), "/checks/", sequence));
  const auto response = client.GetCheck(request);
  if (!response.ok()) return response.status();
  const v1::Check& check = response->check();
  if (terminal.json()) {
    terminal.out << ToJson(check, true) << '\n';
  } else if (terminal.names()) {
    for (const v1::CheckCandidate& candidate : check.states()) {
      terminal.out << Printable(candidate.name()) << '\n';
    }
  } else {
    PrintStates(check, terminal);
    PrintCandidates(check.candidates(), terminal);
  }
  return absl::OkStatus();
}

}  // namespace revisit::client
