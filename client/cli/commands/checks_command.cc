#include "client/cli/commands/checks_command.h"

#include <algorithm>
#include <iterator>
#include <memory>
#include <set>
#include <string>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "client/answers/candidate_text.h"
#include "client/answers/exact_text.h"
#include "client/answers/names.h"
#include "client/answers/pages.h"
#include "client/cli/commands/candidate_decisions.h"
#include "client/cli/commands/shared_flags.h"
#include "client/revisit/candidate_watch.h"
#include "client/revisit/printable_text.h"

namespace revisit::client {
namespace {

constexpr char kEveryVehicle[] = "-";
constexpr WholeRange kLooks = {0, 1000};

constexpr char kChecksDetails[] =
    "Of vehicles whose checks are stored (vehicle create --checks stored): "
    "a check that found candidates worth keeping, how many of these are in "
    "each state, and the best one of those that the flags let through. - "
    "stands for all vehicles. --sequence shows one check with all that it "
    "found: then, and now if it was searched again.\n\n"
    "--by value begins with what is worth a look most: VALUE is the "
    "probability of the candidate times the variance of the vehicle's "
    "positions that confirming it takes away. The one that is shown is then "
    "the most valuable one that is open.";

constexpr v1::CandidateState kStates[] = {
    v1::CANDIDATE_STATE_OPEN, v1::CANDIDATE_STATE_CONFIRMED,
    v1::CANDIDATE_STATE_REJECTED, v1::CANDIDATE_STATE_WITHDRAWN};

bool OrdersByValue(const ChecksOptions& options) {
  return options.order == v1::LIST_CHECKS_ORDER_BY_VALUE;
}

// All checks of all pages in one response.
absl::StatusOr<v1::ListChecksResponse> ListAllChecks(
    const Client& client, const ChecksOptions& options) {
  constexpr int kPageChecks = 1000;
  v1::ListChecksRequest request;
  request.set_parent(VehicleName(options.vehicle));
  request.set_page_size(kPageChecks);
  *request.mutable_filter() = options.filter;
  request.set_order(options.order);
  request.set_fresh_only(options.fresh_only);
  request.set_looks_per_kilometer(options.looks_per_kilometer);
  v1::ListChecksResponse all;
  std::set<std::string> listed;
  const absl::Status visited = VisitPages(
      request,
      [&](const v1::ListChecksRequest& asked) {
        return client.ListChecks(asked);
      },
      [](const v1::ListChecksResponse& page) -> const auto& {
        return page.checks();
      },
      [&](const v1::ListChecksResponse& page) -> absl::StatusOr<bool> {
        for (const v1::Check& check : page.checks()) {
          // One that moved over the edge of a page comes twice.
          if (listed.insert(check.name()).second) *all.add_checks() = check;
        }
        if (all.watch_cursor().empty()) {
          all.set_watch_cursor(page.watch_cursor());
        }
        return true;
      },
      OrdersByValue(options) ? PageOrder::kChanging : PageOrder::kByName);
  if (!visited.ok()) return visited;
  return all;
}

// The candidate that stands for its check: the best of those that the filter
// lets through, which are kept in the order of rank; by value, the most
// valuable one of these that is open, if there is one. Null if none is let
// through.
const v1::CheckCandidate* ShownOf(const ChecksOptions& options,
                                  const v1::Check& check) {
  const v1::CheckCandidate* best = nullptr;
  const v1::CheckCandidate* most_valuable = nullptr;
  for (const v1::CheckCandidate& candidate : check.states()) {
    if (!Matches(options.filter, check, candidate)) continue;
    if (best == nullptr) best = &candidate;
    if (candidate.state() == v1::CANDIDATE_STATE_OPEN &&
        (most_valuable == nullptr ||
         OrderingValue(candidate) > OrderingValue(*most_valuable))) {
      most_valuable = &candidate;
    }
  }
  return OrdersByValue(options) && most_valuable != nullptr ? most_valuable
                                                            : best;
}

template <typename Condition>
std::string CountOf(const v1::Check& check, const Condition& condition) {
  return absl::StrCat(
      std::count_if(check.states().begin(), check.states().end(), condition));
}

// Which columns a list of checks has.
struct ChecksColumns {
  ChecksColumns(const v1::ListChecksResponse& all, const ChecksOptions& options)
      : vehicle(options.vehicle == kEveryVehicle),
        looks(options.looks_per_kilometer > 0),
        stale(std::any_of(
            all.checks().begin(), all.checks().end(),
            [](const v1::Check& check) { return check.stale(); })) {}

  std::vector<Table::Column> Titles() const {
    using Align = Table::Align;
    std::vector<Table::Column> titles;
    if (vehicle) titles.push_back({"VEHICLE", Align::kLeft});
    titles.push_back({"SEQUENCE", Align::kRight});
    for (const v1::CandidateState state : kStates) {
      titles.push_back({NameOf(state), Align::kRight});
    }
    if (looks) titles.push_back({"LOOKS", Align::kRight});
    titles.insert(titles.end(), {{"MATCHED_SEQ", Align::kRight},
                                 {"PROBABILITY", Align::kRight},
                                 {"VALUE m2", Align::kRight},
                                 {"VERDICT", Align::kLeft}});
    if (stale) titles.push_back({"STALE", Align::kLeft});
    titles.push_back({"STORED", Align::kLeft});
    return titles;
  }

  const bool vehicle;
  // How many looks at each are recommended.
  const bool looks;
  // Only where one is.
  const bool stale;
};

// The matched pose, as `link add` takes it where it is of another vehicle.
std::string MatchText(const v1::Candidate& evidence) {
  const std::string sequence = absl::StrCat(evidence.matched().sequence());
  return evidence.matched_vehicle().empty()
             ? sequence
             : absl::StrCat(Printable(IdOf(evidence.matched_vehicle())), "@",
                            sequence);
}

std::vector<std::string> ChecksRow(const v1::Check& check,
                                   const ChecksColumns& columns,
                                   const ChecksOptions& options) {
  std::vector<std::string> row;
  if (columns.vehicle) {
    row.push_back(check.name().substr(0, check.name().rfind("/checks/")));
  }
  row.push_back(IdOf(check.name()));
  for (const v1::CandidateState state : kStates) {
    row.push_back(CountOf(check, [state](const v1::CheckCandidate& candidate) {
      return candidate.state() == state;
    }));
  }
  if (columns.looks) {
    row.push_back(CountOf(check, [](const v1::CheckCandidate& candidate) {
      return candidate.recommended();
    }));
  }
  const v1::CheckCandidate* const shown = ShownOf(options, check);
  const v1::Candidate* const evidence =
      shown == nullptr ? nullptr : EvidenceOf(check, *shown);
  row.push_back(evidence == nullptr ? "-" : MatchText(*evidence));
  row.push_back(evidence == nullptr || !evidence->has_probability()
                    ? "-"
                    : Fixed(evidence->probability(), 4));
  row.push_back(shown == nullptr ? "-" : ValueText(*shown));
  row.push_back(evidence == nullptr ? "-" : NameOf(evidence->verdict()));
  if (columns.stale) row.push_back(check.stale() ? "yes" : "-");
  row.push_back(StampText(check.create_time()));
  return row;
}

void PrintChecks(const v1::ListChecksResponse& all,
                 const ChecksOptions& options, const Terminal& terminal) {
  const ChecksColumns columns(all, options);
  Table table(columns.Titles());
  for (const v1::Check& check : all.checks()) {
    table.AddRow(ChecksRow(check, columns, options));
  }
  table.Print(terminal.out, terminal.width);
}

void PrintStates(const v1::Check& check, const Terminal& terminal) {
  using Align = Table::Align;
  std::vector<Table::Column> columns = {{"CANDIDATE", Align::kRight},
                                        {"RANK", Align::kRight}};
  if (check.has_latest()) columns.push_back({"RANK NOW", Align::kRight});
  columns.insert(columns.end(), {{"VALUE m2", Align::kRight},
                                 {"STATE", Align::kLeft},
                                 {"CAUSE", Align::kLeft},
                                 {"SINCE", Align::kLeft},
                                 {"ACTOR", Align::kLeft},
                                 {"DECISION", Align::kLeft}});
  Table table(std::move(columns));
  const auto or_dash = [](const std::string& text) {
    return text.empty() ? "-" : text;
  };
  const auto rank_or_dash = [](int rank) {
    return rank == 0 ? "-" : absl::StrCat(rank);
  };
  for (const v1::CheckCandidate& candidate : check.states()) {
    std::vector<std::string> row = {IdOf(candidate.name()),
                                    rank_or_dash(candidate.rank())};
    if (check.has_latest()) {
      row.push_back(rank_or_dash(candidate.latest_rank()));
    }
    row.insert(row.end(),
               {ValueText(candidate), NameOf(candidate.state()),
                NameOf(candidate.cause()), StampText(candidate.update_time()),
                or_dash(candidate.actor()), or_dash(candidate.decision())});
    table.AddRow(std::move(row));
  }
  table.Print(terminal.out, terminal.width);
}

// All that was found: then, and now where the check was searched again.
void PrintSearches(const v1::Check& check, const Terminal& terminal) {
  if (check.stale()) terminal.out << kStaleText << '\n';
  if (!check.has_latest()) {
    PrintCandidates(check.candidates(), terminal);
    return;
  }
  terminal.out << "told then, of revision " << check.candidates().revision()
               << ":\n";
  PrintCandidates(check.candidates(), terminal);
  terminal.out << "found now, of revision " << check.latest().revision()
               << ":\n";
  PrintCandidates(check.latest(), terminal);
}

// Finds fault with the flags taken together.
std::string CheckFlags(const ChecksOptions& options, std::uint64_t sequence) {
  const bool every_vehicle = options.vehicle == kEveryVehicle;
  if (sequence != 0 && every_vehicle) {
    return "--sequence: names a check of one vehicle, not of all";
  }
  if (OrdersByValue(options) && every_vehicle) {
    return "--by: got value for all vehicles; allowed is time, or value of one "
           "vehicle";
  }
  if (options.looks_per_kilometer > 0 && !OrdersByValue(options)) {
    return absl::StrCat("--looks-per-kilometer: got ",
                        options.looks_per_kilometer,
                        " without --by value; allowed is 0, or --by value");
  }
  return "";
}

}  // namespace

void AddChecksCommand(const Command& program) {
  const Command command = program.AddCommand(
      {"checks", "Lists the stored checks of a vehicle, or shows one.",
       kChecksDetails,
       "  revisit checks shuttle-7\n"
       "  revisit checks - --state open --least-probability 0.5\n"
       "  revisit checks shuttle-7 --state open --by value "
       "--looks-per-kilometer 2\n"
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
  command.AddChoice("--by",
                    {{"time", v1::LIST_CHECKS_ORDER_BY_TIME},
                     {"value", v1::LIST_CHECKS_ORDER_BY_VALUE}},
                    &options->order,
                    "By vehicle and sequence (time), or the most valuable "
                    "first (value; of one vehicle)");
  command.AddSwitch("--fresh-only", &options->fresh_only,
                    "Leave out checks that wait to be searched again");
  command.AddWholeNumber(
      "--looks-per-kilometer", kLooks, &options->looks_per_kilometer,
      "With --by value: mark so many looks of each kilometre travelled, the "
      "most valuable");
  const Check check = [=] { return CheckFlags(*options, *sequence); };
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
    PrintSearches(check, terminal);
  }
  return absl::OkStatus();
}

}  // namespace revisit::client
