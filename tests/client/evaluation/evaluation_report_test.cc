#include "client/evaluation/evaluation_report.h"

#include <sstream>

#include "client/evaluation/evaluation_plots.h"
#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "nlohmann/json.hpp"

namespace revisit::client {
namespace {

using nlohmann::json;
using ::testing::HasSubstr;
using ::testing::MatchesRegex;
using ::testing::Not;

// Two checks, both true loops: one accepted and right, stated at 0.9; one
// wrong, rejected, stated at 0.2.
DriveResult MadeDrive(const std::string& name,
                      std::optional<std::uint64_t> seed) {
  DriveResult result;
  result.drive = name;
  result.seed = seed;
  result.nodes.resize(3);
  for (std::size_t i = 0; i < 3; ++i) {
    result.nodes[i].travelled_meters = 100.0 * static_cast<double>(i);
  }
  result.truth_at_nodes.resize(3);
  for (int i = 1; i < 3; ++i) {
    JudgedCheck check;
    check.true_loop = true;
    check.answer.query = i;
    check.answer.search_milliseconds = 1.0 * i;
    CandidateAnswer candidate;
    candidate.verdict =
        i == 1 ? v1::VERDICT_ACCEPTED : v1::VERDICT_REJECTED_BY_SHAPE;
    candidate.probability = i == 1 ? 0.9 : 0.2;
    candidate.confidence = *candidate.probability;
    candidate.meters_before = 20.0;
    candidate.meters_after = 4.0;
    check.answer.candidates.push_back(candidate);
    check.correct.push_back(i == 1);
    check.holds.push_back(i == 1);
    result.checks.push_back(check);
  }
  result.tally = Count(result.checks);
  result.tally.poses = result.tally.timed_poses = 50;
  result.tally.seconds = 0.5;
  return result;
}

Report TwoMethods() {
  Report report;
  report.methods = {
      {"paper", 150.0, {MadeDrive("one", {}), MadeDrive("two", {})}},
      {"relative", 150.0, {MadeDrive("one", {}), MadeDrive("two", {})}}};
  report.main = 1;
  report.notes = {"a note"};
  return report;
}

std::vector<std::string> Lines(const Report& report) {
  std::ostringstream out;
  PrintReport(report, out);
  std::vector<std::string> lines;
  std::istringstream in(out.str());
  for (std::string line; std::getline(in, line);) lines.push_back(line);
  return lines;
}

TEST(EvaluationReportTest, TableHasARowForEachMethodAndDriveAndTheTotals) {
  const auto lines = Lines(TwoMethods());
  // Heading, three rows, a rule, three rows, a blank line and the note.
  ASSERT_EQ(lines.size(), 10u);
  EXPECT_THAT(lines[0],
              MatchesRegex("METHOD +DRIVE +CHECKS +LOOPS +ACCEPTED +RIGHT "
                           "+PRECISION +P 95% +RECALL +R 95% +F1 +F1 95% "
                           "+P INTERVAL +R INTERVAL +TOP-1 +RECALL@5 "
                           "+RECALL p>=0.9 +VERIFY/LOOP +LOOKS/LOOP "
                           "+ECE p>=0.1 +ECE 95% +ECE "
                           "+POSES/s +p50 ms +p99 ms"));
  EXPECT_THAT(lines[1],
              MatchesRegex("paper +one +2 +2 +1 +1 +1.000 +0.025-1.000 +0.500 "
                           "+0.000-1.000 +0.667 +0.000-1.000 "
                           "+1.000 +0.500 +0.500 "
                           "+0.500 +0.500 +1.00 +2.00 +0.150 "
                           "+0.100-0.200 +0.150 +100 "
                           "+1.00 +2.00"));
  EXPECT_THAT(
      lines[3],
      MatchesRegex(
          "paper +total +4 +4 +2 +2 +1.000 +0.158-1.000 +0.500 .* 100 .*"));
  EXPECT_THAT(lines[4], MatchesRegex("-+"));
  EXPECT_THAT(lines[6], MatchesRegex("relative +two .*"));
  EXPECT_EQ(lines[9], "a note");
}

TEST(EvaluationReportTest, OneRowIsAList) {
  Report report;
  report.methods = {{"relative", 150.0, {MadeDrive("one", {})}}};
  const auto lines = Lines(report);
  EXPECT_THAT(lines[0], MatchesRegex("drive +one"));
  // In the words of the table, which the help explains.
  for (const char* line :
       {"precision +1.000 .95 %: 0.025-1.000.",
        "recall +0.500 .95 %: 0.000-1.000.",
        "in interval +precision 1.000, recall 0.500: 1 whose interval holds "
        "the place",
        "top-1 +0.500, 1 of the true loops .verdict aside.",
        "recall@5 +0.500, 1 of the true loops .verdict aside.",
        "recall p>=0.9 +0.500, 1 of the true loops right and stated at 0.9 or "
        "more",
        "verify/loop +1.00, 1 accepted for the 1 loops found",
        "looks/loop +2.00, 2 looks of 20 m for the 1 loops seen",
        "ECE p>=0.1 +0.150 .95 %: 0.100-0.200.", "ECE +0.150"}) {
    EXPECT_THAT(lines, ::testing::Contains(MatchesRegex(line)));
  }
}

TEST(EvaluationReportTest, SeedsOfADriveShareARow) {
  Report report;
  report.methods = {{"relative",
                     150.0,
                     {MadeDrive("one", 1), MadeDrive("one", 2),
                      MadeDrive("two", 1), MadeDrive("two", 2)}}};
  const auto lines = Lines(report);
  ASSERT_EQ(lines.size(), 5u);
  EXPECT_THAT(lines[1], MatchesRegex("one, 2 seeds +4 +4 +2 .*"));
  EXPECT_THAT(lines[4], MatchesRegex("total +8 +8 +4 .*"));
}

TEST(EvaluationReportTest, SequenceLengthsAreNamedWhereTheyDiffer) {
  Report report = TwoMethods();
  report.methods[0].method = "relative";
  report.methods[0].sequence_length_meters = 100.0;
  const auto lines = Lines(report);
  EXPECT_THAT(lines[1], MatchesRegex("relative, 100 m +one .*"));
  EXPECT_THAT(lines[5], MatchesRegex("relative, 150 m +one .*"));
}

TEST(EvaluationReportTest, EachClaimedScaleHasOneRowOfAllDrives) {
  Report report = TwoMethods();
  report.methods[0].method = "relative";
  report.methods[0].claimed_scale = 0.25;
  report.methods[1].claimed_scale = 1.0;
  const auto lines = Lines(report);
  // The lines are the heading, two rows, a blank one and the note.
  ASSERT_EQ(lines.size(), 5u);
  EXPECT_THAT(lines[1], MatchesRegex("relative, claimed x 0.25 +total +4 .*"));
  EXPECT_THAT(lines[2], MatchesRegex("relative, claimed x 1 +total +4 .*"));
  const json parsed = json::parse(ReportJson(report, false));
  EXPECT_EQ(parsed["methods"][0]["claimed_scale"], 0.25);
  EXPECT_EQ(parsed["methods"][0]["drives"].size(), 2u);
  EXPECT_TRUE(json::parse(ReportJson(TwoMethods(),
                                     false))["methods"][0]["claimed_scale"]
                  .is_null());
}

TEST(EvaluationReportTest, ShowsWhatTheVerifierSaidAndTheMeanInflation) {
  Report report = TwoMethods();
  report.methods.erase(report.methods.begin());
  report.main = 0;
  report.verified = true;
  DriveResult& first = report.methods[0].drives[0];
  DriveResult& second = report.methods[0].drives[1];
  first.tally.confirmed = 7;
  second.tally.rejected = 3;
  first.inflation = 1.5;
  second.inflation = 2.0;
  const auto lines = Lines(report);
  EXPECT_THAT(lines[0], HasSubstr("CONFIRMED  REJECTED  INFLATION"));
  EXPECT_THAT(lines[1], MatchesRegex("one .* 7 +0 +1.50 .*"));
  EXPECT_THAT(lines[4], MatchesRegex("total .* 7 +3 +1.75 .*"));
}

TEST(EvaluationReportTest, JsonHoldsTheSettingsAndAllMethods) {
  const json parsed = json::parse(ReportJson(TwoMethods(), false));
  EXPECT_EQ(parsed["drives"].size(), 2u);
  EXPECT_EQ(parsed["drives"][0]["drive"], "one");
  EXPECT_TRUE(parsed["drives"][0]["seed"].is_null());
  EXPECT_TRUE(parsed["drives"][0]["inflation"].is_null());
  EXPECT_FALSE(parsed["drives"][0].contains("check_list"));
  EXPECT_EQ(parsed["total"]["checks"], 4);
  EXPECT_EQ(parsed["total"]["recall"], 0.5);
  EXPECT_NEAR(parsed["total"]["expected_calibration_error"], 0.15, 1e-15);
  EXPECT_NEAR(parsed["total"]["positive_calibration_error"], 0.15, 1e-15);
  EXPECT_EQ(parsed["total"]["sure_correct"], 2);
  EXPECT_EQ(parsed["total"]["sure_recall"], 0.5);
  EXPECT_EQ(parsed["total"]["looks"], 4);
  EXPECT_EQ(parsed["total"]["looks_per_loop_seen"], 2.0);
  EXPECT_EQ(parsed["repeats"], 1);
  EXPECT_EQ(parsed["notes"], json::array({"a note"}));
  ASSERT_EQ(parsed["methods"].size(), 2u);
  const json& method = parsed["methods"][1];
  EXPECT_EQ(method["method"], "relative");
  EXPECT_EQ(method["sequence_length_meters"], 150.0);
  // Both right ones at 0.9, then the wrong ones.
  ASSERT_EQ(method["precision_recall"].size(), 2u);
  EXPECT_EQ(
      method["precision_recall"][0],
      json::parse(R"({"threshold": 0.9, "precision": 1.0, "recall": 0.5})"));
  ASSERT_EQ(method["reliability"].size(), 10u);
  EXPECT_EQ(method["reliability"][2]["count"], 2);
  EXPECT_EQ(method["reliability"][9]["share_correct"], 1.0);
  EXPECT_TRUE(method["reliability"][5]["share_correct"].is_null());
}

TEST(EvaluationReportTest, JsonHasNoReliabilityWhereNothingIsStated) {
  Report report = TwoMethods();
  for (DriveResult& drive : report.methods[0].drives) {
    drive.tally.probabilities.clear();
  }
  const json parsed = json::parse(ReportJson(report, false));
  EXPECT_TRUE(parsed["methods"][0]["reliability"].is_null());
  EXPECT_TRUE(
      parsed["methods"][0]["total"]["expected_calibration_error"].is_null());
}

TEST(EvaluationReportTest, VerboseJsonListsChecks) {
  const json parsed = json::parse(ReportJson(TwoMethods(), true));
  const json& check = parsed["drives"][0]["check_list"][1];
  EXPECT_EQ(check["node"], 2);
  EXPECT_EQ(check["true_loop"], true);
  const json& candidate = check["candidates"][0];
  EXPECT_EQ(candidate["verdict"], "REJECTED_BY_SHAPE");
  EXPECT_EQ(candidate["gate"], "end");
  EXPECT_EQ(candidate["probability"], 0.2);
  EXPECT_EQ(candidate["direction"], "SAME");
  EXPECT_EQ(candidate["correct"], false);
}

TEST(EvaluationReportTest, PrintsALineForEachCheck) {
  std::ostringstream out;
  PrintChecks(MadeDrive("one", {}), out);
  EXPECT_THAT(out.str(), HasSubstr("one: the best candidate of each check\n"));
  EXPECT_THAT(out.str(), HasSubstr("0.9000  ACCEPTED           right"));
  EXPECT_THAT(out.str(), HasSubstr("0.2000  REJECTED_BY_SHAPE  wrong"));
}

TEST(EvaluationPlotsTest, DrawsEachCurveWithItsName) {
  const std::string svg = DrawPrecisionRecall(
      "two drives", {{"a < b", {{0.9, 1.0, 0.25}, {0.5, 0.5, 0.5}}, 0.75, 0.5},
                     {"nothing found", {}, std::nullopt, 0.0}});
  EXPECT_THAT(svg, HasSubstr("<svg xmlns=\"http://www.w3.org/2000/svg\""));
  EXPECT_THAT(svg, HasSubstr(">two drives</text>"));
  EXPECT_THAT(svg, HasSubstr(">a &lt; b</text>"));
  EXPECT_THAT(svg, HasSubstr(">nothing found</text>"));
  // 520 pixels to the unit, from (72, 598): recall 0.25 at precision 1.
  EXPECT_THAT(svg, HasSubstr("d=\"M202 78L332 338\""));
  EXPECT_THAT(svg, HasSubstr("<circle cx=\"332\" cy=\"208\""));
  EXPECT_THAT(svg, HasSubstr("recall: right, of the true loops"));
  EXPECT_THAT(svg, HasSubstr("precision: right, of those chosen"));
  EXPECT_THAT(svg, Not(HasSubstr("nan")));
}

TEST(EvaluationPlotsTest, DrawsABarWithItsCountForEachBinThatHolds) {
  const std::vector<Scored> stated = {
      {0.95, true}, {0.95, true}, {0.95, false}, {0.15, false}, {0.0, false}};
  const std::string svg = DrawReliability("one drive", Reliability(stated),
                                          ExpectedCalibrationError(stated),
                                          PositiveCalibrationError(stated));
  EXPECT_THAT(svg, HasSubstr(">3</text>"));
  EXPECT_THAT(svg, HasSubstr("Expected calibration error 0.200, where stated "
                             "at 0.1 or more 0.250."));
  // At 0.95 two of three.
  EXPECT_THAT(svg, HasSubstr("<circle cx=\"566\" cy=\"251.33\""));
  EXPECT_THAT(svg, Not(HasSubstr("nan")));
  EXPECT_THAT(DrawReliability("", Reliability({}), std::nullopt, std::nullopt),
              HasSubstr("No probability was stated."));
}

TEST(EvaluationReportTest, RecordingsTellOfNewRoadsAndOfTheFirstLink) {
  Report report;
  report.recordings = report.verified = true;
  report.methods = {{"relative", 150.0, {MadeDrive("one", 1)}}};
  DriveResult& drive = report.methods[0].drives[0];
  drive.tally.new_road_checks = 7;
  drive.tally.new_road_accepted = 2;
  drive.linked_after_meters = 410.0;
  drive.checks[0].answer.candidates[0].has_gate = false;
  std::ostringstream out;
  PrintReport(report, out);
  EXPECT_THAT(out.str(), HasSubstr("7 checks, 2 accepted\n"));
  EXPECT_THAT(out.str(), HasSubstr("410 m\n"));
  const json made = json::parse(ReportJson(report, true));
  EXPECT_EQ(made["total"]["new_road_checks"], 7);
  EXPECT_EQ(made["drives"][0]["linked_after_meters"], 410.0);
  const json& candidate = made["drives"][0]["check_list"][0]["candidates"][0];
  EXPECT_EQ(candidate["gate"], "none");
  EXPECT_TRUE(candidate["p_value"].is_null());
  // A row for each asking drive, with all its draws.
  report.methods[0].drives = {MadeDrive("one", 1), MadeDrive("one", 2),
                              MadeDrive("two", 1), MadeDrive("two", 2)};
  report.methods[0].drives[1].linked_after_meters = 300.0;
  const auto lines = Lines(report);
  EXPECT_THAT(lines[0], MatchesRegex(".* NEW ROADS +ACCEPTED THERE +LINKED "
                                     "AFTER m +CONFIRMED .*"));
  EXPECT_THAT(lines[1], MatchesRegex("one, 2 seeds .* 0 +0 +300 .*"));
  EXPECT_THAT(lines[2], MatchesRegex("two, 2 seeds .* 0 +0 +- .*"));
}

}  // namespace
}  // namespace revisit::client
