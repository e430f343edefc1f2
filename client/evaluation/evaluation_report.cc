#include "client/evaluation/evaluation_report.h"

#include <algorithm>
#include <utility>

#include "absl/strings/str_cat.h"
#include "client/answers/names.h"
#include "client/evaluation/bootstrap.h"
#include "client/evaluation/calibration.h"
#include "client/terminal/terminal.h"
#include "nlohmann/json.hpp"

namespace revisit::client {
namespace {

using Json = nlohmann::ordered_json;

// A row of the table.
struct Row {
  std::string drive;
  Tally tally;
  FigureIntervals intervals;
  // The mean over the results that the row holds.
  std::optional<double> inflation;
  // The mean over those that a verifier has tied to another recording.
  std::optional<double> linked_after_meters;
};

// The mean of what there is of a number.
std::optional<double> MeanOf(const std::vector<const DriveResult*>& of,
                             std::optional<double> DriveResult::*number) {
  double sum = 0.0;
  int count = 0;
  for (const DriveResult* result : of) {
    if (!(result->*number).has_value()) continue;
    sum += *(result->*number);
    ++count;
  }
  if (count == 0) return std::nullopt;
  return sum / count;
}

// Whether both are of one drive, with different seeds.
bool AreSeedsOfOneDrive(const DriveResult& a, const DriveResult& b) {
  return a.drive == b.drive && a.seed.has_value() && b.seed.has_value();
}

// The results by drive, in order of first appearance.
std::vector<std::vector<const DriveResult*>> ByDrive(
    const std::vector<const DriveResult*>& results) {
  std::vector<std::vector<const DriveResult*>> groups;
  for (const DriveResult* result : results) {
    const auto group =
        std::find_if(groups.begin(), groups.end(), [&](const auto& known) {
          return AreSeedsOfOneDrive(*known[0], *result);
        });
    if (group == groups.end()) {
      groups.push_back({result});
    } else {
      group->push_back(result);
    }
  }
  return groups;
}

FigureIntervals IntervalsOf(const std::vector<const DriveResult*>& results) {
  std::vector<ChecksOfSeeds> drives;
  for (const auto& group : ByDrive(results)) {
    ChecksOfSeeds& seeds = drives.emplace_back();
    for (const DriveResult* result : group) seeds.push_back(&result->checks);
  }
  return Bootstrap(drives);
}

std::vector<const DriveResult*> AllOf(const MethodResult& method) {
  std::vector<const DriveResult*> all;
  for (const DriveResult& result : method.drives) all.push_back(&result);
  return all;
}

Row MakeRow(const std::string& name,
            const std::vector<const DriveResult*>& of) {
  Row row;
  row.drive = name;
  for (const DriveResult* result : of) row.tally.Add(result->tally);
  row.intervals = IntervalsOf(of);
  row.inflation = MeanOf(of, &DriveResult::inflation);
  row.linked_after_meters = MeanOf(of, &DriveResult::linked_after_meters);
  return row;
}

// A row for each drive with all its seeds, in order of first appearance, and
// their total where there are several, by which alone a sweep is read.
std::vector<Row> RowsOf(const MethodResult& method) {
  const auto drives = ByDrive(AllOf(method));
  std::vector<Row> rows;
  for (const auto& results : drives) {
    if (drives.size() > 1 && method.claimed_scale.has_value()) break;
    const std::string& drive = results[0]->drive;
    rows.push_back(MakeRow(
        results.size() > 1 ? absl::StrCat(drive, ", ", results.size(), " seeds")
                           : drive,
        results));
  }
  if (drives.size() > 1) rows.push_back(MakeRow("total", AllOf(method)));
  return rows;
}

std::string OrDash(const std::optional<Interval>& interval) {
  return interval.has_value() ? absl::StrCat(Fixed(interval->low, 3), "-",
                                             Fixed(interval->high, 3))
                              : "-";
}

// A figure with its interval, where it has one.
std::string WithInterval(std::optional<double> figure,
                         const std::optional<Interval>& interval) {
  return interval.has_value() ? absl::StrCat(FigureText(figure, 3),
                                             " (95 %: ", OrDash(interval), ")")
                              : FigureText(figure, 3);
}

std::string OutcomeOf(const JudgedCheck& check) {
  if (check.top_correct()) return "right";
  return check.true_loop ? "wrong" : "no loop";
}

using Fields = std::vector<std::pair<std::string, std::string>>;

// Figures that do not depend on verdicts, and the work of a verifier.
Fields RankingFields(const Tally& t) {
  return {{"top-1", absl::StrCat(FigureText(t.top1(), 3), ", ", t.top1_correct,
                                 " of the true loops (verdict aside)")},
          {"recall@5",
           absl::StrCat(FigureText(t.recall_at_5(), 3), ", ", t.top5_correct,
                        " of the true loops (verdict aside)")},
          {"recall p>=0.9",
           absl::StrCat(FigureText(t.sure_recall(), 3), ", ", t.sure_correct,
                        " of the true loops right and stated at ",
                        Fixed(kSure, 1), " or more")},
          {"verify/loop", absl::StrCat(FigureText(t.to_verify_per_loop(), 2),
                                       ", ", t.to_verify, " accepted for the ",
                                       t.loops_found, " loops found")},
          {"looks/loop",
           absl::StrCat(FigureText(t.looks_per_loop(), 2), ", ", t.looks,
                        " looks of ", Fixed(2.0 * kLookMeters, 0),
                        " m for the ", t.loops_seen, " loops seen")}};
}

void PrintSummary(const Row& row, bool verified, bool recordings,
                  std::ostream& out) {
  const Tally& t = row.tally;
  Fields fields = {
      {"drive", row.drive},
      {"checks", absl::StrCat(t.checks)},
      {"true loops", absl::StrCat(t.true_loops)},
      {"accepted", absl::StrCat(t.accepted)},
      {"right", absl::StrCat(t.accepted_correct)},
      {"precision", WithInterval(t.precision(), row.intervals.precision)},
      {"recall", WithInterval(t.recall(), row.intervals.recall)},
      {"F1", WithInterval(t.f1(), row.intervals.f1)},
      {"in interval",
       absl::StrCat("precision ", FigureText(t.interval_precision(), 3),
                    ", recall ", FigureText(t.interval_recall(), 3), ": ",
                    t.accepted_holding, " whose interval holds the place")}};
  for (auto& field : RankingFields(t)) fields.push_back(std::move(field));
  if (t.calibration_error().has_value()) {
    fields.push_back(
        {"ECE p>=0.1", WithInterval(t.positive_calibration_error(),
                                    row.intervals.positive_calibration_error)});
    fields.push_back({"ECE", FigureText(t.calibration_error(), 3)});
  }
  if (recordings) {
    fields.push_back(
        {"new roads", absl::StrCat(t.new_road_checks, " checks, ",
                                   t.new_road_accepted, " accepted")});
  }
  if (recordings && verified) {
    fields.push_back(
        {"linked after",
         absl::StrCat(FigureText(row.linked_after_meters, 0), " m")});
  }
  if (verified) {
    fields.push_back({"verified", absl::StrCat(t.confirmed, " confirmed, ",
                                               t.rejected, " rejected")});
    fields.push_back({"inflation at the end", FigureText(row.inflation, 2)});
  }
  fields.push_back(
      {"poses", absl::StrCat(t.poses, ", ", FigureText(t.poses_per_second(), 0),
                             "/s with all checks")});
  if (t.jumps > 0) fields.push_back({"jumps", absl::StrCat(t.jumps)});
  fields.push_back(
      {"query time",
       absl::StrCat("p50 ", FigureText(t.search_percentile(50.0), 2),
                    " ms, p99 ", FigureText(t.search_percentile(99.0), 2),
                    " ms")});
  PrintFields(fields, out);
}

std::vector<Table::Column> ColumnsOf(const Report& report) {
  using Align = Table::Align;
  std::vector<Table::Column> columns;
  if (report.methods.size() > 1) columns.push_back({"METHOD", Align::kLeft});
  columns.push_back({"DRIVE", Align::kLeft});
  for (const char* title :
       {"CHECKS",      "LOOPS",      "ACCEPTED",   "RIGHT",    "PRECISION",
        "P 95%",       "RECALL",     "R 95%",      "F1",       "F1 95%",
        "P INTERVAL",  "R INTERVAL", "TOP-1",      "RECALL@5", "RECALL p>=0.9",
        "VERIFY/LOOP", "LOOKS/LOOP", "ECE p>=0.1", "ECE 95%",  "ECE"}) {
    columns.push_back({title, Align::kRight});
  }
  if (report.recordings) {
    for (const char* title : {"NEW ROADS", "ACCEPTED THERE"}) {
      columns.push_back({title, Align::kRight});
    }
  }
  if (report.recordings && report.verified) {
    columns.push_back({"LINKED AFTER m", Align::kRight});
  }
  if (report.verified) {
    for (const char* title : {"CONFIRMED", "REJECTED", "INFLATION"}) {
      columns.push_back({title, Align::kRight});
    }
  }
  for (const char* title : {"POSES/s", "p50 ms", "p99 ms"}) {
    columns.push_back({title, Align::kRight});
  }
  return columns;
}

// One for each of ColumnsOf().
std::vector<std::string> CellsOf(const Report& report,
                                 const MethodResult& method, const Row& row) {
  const Tally& t = row.tally;
  std::vector<std::string> cells;
  if (report.methods.size() > 1) {
    cells.push_back(NameAmong(report.methods, method));
  }
  cells.push_back(row.drive);
  for (const std::int64_t count :
       {t.checks, t.true_loops, t.accepted, t.accepted_correct}) {
    cells.push_back(absl::StrCat(count));
  }
  for (const auto& [ratio, interval] :
       {std::pair(t.precision(), row.intervals.precision),
        std::pair(t.recall(), row.intervals.recall),
        std::pair(t.f1(), row.intervals.f1)}) {
    cells.push_back(FigureText(ratio, 3));
    cells.push_back(OrDash(interval));
  }
  for (const auto& ratio : {t.interval_precision(), t.interval_recall(),
                            t.top1(), t.recall_at_5(), t.sure_recall()}) {
    cells.push_back(FigureText(ratio, 3));
  }
  cells.push_back(FigureText(t.to_verify_per_loop(), 2));
  cells.push_back(FigureText(t.looks_per_loop(), 2));
  cells.push_back(FigureText(t.positive_calibration_error(), 3));
  cells.push_back(OrDash(row.intervals.positive_calibration_error));
  cells.push_back(FigureText(t.calibration_error(), 3));
  if (report.recordings) {
    cells.push_back(absl::StrCat(t.new_road_checks));
    cells.push_back(absl::StrCat(t.new_road_accepted));
  }
  if (report.recordings && report.verified) {
    cells.push_back(FigureText(row.linked_after_meters, 0));
  }
  if (report.verified) {
    cells.push_back(absl::StrCat(t.confirmed));
    cells.push_back(absl::StrCat(t.rejected));
    cells.push_back(FigureText(row.inflation, 2));
  }
  cells.push_back(FigureText(t.poses_per_second(), 0));
  cells.push_back(FigureText(t.search_percentile(50.0), 2));
  cells.push_back(FigureText(t.search_percentile(99.0), 2));
  return cells;
}

void PrintTable(const Report& report, std::ostream& out, std::size_t width) {
  const bool several = report.methods.size() > 1;
  Table table(ColumnsOf(report));
  for (const MethodResult& method : report.methods) {
    const std::vector<Row> rows = RowsOf(method);
    const bool total = rows.size() > 1;
    if (several && &method != &report.methods.front() && total) table.AddRule();
    for (const Row& row : rows) {
      if (!several && total && &row == &rows.back()) table.AddRule();
      table.AddRow(CellsOf(report, method, row));
    }
  }
  table.Print(out, width);
}

Json OrNull(std::optional<double> value) {
  return value.has_value() ? Json(*value) : Json(nullptr);
}

Json OrNull(const std::optional<Interval>& interval) {
  return interval.has_value() ? Json({interval->low, interval->high})
                              : Json(nullptr);
}

// The figures of all these results together.
Json TallyJson(const std::string& drive,
               const std::vector<const DriveResult*>& results) {
  const Row row = MakeRow(drive, results);
  const Tally& t = row.tally;
  Json json;
  json["drive"] = drive;
  json["checks"] = t.checks;
  json["true_loops"] = t.true_loops;
  json["accepted"] = t.accepted;
  json["accepted_correct"] = t.accepted_correct;
  json["top1_correct"] = t.top1_correct;
  json["top5_correct"] = t.top5_correct;
  json["precision"] = OrNull(t.precision());
  json["recall"] = OrNull(t.recall());
  json["f1"] = OrNull(t.f1());
  json["precision_95"] = OrNull(row.intervals.precision);
  json["recall_95"] = OrNull(row.intervals.recall);
  json["f1_95"] = OrNull(row.intervals.f1);
  json["accepted_holding"] = t.accepted_holding;
  json["interval_precision"] = OrNull(t.interval_precision());
  json["interval_recall"] = OrNull(t.interval_recall());
  json["top1"] = OrNull(t.top1());
  json["recall_at_5"] = OrNull(t.recall_at_5());
  json["sure_correct"] = t.sure_correct;
  json["sure_recall"] = OrNull(t.sure_recall());
  json["candidates_to_verify"] = t.to_verify;
  json["loops_found"] = t.loops_found;
  json["candidates_per_loop_found"] = OrNull(t.to_verify_per_loop());
  json["looks"] = t.looks;
  json["loops_seen"] = t.loops_seen;
  json["looks_per_loop_seen"] = OrNull(t.looks_per_loop());
  json["positive_calibration_error"] = OrNull(t.positive_calibration_error());
  json["positive_calibration_error_95"] =
      OrNull(row.intervals.positive_calibration_error);
  json["expected_calibration_error"] = OrNull(t.calibration_error());
  json["new_road_checks"] = t.new_road_checks;
  json["new_road_accepted"] = t.new_road_accepted;
  json["confirmed"] = t.confirmed;
  json["rejected"] = t.rejected;
  json["jumps"] = t.jumps;
  json["query_ms_p50"] = OrNull(t.search_percentile(50.0));
  json["query_ms_p99"] = OrNull(t.search_percentile(99.0));
  json["poses"] = t.poses;
  json["poses_per_second"] = OrNull(t.poses_per_second());
  return json;
}

Json ChecksJson(const DriveResult& result) {
  Json list = Json::array();
  for (const JudgedCheck& check : result.checks) {
    const auto travelled = [&](std::int64_t node) {
      return result.nodes[static_cast<std::size_t>(node)].travelled_meters;
    };
    Json entry;
    entry["node"] = check.answer.query;
    entry["travelled_meters"] = travelled(check.answer.query);
    entry["true_loop"] = check.true_loop;
    entry["query_ms"] = OrNull(check.answer.search_milliseconds);
    entry["empty_reason"] = check.answer.empty_reason;
    entry["candidates"] = Json::array();
    for (std::size_t i = 0; i < check.answer.candidates.size(); ++i) {
      const CandidateAnswer& candidate = check.answer.candidates[i];
      Json item;
      item["matched_node"] = candidate.matched;
      item["matched_travelled_meters"] = travelled(candidate.matched);
      item["direction"] = candidate.opposite ? "OPPOSITE" : "SAME";
      const bool gated = candidate.has_gate;
      item["gate"] = !gated ? "none" : candidate.path_gate ? "path" : "end";
      const auto if_gated = [gated](double value) {
        return gated ? Json(value) : Json(nullptr);
      };
      item["squared_mahalanobis_distance"] =
          if_gated(candidate.squared_distance);
      item["threshold"] = if_gated(candidate.threshold);
      item["p_value"] = if_gated(candidate.p_value);
      item["probability"] = OrNull(candidate.probability);
      item["meters_before"] = candidate.meters_before;
      item["meters_after"] = candidate.meters_after;
      item["verdict"] = NameOf(candidate.verdict);
      item["correct"] = static_cast<bool>(check.correct[i]);
      entry["candidates"].push_back(std::move(item));
    }
    list.push_back(std::move(entry));
  }
  return list;
}

Json DrivesJson(const MethodResult& method) {
  Json drives = Json::array();
  for (const DriveResult& result : method.drives) {
    Json drive = TallyJson(result.drive, {&result});
    drive["seed"] =
        result.seed.has_value() ? Json(*result.seed) : Json(nullptr);
    drive["inflation"] = OrNull(result.inflation);
    drive["linked_after_meters"] = OrNull(result.linked_after_meters);
    drives.push_back(std::move(drive));
  }
  return drives;
}

Json MethodJson(const MethodResult& method) {
  const Tally total = TotalOf(method);
  Json json;
  json["method"] = method.method;
  json["sequence_length_meters"] = method.sequence_length_meters;
  json["claimed_scale"] = OrNull(method.claimed_scale);
  json["drives"] = DrivesJson(method);
  json["total"] = TallyJson("total", AllOf(method));
  json["precision_recall"] = Json::array();
  for (const CurvePoint& point :
       PrecisionRecallCurve(total.confidences, total.true_loops)) {
    json["precision_recall"].push_back({{"threshold", point.threshold},
                                        {"precision", point.precision},
                                        {"recall", point.recall}});
  }
  json["reliability"] = nullptr;
  if (total.probabilities.empty()) return json;
  json["reliability"] = Json::array();
  for (const ReliabilityBin& bin : Reliability(total.probabilities)) {
    const bool any = bin.count > 0;
    json["reliability"].push_back(
        {{"low", bin.low},
         {"high", bin.high},
         {"count", bin.count},
         {"mean_stated", any ? Json(bin.mean_stated) : Json(nullptr)},
         {"share_correct", any ? Json(bin.share_correct) : Json(nullptr)}});
  }
  return json;
}

}  // namespace

std::string FigureText(std::optional<double> value, int digits) {
  return value.has_value() ? Fixed(*value, digits) : "-";
}

std::string NameAmong(const std::vector<MethodResult>& methods,
                      const MethodResult& method) {
  std::string name = method.method;
  if (std::any_of(methods.begin(), methods.end(), [&](const auto& other) {
        return other.sequence_length_meters != method.sequence_length_meters;
      })) {
    absl::StrAppend(&name, ", ", Fixed(method.sequence_length_meters, 0), " m");
  }
  if (method.claimed_scale.has_value()) {
    absl::StrAppend(&name, ", claimed x ", *method.claimed_scale);
  }
  return name;
}

Tally TotalOf(const MethodResult& method) {
  Tally total;
  for (const DriveResult& result : method.drives) total.Add(result.tally);
  return total;
}

void PrintChecks(const DriveResult& result, std::ostream& out,
                 std::size_t width) {
  using Align = Table::Align;
  Table table({{"CHECK", Align::kRight},
               {"AT m", Align::kRight},
               {"CANDIDATE m", Align::kRight},
               {"GATE", Align::kLeft},
               {"D2", Align::kRight},
               {"THRESHOLD", Align::kRight},
               {"P-VALUE", Align::kRight},
               {"PROBABILITY", Align::kRight},
               {"VERDICT", Align::kLeft},
               {"TRUTH", Align::kLeft}});
  int number = 0;
  for (const JudgedCheck& check : result.checks) {
    const auto travelled = [&](std::int64_t node) {
      return Fixed(
          result.nodes[static_cast<std::size_t>(node)].travelled_meters, 1);
    };
    ++number;
    if (check.answer.candidates.empty()) {
      table.AddRow({absl::StrCat(number), travelled(check.answer.query), "-",
                    "-", "-", "-", "-", "-", "NONE", OutcomeOf(check)});
      continue;
    }
    const CandidateAnswer& best = check.answer.candidates[0];
    const auto if_gated = [&best](double value, int digits) {
      return best.has_gate ? Fixed(value, digits) : "-";
    };
    table.AddRow({absl::StrCat(number), travelled(check.answer.query),
                  travelled(best.matched),
                  !best.has_gate   ? "none"
                  : best.path_gate ? "path"
                                   : "end",
                  if_gated(best.squared_distance, 2),
                  if_gated(best.threshold, 2), if_gated(best.p_value, 4),
                  FigureText(best.probability, 4), NameOf(best.verdict),
                  OutcomeOf(check)});
  }
  out << result.drive << ": the best candidate of each check\n";
  table.Print(out, width);
  out << '\n';
}

void PrintReport(const Report& report, std::ostream& out, std::size_t width) {
  const MethodResult& main = report.methods[report.main];
  if (report.methods.size() == 1 && ByDrive(AllOf(main)).size() == 1) {
    PrintSummary(RowsOf(main)[0], report.verified, report.recordings, out);
  } else {
    PrintTable(report, out, width);
  }
  if (!report.notes.empty()) out << '\n';
  for (const std::string& note : report.notes) out << note << '\n';
}

std::string ReportJson(const Report& report, bool verbose) {
  const MethodResult& main = report.methods[report.main];
  Json methods = Json::array();
  for (const MethodResult& method : report.methods) {
    methods.push_back(MethodJson(method));
  }
  Json json;
  json["drives"] = methods[report.main]["drives"];
  for (std::size_t i = 0; verbose && i < main.drives.size(); ++i) {
    json["drives"][i]["check_list"] = ChecksJson(main.drives[i]);
  }
  json["total"] = methods[report.main]["total"];
  json["methods"] = std::move(methods);
  json["repeats"] = report.repeats;
  json["notes"] = report.notes;
  return json.dump(1, ' ', false, Json::error_handler_t::replace);
}

}  // namespace revisit::client
