#include "client/cli/commands/findings_command.h"

#include <charconv>
#include <cstdint>
#include <memory>
#include <optional>
#include <utility>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "absl/strings/str_replace.h"
#include "client/answers/deviation_text.h"
#include "client/answers/exact_text.h"
#include "client/answers/names.h"
#include "client/answers/pages.h"
#include "client/cli/commands/printed_change.h"
#include "client/revisit/printable_text.h"
#include "google/protobuf/util/time_util.h"

namespace revisit::client {
namespace {

// Loop closures and rejections differ in names only.
struct Closures {
  using List = v1::ListLoopClosuresResponse;
  using ListRequest = v1::ListLoopClosuresRequest;
  using DeleteRequest = v1::DeleteLoopClosureRequest;

  static std::vector<OutputFormat> Formats() {
    return {OutputFormat::kWide, OutputFormat::kName};
  }
  static constexpr char kCommand[] = "closures";
  static constexpr char kNoun[] = "loop closure";
  static constexpr char kCollection[] = "/loopClosures/";

  static auto Page(const Client& client, const ListRequest& request) {
    return client.ListLoopClosures(request);
  }
  static const auto& Items(const List& list) { return list.loop_closures(); }
  static auto* MutableItems(List* list) {
    return list->mutable_loop_closures();
  }
  static auto Delete(const Client& client, const DeleteRequest& request) {
    return client.DeleteLoopClosure(request);
  }
};

struct Rejections {
  using List = v1::ListRejectedCandidatesResponse;
  using ListRequest = v1::ListRejectedCandidatesRequest;
  using DeleteRequest = v1::DeleteRejectedCandidateRequest;

  // A rejection has no more columns.
  static std::vector<OutputFormat> Formats() { return {OutputFormat::kName}; }
  static constexpr char kCommand[] = "rejections";
  static constexpr char kNoun[] = "rejection";
  static constexpr char kCollection[] = "/rejectedCandidates/";

  static auto Page(const Client& client, const ListRequest& request) {
    return client.ListRejectedCandidates(request);
  }
  static const auto& Items(const List& list) {
    return list.rejected_candidates();
  }
  static auto* MutableItems(List* list) {
    return list->mutable_rejected_candidates();
  }
  static auto Delete(const Client& client, const DeleteRequest& request) {
    return client.DeleteRejectedCandidate(request);
  }
};

template <typename Kind>
absl::StatusOr<typename Kind::List> ListAll(const Client& client,
                                            const std::string& vehicle) {
  using List = typename Kind::List;
  using ListRequest = typename Kind::ListRequest;
  List all;
  ListRequest request;
  request.set_parent(VehicleName(vehicle));
  request.set_page_size(1000);
  const absl::Status status = VisitPages(
      request,
      [&](const ListRequest& asked) { return Kind::Page(client, asked); },
      [](const List& page) -> const auto& { return Kind::Items(page); },
      [&](const List& page) -> absl::StatusOr<bool> {
        Kind::MutableItems(&all)->MergeFrom(Kind::Items(page));
        return true;
      });
  if (!status.ok()) return status;
  return all;
}

// The columns that only -o wide shows: what the verifier measured.
std::vector<Table::Column> WideColumns() {
  using Align = Table::Align;
  return {{"SCORE", Align::kRight},         {"AHEAD m", Align::kRight},
          {"LEFT m", Align::kRight},        {"UP m", Align::kRight},
          {"HEADING rad", Align::kRight},   {"SD AHEAD m", Align::kRight},
          {"SD LEFT m", Align::kRight},     {"SD UP m", Align::kRight},
          {"SD HEADING rad", Align::kRight}};
}

std::vector<std::string> WideCells(const v1::LoopClosure& closure) {
  std::vector<std::string> cells(9, "-");
  if (closure.has_score()) cells[0] = Exact(closure.score());
  if (!closure.has_measurement()) return cells;
  const v1::LoopClosureMeasurement& measured = closure.measurement();
  const auto [x, y, z, heading] = DeviationTexts(measured.covariance());
  return {cells[0],
          Fixed(measured.x_meters(), 3),
          Fixed(measured.y_meters(), 3),
          Fixed(measured.z_meters(), 3),
          Fixed(measured.heading_radians(), 5),
          x,
          y,
          z,
          heading};
}
// A rejection has no such columns.
std::vector<std::string> WideCells(const v1::RejectedCandidate&) { return {}; }

template <typename Kind>
void PrintTable(const typename Kind::List& all, const Terminal& terminal) {
  using Align = Table::Align;
  std::vector<Table::Column> columns = {{"ID", Align::kLeft},
                                        {"QUERY_SEQ", Align::kRight},
                                        {"MATCHED_SEQ", Align::kRight},
                                        {"CREATED", Align::kLeft}};
  if (terminal.wide()) {
    for (Table::Column& column : WideColumns()) {
      columns.push_back(std::move(column));
    }
  }
  columns.push_back({"DECIDED_BY", Align::kLeft});
  // Last, since it is as long as whoever wrote it wanted.
  columns.push_back({"NOTE", Align::kLeft});
  Table table(std::move(columns));
  for (const auto& item : Kind::Items(all)) {
    std::vector<std::string> row = {
        IdOf(item.name()), absl::StrCat(item.query_sequence()),
        absl::StrCat(item.matched_sequence()),
        google::protobuf::util::TimeUtil::ToString(item.create_time())};
    if (terminal.wide()) {
      for (std::string& cell : WideCells(item)) row.push_back(std::move(cell));
    }
    row.push_back(item.decided_by().empty() ? "-" : item.decided_by());
    row.push_back(absl::StrReplaceAll(item.note(), {{"\n", " "}, {"\t", " "}}));
    table.AddRow(std::move(row));
  }
  table.Print(terminal.out, terminal.width);
}

template <typename Kind>
absl::Status RunList(const Client& client, const std::string& vehicle,
                     const Terminal& terminal) {
  const auto all = ListAll<Kind>(client, vehicle);
  if (!all.ok()) return all.status();
  if (terminal.json()) {
    terminal.out << ToJson(*all, true) << '\n';
    return absl::OkStatus();
  }
  if (terminal.names()) {
    PrintNames(Kind::Items(*all), terminal);
    return absl::OkStatus();
  }
  PrintTable<Kind>(*all, terminal);
  return absl::OkStatus();
}

std::optional<std::uint64_t> Sequence(const std::string& text) {
  std::int64_t value = 0;
  const char* const end = text.data() + text.size();
  const auto [stop, error] = std::from_chars(text.data(), end, value);
  if (error != std::errc() || stop != end || value < kSequences.lowest) {
    return std::nullopt;
  }
  return static_cast<std::uint64_t>(value);
}

// The names of those that have these sequences.
template <typename Kind>
absl::StatusOr<std::vector<std::string>> NamesOfPair(
    const Client& client, const FindingReference& finding) {
  const auto query = Sequence(finding.words[0]);
  const auto matched = Sequence(finding.words[1]);
  const auto all = ListAll<Kind>(client, finding.vehicle);
  if (!all.ok()) return all.status();
  std::vector<std::string> names;
  for (const auto& item : Kind::Items(*all)) {
    if (item.query_sequence() == query && item.matched_sequence() == matched) {
      names.push_back(item.name());
    }
  }
  return names;
}

// The name of the only one that has these sequences.
template <typename Kind>
absl::StatusOr<std::string> NameOfPair(const Client& client,
                                       const FindingReference& finding) {
  const auto found = NamesOfPair<Kind>(client, finding);
  if (!found.ok()) return found.status();
  const std::vector<std::string>& names = *found;
  if (names.size() == 1) return names.front();
  const std::string pair =
      absl::StrCat(Kind::kNoun, names.empty() ? "" : "s", " of the poses ",
                   finding.words[0], " and ", finding.words[1]);
  if (names.empty()) {
    return WithHint(
        absl::NotFoundError(
            absl::StrCat(VehicleName(finding.vehicle), " has no ", pair)),
        absl::StrCat("revisit ", Kind::kCommand, " list ", finding.vehicle,
                     " shows those that it has; the later pose comes first"));
  }
  return WithHint(
      absl::FailedPreconditionError(absl::StrCat(
          VehicleName(finding.vehicle), " has ", names.size(), " ", pair)),
      absl::StrCat("name one by its id: ",
                   Printable(absl::StrJoin(names, ", "))));
}

template <typename Kind>
absl::Status RunDelete(const Client& client, const FindingReference& finding,
                       const Terminal& terminal) {
  typename Kind::DeleteRequest request;
  const std::string& word = finding.words.front();
  if (finding.words.size() == 2) {
    auto name = NameOfPair<Kind>(client, finding);
    if (!name.ok()) return name.status();
    request.set_name(*std::move(name));
  } else if (word.find('/') != std::string::npos) {
    request.set_name(word);
  } else {
    request.set_name(
        absl::StrCat(VehicleName(finding.vehicle), Kind::kCollection, word));
  }
  const auto response = Kind::Delete(client, request);
  if (!response.ok()) return response.status();
  PrintRemoval("deleted", request.name(), *response, terminal);
  return absl::OkStatus();
}

// Finds fault with what stands behind the vehicle.
std::string CheckWords(const FindingReference& finding) {
  if (finding.words.size() == 1) {
    // A name says which vehicle it belongs to.
    const std::string& word = finding.words.front();
    const bool other = word.find('/') != std::string::npos &&
                       word.rfind(VehicleName(finding.vehicle) + "/", 0) != 0;
    return other ? absl::StrCat("got \"", word, "\", which does not belong to ",
                                VehicleName(finding.vehicle))
                 : "";
  }
  for (const std::string& word : finding.words) {
    if (finding.words.size() == 2 && Sequence(word).has_value()) continue;
    return absl::StrCat(
        "got \"", absl::StrJoin(finding.words, " "),
        "\"; allowed is an id, or the sequences of the later and the earlier "
        "pose");
  }
  return "";
}

struct Help {
  CommandHelp group;
  CommandHelp list;
  CommandHelp remove;
};

template <typename Kind>
void AddFindings(const Command& program, const Help& help) {
  const Command group = program.AddCommand(help.group);
  const Command list = group.AddCommand(help.list);
  const auto vehicle = std::make_shared<std::string>();
  list.AddText("VEHICLE", "TEXT", vehicle.get(), "Id, or name").Required();
  list.AlsoPrints(Kind::Formats());
  list.Runs([vehicle](const Connection& server, const Terminal& terminal) {
    return RunList<Kind>(server.client, *vehicle, terminal);
  });
  const Command remove = group.AddCommand(help.remove);
  const auto finding = std::make_shared<FindingReference>();
  remove.AddText("VEHICLE", "TEXT", &finding->vehicle, "Id, or name")
      .Required();
  remove
      .AddTexts("WHICH", "TEXT", &finding->words,
                "QUERY_SEQ and MATCHED_SEQ, its later and its earlier pose; or "
                "its id")
      .Required();
  const Run run = [finding](const Connection& server,
                            const Terminal& terminal) {
    return RunDelete<Kind>(server.client, *finding, terminal);
  };
  remove.AlsoPrints({OutputFormat::kName});
  remove.Runs(run, [finding] { return CheckWords(*finding); });
}

}  // namespace

void AddClosuresCommand(const Command& program) {
  AddFindings<Closures>(
      program,
      {{"closures", "Lists and deletes the confirmed loop closures.", "", ""},
       {"list", "Lists a vehicle's loop closures.", "",
        "  revisit closures list shuttle-7"},
       {"delete", "Deletes a loop closure: undoes a mistaken confirm.", "",
        "  revisit closures delete shuttle-7 2068 1072\n"
        "  revisit closures delete shuttle-7 2068-1072"}});
}

void AddRejectionsCommand(const Command& program) {
  AddFindings<Rejections>(
      program,
      {{"rejections", "Lists and deletes the rejected candidates.", "", ""},
       {"list", "Lists a vehicle's rejected candidates.", "",
        "  revisit rejections list shuttle-7"},
       {"delete",
        "Deletes a rejection, so that the candidate may be offered again.", "",
        "  revisit rejections delete shuttle-7 2068 1155\n"
        "  revisit rejections delete shuttle-7 2068-1155"}});
}

absl::Status RunClosuresList(const Client& client, const std::string& vehicle,
                             const Terminal& terminal) {
  return RunList<Closures>(client, vehicle, terminal);
}

absl::Status RunRejectionsList(const Client& client, const std::string& vehicle,
                               const Terminal& terminal) {
  return RunList<Rejections>(client, vehicle, terminal);
}

absl::Status RunClosuresDelete(const Client& client,
                               const FindingReference& finding,
                               const Terminal& terminal) {
  return RunDelete<Closures>(client, finding, terminal);
}

absl::Status RunRejectionsDelete(const Client& client,
                                 const FindingReference& finding,
                                 const Terminal& terminal) {
  return RunDelete<Rejections>(client, finding, terminal);
}

}  // namespace revisit::client
