#include "client/answers/candidate_text.h"

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <iterator>
#include <map>
#include <utility>
#include <vector>

#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "client/answers/deviation_text.h"
#include "client/answers/exact_text.h"
#include "client/answers/names.h"
#include "client/revisit/printable_text.h"
#include "client/terminal/terminal.h"

namespace revisit::client {
namespace {

using C = v1::Candidate;

// ", 2020-11-26T18:58:17.528Z (1606417097.528 s)", empty without a stamp.
std::string TimeOf(const v1::Node& node) {
  if (!node.has_stamp()) return "";
  return absl::StrCat(", ", StampText(node.stamp()), " (",
                      StampSeconds(node.stamp()), " s)");
}

// Whether the match may be in another recording than the query.
bool TellsOfFrames(const C& c) {
  return c.frame_state() != v1::FRAME_STATE_UNSPECIFIED &&
         c.frame_state() != v1::FRAME_STATE_SAME;
}

bool IsOfAnotherVehicle(const C& c) { return !c.matched_vehicle().empty(); }

// By what the search multiplied the claims.
void PrintScale(const v1::CandidateSet& set, std::ostream& out) {
  if (set.has_scale_estimate()) {
    const v1::ScaleEstimate& estimate = set.scale_estimate();
    out << "the drive has shown standard deviations of "
        << Fixed(estimate.scale(), 2) << " times the claimed ones ("
        << Fixed(estimate.low(), 2) << " to " << Fixed(estimate.high(), 2)
        << ")\n";
    return;
  }
  if (set.candidates().empty()) return;
  const double inflation = set.candidates(0).gate().inflation();
  if (inflation > 1.0) {
    out << "claimed standard deviations were multiplied by "
        << Fixed(inflation, 2) << '\n';
  }
}

void PrintQuery(const v1::CandidateSet& set, std::ostream& out) {
  if (set.has_query()) {
    const v1::Node& query = set.query();
    out << "query: node " << query.index() << ", sequence " << query.sequence()
        << TimeOf(query) << ", " << Fixed(query.travelled_meters(), 1)
        << " m travelled, at (" << Fixed(query.pose().x_meters(), 2) << ", "
        << Fixed(query.pose().y_meters(), 2) << ") m\n";
  }
  if (set.has_new_place_probability()) {
    out << "new place: probability " << Fixed(set.new_place_probability(), 4)
        << '\n';
  }
}

double SecondsOf(const google::protobuf::Duration& duration) {
  return static_cast<double>(duration.seconds()) + 1e-9 * duration.nanos();
}

void PrintSearched(const v1::CandidateSet& set, const Terminal& terminal) {
  using Align = Table::Align;
  Table table({{"SEARCHED", Align::kLeft},
               {"NODES", Align::kRight},
               {"LAST SEQUENCE", Align::kRight},
               {"LAG s", Align::kRight}});
  for (const v1::SearchedVehicle& one : set.searched()) {
    table.AddRow({one.vehicle(), absl::StrCat(one.node_count()),
                  absl::StrCat(one.last_sequence()),
                  Fixed(SecondsOf(one.lag()), 1)});
  }
  table.Print(terminal.out, terminal.width);
}

// In which other vehicles a search in a group has looked, and in which it has
// not.
void PrintScope(const v1::CandidateSet& set, const Terminal& terminal) {
  // Every group has a revision.
  if (set.group_revision() == 0) return;
  std::int64_t nodes = 0;
  double lag = 0.0;
  for (const v1::SearchedVehicle& one : set.searched()) {
    nodes += one.node_count();
    lag = std::max(lag, SecondsOf(one.lag()));
  }
  const int count = set.searched_size();
  terminal.out << "searched " << count
               << (count == 1 ? " other vehicle" : " other vehicles");
  if (count > 0) {
    terminal.out << " with " << nodes << " nodes, as they were up to "
                 << Fixed(lag, 1) << " s ago";
  }
  terminal.out << "; revision " << set.group_revision() << " of the group\n";
  if (terminal.wide() && count > 0) PrintSearched(set, terminal);
  PrintUnsearched(set, terminal.out);
}

// Each column with its cells.
class Columns {
 public:
  explicit Columns(const v1::CandidateSet& set) : set_(set) {}

  template <typename Cell>
  void Add(const char* title, Table::Align align, const Cell& cell) {
    titles_.push_back({title, align});
    cells_.emplace_back();
    for (const v1::Candidate& candidate : set_.candidates()) {
      cells_.back().push_back(cell(candidate));
    }
  }

  void Print(const Terminal& terminal) const {
    Table table(titles_);
    for (int row = 0; row < set_.candidates_size(); ++row) {
      std::vector<std::string> line;
      for (const auto& column : cells_) {
        line.push_back(column[static_cast<std::size_t>(row)]);
      }
      table.AddRow(std::move(line));
    }
    table.Print(terminal.out, terminal.width);
  }

 private:
  const v1::CandidateSet& set_;
  std::vector<Table::Column> titles_;
  std::vector<std::vector<std::string>> cells_;
};

void AddPlaceColumns(const v1::CandidateSet& set, Columns* columns) {
  using Align = Table::Align;
  columns->Add("RANK", Align::kRight,
               [](const C& c) { return absl::StrCat(c.rank()); });
  if (std::any_of(set.candidates().begin(), set.candidates().end(),
                  IsOfAnotherVehicle)) {
    columns->Add("VEHICLE", Align::kLeft, [](const C& c) {
      return IsOfAnotherVehicle(c) ? c.matched_vehicle() : "itself";
    });
  }
  columns->Add("SEQUENCE", Align::kRight,
               [](const C& c) { return absl::StrCat(c.matched().sequence()); });
  if (std::any_of(set.candidates().begin(), set.candidates().end(),
                  [](const C& c) { return c.matched().has_stamp(); })) {
    const auto stamp =
        [](std::string (*text)(const google::protobuf::Timestamp&)) {
          return [text](const C& c) {
            return c.matched().has_stamp() ? text(c.matched().stamp()) : "-";
          };
        };
    columns->Add("TIME", Align::kLeft, stamp(&StampText));
    columns->Add("TIME s", Align::kRight, stamp(&StampSeconds));
  }
  columns->Add("TRAVELLED m", Align::kRight, [](const C& c) {
    return Fixed(c.matched().travelled_meters(), 1);
  });
  columns->Add("X m", Align::kRight, [](const C& c) {
    return Fixed(c.matched().pose().x_meters(), 2);
  });
  columns->Add("Y m", Align::kRight, [](const C& c) {
    return Fixed(c.matched().pose().y_meters(), 2);
  });
  columns->Add("DIRECTION", Align::kLeft,
               [](const C& c) { return NameOf(c.direction()); });
  if (std::any_of(set.candidates().begin(), set.candidates().end(),
                  TellsOfFrames)) {
    columns->Add("RECORDING", Align::kRight,
                 [](const C& c) { return absl::StrCat(RecordingOfMatch(c)); });
    columns->Add("FRAME", Align::kLeft,
                 [](const C& c) { return NameOf(c.frame_state()); });
  }
}

void AddJudgementColumns(Columns* columns) {
  using Align = Table::Align;
  columns->Add("GATE", Align::kLeft,
               [](const C& c) { return DecidingGateOf(c).name(); });
  const auto number = [](double DecidingGate::*value, int digits) {
    return [value, digits](const C& c) {
      const DecidingGate gate = DecidingGateOf(c);
      return gate.has_distance() ? Fixed(gate.*value, digits) : "-";
    };
  };
  columns->Add("D2", Align::kRight, number(&DecidingGate::squared_distance, 3));
  columns->Add("THRESHOLD", Align::kRight, [](const C& c) {
    const DecidingGate gate = DecidingGateOf(c);
    return gate.known ? Fixed(gate.threshold, 3) : "-";
  });
  columns->Add("P-VALUE", Align::kRight, number(&DecidingGate::p_value, 4));
  columns->Add("PROBABILITY", Align::kRight, [](const C& c) {
    return c.has_probability() ? Fixed(c.probability(), 4) : "-";
  });
  columns->Add("ALONG m", Align::kRight, [](const C& c) {
    return c.has_place_interval() ? IntervalText(c.place_interval()) : "-";
  });
  columns->Add("VERDICT", Align::kLeft,
               [](const C& c) { return NameOf(c.verdict()); });
}

// A number of a candidate beyond the gate that decided.
struct WideColumn {
  const char* title;
  int digits;
  // Whether a candidate has the number.
  bool (*has)(const C&);
  double (*number)(const C&);
};

bool Always(const C&) { return true; }
bool HasOdds(const C& c) { return c.has_odds_to_runner_up(); }
bool HasPath(const C& c) { return c.has_path_gate(); }
bool HasShape(const C& c) { return c.has_shape(); }
bool HasDifference(const C& c) { return c.has_difference(); }
bool HasGate(const C& c) { return c.has_gate(); }

constexpr WideColumn kSearchColumns[] = {
    {"SCORE", 4, &Always, [](const C& c) { return c.score(); }},
    {"ODDS", 2, &HasOdds, [](const C& c) { return c.odds_to_runner_up(); }},
    {"HEADING rad", 4, &Always,
     [](const C& c) { return c.matched().pose().heading_radians(); }},
    {"DX m", 2, &HasDifference,
     [](const C& c) { return c.difference().x_meters(); }},
    {"DY m", 2, &HasDifference,
     [](const C& c) { return c.difference().y_meters(); }},
    {"DZ m", 2, &HasDifference,
     [](const C& c) { return c.difference().z_meters(); }},
    {"DHEADING rad", 4, &HasDifference,
     [](const C& c) { return c.difference().heading_radians(); }}};

constexpr const char* kDeviationTitles[] = {"SD DX m", "SD DY m", "SD DZ m",
                                            "SD DHEADING rad"};

constexpr WideColumn kGateColumns[] = {
    {"END D2", 3, &HasGate,
     [](const C& c) { return c.gate().squared_mahalanobis_distance(); }},
    {"END DOF", 0, &HasGate,
     [](const C& c) {
       return static_cast<double>(c.gate().degrees_of_freedom());
     }},
    {"END THRESHOLD", 3, &HasGate,
     [](const C& c) { return c.gate().threshold(); }},
    {"END P-VALUE", 4, &HasGate, [](const C& c) { return c.gate().p_value(); }},
    {"INFLATION", 2, &HasGate, [](const C& c) { return c.gate().inflation(); }},
    {"PATH D2", 3, &HasPath,
     [](const C& c) { return c.path_gate().squared_mahalanobis_distance(); }},
    {"PATH DOF", 1, &HasPath,
     [](const C& c) { return c.path_gate().degrees_of_freedom(); }},
    {"PATH THRESHOLD", 3, &HasPath,
     [](const C& c) { return c.path_gate().threshold(); }},
    {"PATH P-VALUE", 4, &HasPath,
     [](const C& c) { return c.path_gate().p_value(); }},
    {"PATH END D2", 3, &HasPath,
     [](const C& c) {
       return c.path_gate().end_squared_mahalanobis_distance();
     }},
    {"OVERLAP m", 1, &HasShape,
     [](const C& c) { return c.shape().overlap_meters(); }},
    {"LOG RATIO", 2, &HasShape,
     [](const C& c) { return c.shape().log_likelihood_ratio(); }}};

void AddWideColumns(Columns* columns) {
  const auto add = [columns](const WideColumn& column) {
    columns->Add(column.title, Table::Align::kRight, [&column](const C& c) {
      return column.has(c) ? Fixed(column.number(c), column.digits) : "-";
    });
  };
  for (const WideColumn& column : kSearchColumns) add(column);
  for (std::size_t i = 0; i < std::size(kDeviationTitles); ++i) {
    columns->Add(kDeviationTitles[i], Table::Align::kRight, [i](const C& c) {
      return DeviationTexts(c.difference().covariance())[i];
    });
  }
  for (const WideColumn& column : kGateColumns) add(column);
}

}  // namespace

std::string PlaceText(const v1::Node& node) {
  return absl::StrCat("sequence ", node.sequence(), ", ",
                      Fixed(node.travelled_meters(), 1), " m", TimeOf(node));
}

std::string IntervalText(const v1::PlaceInterval& interval) {
  const double before = interval.meters_before();
  const double after = interval.meters_after();
  return absl::StrCat(before > 0.0 ? "-" : "", Fixed(before, 1), " to ",
                      after > 0.0 ? "+" : "", Fixed(after, 1));
}

std::string ValueText(const v1::CheckCandidate& candidate) {
  return Fixed(candidate.value_square_meters(), 3);
}

DecidingGate DecidingGateOf(const v1::Candidate& candidate) {
  const v1::Gate& end = candidate.gate();
  const bool by_end = candidate.verdict() == v1::VERDICT_REJECTED_BY_GATE ||
                      candidate.verdict() == v1::VERDICT_ILL_CONDITIONED;
  if (by_end || !candidate.has_path_gate()) {
    return {
        candidate.has_gate(), false,         end.squared_mahalanobis_distance(),
        end.threshold(),      end.p_value(), end.verdict()};
  }
  const v1::PathGate& path = candidate.path_gate();
  return {true,
          true,
          path.squared_mahalanobis_distance(),
          path.threshold(),
          path.p_value(),
          path.verdict()};
}

std::uint64_t RecordingOfMatch(const v1::Candidate& candidate) {
  const std::string& name = candidate.recording_of_match();
  std::uint64_t sequence = 0;
  const std::size_t slash = name.rfind('/');
  return slash != name.npos &&
                 absl::SimpleAtoi(name.substr(slash + 1), &sequence)
             ? sequence
             : 0;
}

void PrintCheck(const v1::CandidateSet& set, std::ostream& out) {
  out << "check at " << PlaceText(set.query()) << ": ";
  if (set.candidates().empty()) {
    out << "no candidates, " << Explain(set.empty_reason()) << '\n';
    return;
  }
  const v1::Candidate& best = set.candidates(0);
  const DecidingGate gate = DecidingGateOf(best);
  out << PlaceText(best.matched()) << ", ";
  if (IsOfAnotherVehicle(best)) {
    out << "of " << Printable(best.matched_vehicle()) << ", ";
  }
  if (TellsOfFrames(best)) {
    out << "recording " << RecordingOfMatch(best) << " ("
        << NameOf(best.frame_state()) << "), ";
  }
  if (gate.has_distance()) {
    out << gate.name() << " d2 " << Fixed(gate.squared_distance, 2)
        << (gate.verdict == v1::GATE_VERDICT_REJECTED ? " beyond " : " within ")
        << Fixed(gate.threshold, 2) << ", ";
  }
  if (best.has_probability()) {
    out << "probability " << Fixed(best.probability(), 4) << ", ";
  }
  if (best.has_place_interval()) {
    out << IntervalText(best.place_interval()) << " m along the path, ";
  }
  if (best.direction() == v1::DIRECTION_OPPOSITE) {
    out << "opposite direction, ";
  }
  out << NameOf(best.verdict()) << '\n';
}

void PrintUnsearched(const v1::CandidateSet& set, std::ostream& out) {
  // A line names so many at most.
  constexpr std::size_t kMostNames = 10;
  std::map<v1::UnsearchedReason, std::vector<std::string>> by_reason;
  for (const v1::UnsearchedVehicle& one : set.unsearched()) {
    by_reason[one.reason()].push_back(Printable(one.vehicle()));
  }
  for (auto& [reason, vehicles] : by_reason) {
    const std::size_t count = vehicles.size();
    vehicles.resize(std::min(count, kMostNames));
    out << "not searched, since " << Explain(reason) << ": "
        << absl::StrJoin(vehicles, ", ");
    if (count > kMostNames) out << " and " << count - kMostNames << " more";
    out << '\n';
  }
}

void PrintPairs(const std::string& vehicle, const v1::CandidateSet& set,
                std::ostream& out) {
  for (const v1::Candidate& candidate : set.candidates()) {
    const std::uint64_t matched = candidate.matched().sequence();
    if (IsOfAnotherVehicle(candidate)) {
      out << IdOf(vehicle) << '@' << set.query().sequence() << ' '
          << Printable(IdOf(candidate.matched_vehicle())) << '@' << matched
          << '\n';
    } else {
      out << set.query().sequence() << '-' << matched << '\n';
    }
  }
}

void PrintCandidates(const v1::CandidateSet& set, const Terminal& terminal) {
  std::ostream& out = terminal.out;
  PrintQuery(set, out);
  if (set.candidates().empty()) {
    out << "no candidates: " << Explain(set.empty_reason()) << '\n';
  } else {
    Columns columns(set);
    AddPlaceColumns(set, &columns);
    AddJudgementColumns(&columns);
    if (terminal.wide()) AddWideColumns(&columns);
    columns.Print(terminal);
  }
  PrintScale(set, out);
  PrintScope(set, terminal);
}

}  // namespace revisit::client
