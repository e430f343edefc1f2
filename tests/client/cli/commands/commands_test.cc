// The commands against a fake server, without the flags.
#include <sys/stat.h>

#include <cstdio>
#include <filesystem>
#include <fstream>
#include <future>
#include <iterator>
#include <sstream>
#include <string>

#include "client/cli/commands/export_command.h"
#include "client/cli/commands/find_command.h"
#include "client/cli/commands/show_command.h"
#include "client/cli/commands/stream_command.h"
#include "client/cli/commands/vehicle_command.h"
#include "client/cli/commands/verify_command.h"
#include "client/revisit/channel.h"
#include "client/terminal/terminal.h"
#include "gmock/gmock.h"
#include "google/protobuf/text_format.h"
#include "grpcpp/channel.h"
#include "gtest/gtest.h"
#include "nlohmann/json.hpp"
#include "tests/client/fake_server.h"

namespace revisit::client {
namespace {

namespace fs = std::filesystem;

using nlohmann::json;
using ::testing::ContainsRegex;
using ::testing::HasSubstr;
using ::testing::Not;
using ::testing::StartsWith;

class CommandsTest : public ::testing::Test {
 protected:
  CommandsTest()
      : channel_(MakeInsecureChannel(server_.address())), client_(channel_) {}

  void SetUp() override {
    path_ = ::testing::TempDir() + "drive_" +
            ::testing::UnitTest::GetInstance()->current_test_info()->name() +
            ".csv";
  }
  void TearDown() override { std::remove(path_.c_str()); }

  // A straight drive of this many poses, half a metre apart.
  void WriteDrive(int poses, double heading = 0.0) {
    std::ofstream file(path_);
    file << "t_s,est_x,est_y,est_yaw\n";
    for (int i = 0; i < poses; ++i) {
      file << i << ".25," << 0.5 * i << ",0," << heading << "\n";
    }
  }

  Terminal Text() { return {out_, progress_, false}; }
  Terminal Json() { return As(OutputFormat::kJson); }
  Terminal As(OutputFormat format) { return {out_, progress_, false, format}; }

  StreamOptions Stream() {
    StreamOptions options;
    options.files = {path_};
    options.vehicle = "shuttle";
    return options;
  }

  FakeServer server_;
  std::shared_ptr<grpc::Channel> channel_;
  Client client_;
  std::ostringstream out_;
  std::ostringstream progress_;
  std::string path_;
};

TEST_F(CommandsTest, CreatePrintsTheVehicleAsProtobufJson) {
  v1::VehicleSettings settings;
  settings.set_node_spacing_meters(0.5);
  ASSERT_TRUE(RunVehicleCreate(client_, "a", settings, {}, Json()).ok());
  const json vehicle = json::parse(out_.str());
  EXPECT_EQ(vehicle["name"], "vehicles/a");
  EXPECT_EQ(vehicle["settings"]["nodeSpacingMeters"], 0.5);
}

TEST_F(CommandsTest, ListReadsAllPages) {
  ASSERT_TRUE(RunVehicleList(client_, Json()).ok());
  const json list = json::parse(out_.str());
  ASSERT_EQ(list["vehicles"].size(), 2u);
  EXPECT_EQ(list["vehicles"][1]["name"], "vehicles/second");
  EXPECT_EQ(list["nextPageToken"], "");
}

TEST_F(CommandsTest, ListPrintsATable) {
  ASSERT_TRUE(RunVehicleList(client_, Text()).ok());
  EXPECT_THAT(out_.str(), StartsWith("VEHICLE          STATE"));
  EXPECT_THAT(out_.str(), HasSubstr("\nvehicles/first "));
  EXPECT_THAT(out_.str(), HasSubstr("\nvehicles/second "));
}

TEST_F(CommandsTest, ServerErrorsExitWith64AndTheirCode) {
  server_.FailUnaryCalls(
      {MakeStatus(grpc::StatusCode::NOT_FOUND, "none", {"VEHICLE_NOT_FOUND"})});
  const absl::Status status = RunVehicleGet(client_, "a", Text());
  EXPECT_EQ(ExitCodeOf(status), 69);
  EXPECT_EQ(ErrorText(status), "NOT_FOUND (VEHICLE_NOT_FOUND): none");
  EXPECT_EQ(out_.str(), "");
  const json error = json::parse(ErrorToJson(status));
  EXPECT_EQ(error["error"]["code"], "NOT_FOUND");
  EXPECT_EQ(error["error"]["reason"], "VEHICLE_NOT_FOUND");
}

TEST_F(CommandsTest, FaultsOfThisMachineExitWith1) {
  EXPECT_EQ(ExitCodeOf(LocalError(absl::NotFoundError("no file"))), 1);
  EXPECT_EQ(ExitCodeOf(absl::OkStatus()), 0);
  const absl::Status status = RunStream(channel_, Stream(), Text());
  EXPECT_EQ(ExitCodeOf(status), 1);
  // In its own words: no server answered with a code.
  EXPECT_EQ(ErrorText(status), path_ + ": No such file or directory");
}

TEST_F(CommandsTest, StreamSendsTheWholeFile) {
  WriteDrive(500);
  ASSERT_TRUE(RunStream(channel_, Stream(), Json()).ok());
  EXPECT_EQ(server_.durable_sequence(), 500u);
  v1::Pose last;
  ASSERT_TRUE(last.ParseFromString(server_.Stored().back()));
  EXPECT_EQ(last.sequence(), 500u);
  EXPECT_EQ(last.stamp().seconds(), 499);
  EXPECT_EQ(last.stamp().nanos(), 250'000'000);
  EXPECT_EQ(last.local().x_meters(), 249.5);
  EXPECT_EQ(last.covariance().form(), v1::COVARIANCE_FORM_PLANAR_6);
  EXPECT_GT(last.covariance().values(0), 2.0);
  const json summary = json::parse(out_.str());
  EXPECT_EQ(summary["durableSequence"], 500);
  EXPECT_EQ(summary["alreadyDurable"], 0);
}

TEST_F(CommandsTest, StreamGoesOnWhereItStopped) {
  WriteDrive(100);
  ASSERT_TRUE(RunStream(channel_, Stream(), Text()).ok());
  WriteDrive(300);
  out_.str("");
  ASSERT_TRUE(RunStream(channel_, Stream(), Json()).ok());
  EXPECT_EQ(server_.durable_sequence(), 300u);
  EXPECT_EQ(json::parse(out_.str())["alreadyDurable"], 100);
}

TEST_F(CommandsTest, StreamNoticesThatTheVehicleHasAnotherDrive) {
  WriteDrive(100);
  ASSERT_TRUE(RunStream(channel_, Stream(), Text()).ok());
  WriteDrive(300, 0.1);
  const absl::Status status = RunStream(channel_, Stream(), Text());
  EXPECT_EQ(status.code(), absl::StatusCode::kAlreadyExists);
  EXPECT_EQ(server_.durable_sequence(), 100u);
}

TEST_F(CommandsTest, StreamRefusesAVehicleThatHasMoreThanTheFile) {
  WriteDrive(100);
  ASSERT_TRUE(RunStream(channel_, Stream(), Text()).ok());
  WriteDrive(50);
  const absl::Status status = RunStream(channel_, Stream(), Text());
  EXPECT_EQ(ExitCodeOf(status), 1);
  EXPECT_EQ(status.message(),
            "vehicles/shuttle has 100 poses already, more than the 50 of " +
                path_ + "; --append adds these behind them");
}

TEST_F(CommandsTest, StreamPrintsCandidatesAsJsonLines) {
  server_.set_check_interval(100);
  WriteDrive(250);
  StreamOptions options = Stream();
  options.candidates = true;
  ASSERT_TRUE(RunStream(channel_, options, Json()).ok());
  std::istringstream lines(out_.str());
  std::string line;
  ASSERT_TRUE(std::getline(lines, line));
  EXPECT_EQ(json::parse(line)["query"]["sequence"], 100);
  ASSERT_TRUE(std::getline(lines, line));
  EXPECT_EQ(json::parse(line)["query"]["sequence"], 200);
  ASSERT_TRUE(std::getline(lines, line));
  EXPECT_EQ(json::parse(line)["checks"], 2);
}

TEST_F(CommandsTest, StreamSaysOnTheProgressStreamThatItReconnects) {
  int batch = 0;
  server_.FailBatches([&batch] {
    StreamFault fault;
    if (batch++ == 1) {
      fault = {StreamFault::Kind::kBefore,
               MakeStatus(grpc::StatusCode::UNAVAILABLE, "draining")};
    }
    return fault;
  });
  WriteDrive(300);
  ASSERT_TRUE(RunStream(channel_, Stream(), Json()).ok());
  EXPECT_EQ(json::parse(out_.str())["reconnects"], 1);
  EXPECT_THAT(progress_.str(), HasSubstr("connection lost, trying again in "));
  EXPECT_THAT(progress_.str(), HasSubstr("UNAVAILABLE: draining"));
}

TEST_F(CommandsTest, FindSaysWhyThereIsNothing) {
  v1::FindCandidatesRequest request;
  request.set_vehicle("shuttle");
  ASSERT_TRUE(RunFind(client_, request, Text()).ok());
  EXPECT_EQ(out_.str(),
            "no candidates: the path up to the query is shorter than the "
            "sequence\n");
}

// Two candidates as a relative search answers them. The end poses of the first
// fail their gate, and its path passes.
v1::CandidateSet RelativeSet() {
  v1::CandidateSet set;
  EXPECT_TRUE(google::protobuf::TextFormat::ParseFromString(
      R"pb(
        query {
          index: 100
          sequence: 200
          stamp { seconds: 1606417130 nanos: 250000000 }
          travelled_meters: 200
          pose { x_meters: 1 y_meters: 2 }
        }
        candidates {
          rank: 1
          score: 6.25
          matched {
            sequence: 40
            stamp { seconds: 1606417097 nanos: 528499000 }
            travelled_meters: 39.5
            pose { x_meters: 1.5 y_meters: 2.5 }
          }
          gate {
            squared_mahalanobis_distance: 14.5
            threshold: 7.815
            p_value: 0.0023
            verdict: GATE_VERDICT_REJECTED
            inflation: 1.75
          }
          path_gate {
            squared_mahalanobis_distance: 17.25
            threshold: 21.5
            p_value: 0.17
            verdict: GATE_VERDICT_ACCEPTED
          }
          verdict: VERDICT_ACCEPTED
          direction: DIRECTION_OPPOSITE
          probability: 0.9375
          place_interval { meters_before: 12 meters_after: 8.25 }
        }
        candidates {
          rank: 2
          score: -1
          matched {
            sequence: 90
            stamp { seconds: 12 }
            travelled_meters: 89.5
            pose {}
          }
          gate {
            squared_mahalanobis_distance: 9.5
            threshold: 7.815
            p_value: 0.02
            verdict: GATE_VERDICT_REJECTED
            inflation: 1.75
          }
          path_gate { verdict: GATE_VERDICT_ACCEPTED }
          verdict: VERDICT_REJECTED_BY_GATE
          direction: DIRECTION_SAME
          probability: 0.0
        }
        new_place_probability: 0.0625
      )pb",
      &set));
  return set;
}

TEST_F(CommandsTest, FindPrintsStampsAndTheGateThatDecided) {
  server_.set_candidates(RelativeSet());
  ASSERT_TRUE(RunFind(client_, {}, Text()).ok());
  EXPECT_EQ(
      out_.str(),
      "query: node 100, sequence 200, 2020-11-26T18:58:50.250Z "
      "(1606417130.25 s), 200.0 m travelled, at (1.00, 2.00) m\n"
      "new place: probability 0.0625\n"
      "RANK  SEQUENCE  TIME                                 TIME s  "
      "TRAVELLED m   X m   Y m  DIRECTION  GATE      D2  THRESHOLD  P-VALUE  "
      "PROBABILITY        ALONG m  VERDICT\n"
      "   1        40  2020-11-26T18:58:17.528Z  1606417097.528499         "
      "39.5  1.50  2.50  OPPOSITE   path  17.250     21.500   0.1700       "
      "0.9375  -12.0 to +8.2  ACCEPTED\n"
      "   2        90  1970-01-01T00:00:12Z                     12         "
      "89.5  0.00  0.00  SAME       end    9.500      7.815   0.0200       "
      "0.0000              -  REJECTED_BY_GATE\n"
      "claimed standard deviations were multiplied by 1.75\n");
}

TEST_F(CommandsTest, FindSaysWhatTheDriveHasShownOfItsClaims) {
  v1::CandidateSet set = RelativeSet();
  set.mutable_scale_estimate()->set_scale(1.5);
  set.mutable_scale_estimate()->set_low(0.75);
  set.mutable_scale_estimate()->set_high(3.0);
  const std::string shown =
      "the drive has shown standard deviations of 1.50 times the claimed ones "
      "(0.75 to 3.00)\n";
  server_.set_candidates(set);
  ASSERT_TRUE(RunFind(client_, {}, Text()).ok());
  EXPECT_THAT(out_.str(), HasSubstr(shown));
  EXPECT_THAT(out_.str(), Not(HasSubstr("multiplied")));
  out_.str("");
  set.clear_candidates();
  server_.set_candidates(set);
  ASSERT_TRUE(RunFind(client_, {}, Text()).ok());
  EXPECT_THAT(out_.str(), HasSubstr(shown));
}

TEST_F(CommandsTest, FindNamesPairsAsClosuresAreNamed) {
  server_.set_candidates(RelativeSet());
  ASSERT_TRUE(RunFind(client_, {}, As(OutputFormat::kName)).ok());
  EXPECT_EQ(out_.str(), "200-40\n200-90\n");
}

TEST_F(CommandsTest, WideFindHasBothGatesAndWhatTheSearchKnows) {
  v1::CandidateSet set = RelativeSet();
  v1::Candidate& first = *set.mutable_candidates(0);
  first.set_odds_to_runner_up(15.5);
  first.mutable_shape()->set_overlap_meters(148.25);
  first.mutable_shape()->set_log_likelihood_ratio(9.75);
  first.mutable_difference()->set_heading_radians(0.125);
  server_.set_candidates(set);
  ASSERT_TRUE(RunFind(client_, {}, As(OutputFormat::kWide)).ok());
  EXPECT_THAT(out_.str(), ContainsRegex("ODDS .* END D2 .* PATH D2 .* OVERLAP "
                                        "m  LOG RATIO\n"));
  // The decisive gate is the path's, the other one is shown as well.
  EXPECT_THAT(out_.str(),
              ContainsRegex("ACCEPTED +6.2500 +15.50 +.* 0.1250 .* 14.500 .* "
                            "17.250 .* 148.2 +9.75\n"));
  EXPECT_THAT(out_.str(), ContainsRegex("REJECTED_BY_GATE +-1.0000 +- .* -\n"));
}

TEST_F(CommandsTest, FindHasNoColumnsOfTimesWherePosesHaveNone) {
  v1::CandidateSet set = RelativeSet();
  for (v1::Candidate& candidate : *set.mutable_candidates()) {
    candidate.mutable_matched()->clear_stamp();
  }
  server_.set_candidates(set);
  ASSERT_TRUE(RunFind(client_, {}, Text()).ok());
  EXPECT_THAT(out_.str(), Not(HasSubstr("TIME")));
}

TEST_F(CommandsTest, FindShowsNoNumbersOfAGateThatCouldNotDecide) {
  v1::CandidateSet set = RelativeSet();
  set.mutable_candidates()->RemoveLast();
  set.mutable_candidates(0)->set_verdict(v1::VERDICT_ILL_CONDITIONED);
  set.mutable_candidates(0)->mutable_gate()->set_verdict(
      v1::GATE_VERDICT_ILL_CONDITIONED);
  server_.set_candidates(set);
  ASSERT_TRUE(RunFind(client_, {}, Text()).ok());
  EXPECT_THAT(out_.str(),
              ContainsRegex("end +- +7.815 +- +0.9375 .*ILL_CONDITIONED\n"));
}

TEST_F(CommandsTest, FindLeavesOutWhatACompositeAlignmentDoesNotKnow) {
  v1::CandidateSet set = RelativeSet();
  set.clear_new_place_probability();
  set.mutable_candidates()->RemoveLast();
  set.mutable_candidates(0)->clear_probability();
  set.mutable_candidates(0)->clear_place_interval();
  set.mutable_candidates(0)->clear_path_gate();
  set.mutable_candidates(0)->mutable_gate()->set_inflation(1.0);
  server_.set_candidates(set);
  ASSERT_TRUE(RunFind(client_, {}, Text()).ok());
  EXPECT_THAT(out_.str(), Not(HasSubstr("new place")));
  EXPECT_THAT(out_.str(), Not(HasSubstr("multiplied")));
  EXPECT_THAT(out_.str(),
              ContainsRegex("end +14.500 +7.815 +0.0023 +- +-  ACCEPTED\n"));
  out_.str("");
  ASSERT_TRUE(RunFind(client_, {}, Json()).ok());
  const json answer = json::parse(out_.str());
  EXPECT_FALSE(answer.contains("newPlaceProbability"));
  EXPECT_FALSE(answer["candidates"][0].contains("probability"));
  EXPECT_FALSE(answer["candidates"][0].contains("pathGate"));
  EXPECT_FALSE(answer["candidates"][0].contains("placeInterval"));
  EXPECT_FALSE(answer.contains("scaleEstimate"));
  EXPECT_EQ(answer["candidates"][0]["direction"], "DIRECTION_OPPOSITE");
}

TEST_F(CommandsTest, FindKeepsAProbabilityOfZeroInTheJson) {
  server_.set_candidates(RelativeSet());
  ASSERT_TRUE(RunFind(client_, {}, Json()).ok());
  const json answer = json::parse(out_.str());
  EXPECT_EQ(answer["newPlaceProbability"], 0.0625);
  EXPECT_EQ(answer["candidates"][1]["probability"], 0.0);
  EXPECT_EQ(answer["candidates"][1]["verdict"], "VERDICT_REJECTED_BY_GATE");
}

TEST_F(CommandsTest, StreamPrintsTheVerdictOfTheBestCandidate) {
  server_.set_check_interval(100);
  server_.set_candidates(RelativeSet());
  WriteDrive(100);
  StreamOptions options = Stream();
  options.candidates = true;
  ASSERT_TRUE(RunStream(channel_, options, Text()).ok());
  EXPECT_THAT(out_.str(),
              HasSubstr("check at sequence 100, 200.0 m, "
                        "2020-11-26T18:58:50.250Z (1606417130.25 s): sequence "
                        "40, 39.5 m, 2020-11-26T18:58:17.528Z "
                        "(1606417097.528499 s), path d2 17.25 within 21.50, "
                        "probability 0.9375, -12.0 to +8.2 m along the path, "
                        "opposite direction, ACCEPTED\n"));
}

TEST_F(CommandsTest, ConfirmAddsALoopClosureAndRejectARejection) {
  const VerifiedPair pair = {"shuttle", 200, 40};
  ASSERT_TRUE(RunConfirm(client_, pair, {}, Text()).ok());
  EXPECT_EQ(out_.str(),
            "confirmed vehicles/shuttle/loopClosures/new, revision 7\n");
  out_.str("");
  ASSERT_TRUE(RunReject(client_, pair, "", Text()).ok());
  EXPECT_EQ(out_.str(),
            "rejected vehicles/shuttle/rejectedCandidates/new, revision 8\n");
  out_.str("");
  ASSERT_TRUE(RunReject(client_, pair, "a bridge", Json()).ok());
  const json answer = json::parse(out_.str());
  EXPECT_EQ(answer["rejectedCandidate"]["querySequence"], 200);
  EXPECT_EQ(answer["rejectedCandidate"]["matchedSequence"], 40);
  EXPECT_EQ(answer["rejectedCandidate"]["note"], "a bridge");
  EXPECT_EQ(answer["revision"], 8);
}

TEST_F(CommandsTest, FindingsNameTheStoredCandidateThatTheyAnswer) {
  const std::string name = "vehicles/shuttle/checks/2068/candidates/1";
  const VerifiedPair pair = {"shuttle", 2068, 1072, name};
  ASSERT_TRUE(RunConfirm(client_, pair, {}, Text()).ok());
  ASSERT_TRUE(RunReject(client_, pair, "", Text()).ok());
  EXPECT_THAT(server_.Decisions(),
              ::testing::ElementsAre("confirm " + name + " 2068-1072",
                                     "reject " + name + " 2068-1072"));
}

TEST_F(CommandsTest, ConfirmSendsWhatTheVerifierMeasured) {
  VerifiedMeasurement measured;
  measured.relative = {1.5, -0.5, 0.25};
  measured.covariance = {1, 0, 0, 2, 0, 3};
  measured.note = "icp";
  measured.score = 0.0;
  EXPECT_EQ(CheckMeasurement(measured), "");
  ASSERT_TRUE(RunConfirm(client_, {"shuttle", 200, 40}, measured, Json()).ok());
  const json closure = json::parse(out_.str())["loopClosure"];
  EXPECT_EQ(closure["measurement"]["yMeters"], -0.5);
  EXPECT_EQ(closure["measurement"]["headingRadians"], 0.25);
  EXPECT_EQ(closure["measurement"]["covariance"]["form"],
            "COVARIANCE_FORM_PLANAR_6");
  EXPECT_EQ(closure["note"], "icp");
  EXPECT_EQ(closure["score"], 0.0);
}

TEST_F(CommandsTest, MeasurementHasAsManyNumbersAsOneOfTheForms) {
  EXPECT_EQ(CheckMeasurement({}), "");
  EXPECT_EQ(CheckMeasurement({{1, 2}, {1, 0, 0, 1, 0, 1}, "", {}}),
            "--relative: expected X,Y,HEADING or X,Y,Z,HEADING, got 2 numbers");
  EXPECT_EQ(CheckMeasurement({{1, 2, 3}, {1, 1, 1}, "", {}}),
            "--covariance: expected 6, 10 or 36 numbers, got 3");
}

TEST_F(CommandsTest, UpdateNamesTheSettingsThatAreGivenAndNoOthers) {
  v1::VehicleSettings changes;
  changes.set_apply_inflation(false);
  changes.set_alignment(v1::ALIGNMENT_COMPOSITE);
  ASSERT_TRUE(RunVehicleUpdate(client_, "shuttle", changes, {}, Json()).ok());
  const json vehicle = json::parse(out_.str());
  EXPECT_EQ(vehicle["name"], "vehicles/shuttle");
  EXPECT_EQ(vehicle["settings"]["alignment"], "ALIGNMENT_COMPOSITE");
  // Set to its default is not the same as not set.
  EXPECT_EQ(vehicle["settings"]["applyInflation"], false);
  EXPECT_FALSE(vehicle["settings"].contains("maxInflation"));
}

TEST_F(CommandsTest, VehicleShowsWhatVerifiedCandidatesSayOfItsCovariances) {
  v1::Vehicle vehicle;
  PrintVehicle(vehicle, Text());
  EXPECT_THAT(out_.str(), Not(HasSubstr("verified")));
  out_.str("");
  v1::Consistency* consistency = vehicle.mutable_consistency();
  consistency->set_rejected_count(2);
  consistency->set_degrees_of_freedom(3);
  consistency->set_inflation(1.0);
  PrintVehicle(vehicle, Text());
  EXPECT_THAT(out_.str(), ContainsRegex("verified +0 confirmed, 2 rejected\n"));
  EXPECT_THAT(out_.str(), Not(HasSubstr("squared innovation")));
  out_.str("");
  consistency->set_confirmed_count(5);
  consistency->set_mean_normalized_innovation_squared(8.25);
  consistency->set_inflation(1.6);
  consistency->set_applied(true);
  PrintVehicle(vehicle, Text());
  EXPECT_THAT(out_.str(),
              ContainsRegex("squared innovation +8.25 in the mean, 3 if the "
                            "claimed uncertainty is honest\n"));
  EXPECT_THAT(out_.str(), ContainsRegex("\ninflation +1.60, applied\n"));
}

TEST_F(CommandsTest, ShowSummarisesTheGraph) {
  ASSERT_TRUE(RunShow(client_, "shuttle", Json()).ok());
  const json summary = json::parse(out_.str());
  EXPECT_EQ(summary["vehicle"]["name"], "vehicles/shuttle");
  EXPECT_EQ(summary["nodeCount"], 2);
  EXPECT_EQ(summary["consecutiveEdgeCount"], 1);
  EXPECT_EQ(summary["maxXMeters"], 2.0);
  EXPECT_EQ(summary["positionSigmaMeters"], 0.5);
  EXPECT_EQ(summary["headingSigmaRadians"], 0.01);
}

TEST_F(CommandsTest, ExportWritesALineForEachElement) {
  ExportOptions options;
  options.vehicle = "shuttle";
  ASSERT_TRUE(RunExport(client_, options, Text()).ok());
  std::istringstream lines(out_.str());
  std::vector<json> elements;
  for (std::string line; std::getline(lines, line);) {
    elements.push_back(json::parse(line));
  }
  ASSERT_EQ(elements.size(), 4u);
  EXPECT_EQ(elements[0]["vehicle"]["name"], "vehicles/shuttle");
  EXPECT_EQ(elements[2]["node"]["index"], 1);
  EXPECT_EQ(elements[3]["edge"]["kind"], "EDGE_KIND_CONSECUTIVE");
}

TEST_F(CommandsTest, ExportWritesNodesAndEdgesAsCsv) {
  ExportOptions options;
  options.vehicle = "shuttle";
  options.format = ExportFormat::kNodesCsv;
  ASSERT_TRUE(RunExport(client_, options, Text()).ok());
  EXPECT_EQ(out_.str(),
            "index,sequence,fraction,t_s,travelled_m,x_m,y_m,z_m,heading_rad,"
            "cxx,cxy,cxz,cxh,cyy,cyz,cyh,czz,czh,chh\n"
            "0,1,0,,0,0,0,0,0,0.25,0,,0,0.25,,0,,,1e-04\n"
            "1,2,0,,2,2,0,0,0,0.25,0,,0,0.25,,0,,,1e-04\n");
  out_.str("");
  options.format = ExportFormat::kEdgesCsv;
  ASSERT_TRUE(RunExport(client_, options, Text()).ok());
  EXPECT_EQ(out_.str(), "from_index,to_index,kind\n0,1,consecutive\n");
}

TEST_F(CommandsTest, ExportSaysWhenItCannotWrite) {
  ExportOptions options;
  options.vehicle = "shuttle";
  options.output = "/nowhere/at/all";
  const absl::Status status = RunExport(client_, options, Text());
  EXPECT_EQ(ExitCodeOf(status), 1);
  EXPECT_EQ(status.message(), "/nowhere/at/all: No such file or directory");
}

// A directory of its own for files that are exported.
class ExportFileTest : public CommandsTest {
 protected:
  void SetUp() override {
    CommandsTest::SetUp();
    directory_ = fs::path(path_).replace_extension();
    fs::create_directory(directory_);
    options_.vehicle = "shuttle";
    options_.format = ExportFormat::kEdgesCsv;
    options_.output = directory_ / "edges.csv";
  }
  void TearDown() override { fs::remove_all(directory_); }

  static std::string Read(const fs::path& path) {
    std::ifstream file(path);
    return {std::istreambuf_iterator<char>(file), {}};
  }
  void Write(const std::string& text) {
    std::ofstream(options_.output) << text;
  }
  // In the directory.
  std::ptrdiff_t Files() const {
    return std::distance(fs::directory_iterator(directory_), {});
  }

  const std::string edges_ = "from_index,to_index,kind\n0,1,consecutive\n";
  fs::path directory_;
  ExportOptions options_;
};

TEST_F(ExportFileTest, FileHoldsWhatTheTerminalWouldShow) {
  ASSERT_TRUE(RunExport(client_, options_, Text()).ok());
  EXPECT_EQ(Read(options_.output), edges_);
  EXPECT_EQ(Files(), 1);
  EXPECT_EQ(out_.str(), "");
}

TEST_F(ExportFileTest, ExportThatFailsLeavesTheFileAsItWas) {
  Write("old");
  // After all parts have come.
  server_.FailUnaryCalls({MakeStatus(grpc::StatusCode::DATA_LOSS, "damaged")});
  EXPECT_EQ(RunExport(client_, options_, Text()).code(),
            absl::StatusCode::kDataLoss);
  EXPECT_EQ(Read(options_.output), "old");
  EXPECT_EQ(Files(), 1);
}

TEST_F(ExportFileTest, FileIsReplacedWithItsPermissionsKept) {
  Write("old and longer than what comes");
  fs::permissions(options_.output,
                  fs::perms::owner_read | fs::perms::owner_write);
  ASSERT_TRUE(RunExport(client_, options_, Text()).ok());
  EXPECT_EQ(Read(options_.output), edges_);
  EXPECT_EQ(fs::status(options_.output).permissions(),
            fs::perms::owner_read | fs::perms::owner_write);
  EXPECT_EQ(Files(), 1);
}

TEST_F(ExportFileTest, LinkStaysAndLeadsToTheNewFile) {
  Write("old");
  const fs::path file = options_.output;
  options_.output = directory_ / "link";
  fs::create_symlink(file, options_.output);
  ASSERT_TRUE(RunExport(client_, options_, Text()).ok());
  EXPECT_TRUE(fs::is_symlink(options_.output));
  EXPECT_EQ(Read(file), edges_);
}

TEST_F(ExportFileTest, PipeIsWrittenTo) {
  ASSERT_EQ(mkfifo(options_.output.c_str(), 0600), 0);
  auto read =
      std::async(std::launch::async, [this] { return Read(options_.output); });
  EXPECT_TRUE(RunExport(client_, options_, Text()).ok());
  EXPECT_EQ(read.get(), edges_);
  EXPECT_TRUE(fs::is_fifo(options_.output));
}

TEST(TerminalTest, DrawsABarOnATerminalOnly) {
  std::ostringstream out;
  std::ostringstream terminal;
  {
    Progress progress({out, terminal, true}, "drive", 10, "poses");
    while (terminal.str().empty()) progress.Update(5);
    EXPECT_THAT(terminal.str(),
                HasSubstr("drive [===============               ] 50 %"));
    progress.Note("something happened");
    EXPECT_THAT(terminal.str(),
                HasSubstr("\r\x1b[Kdrive: something happened\n"));
  }
  std::ostringstream plain;
  {
    Progress progress({out, plain, false}, "drive", 10, "poses");
    progress.Update(5);
    progress.Note("something happened");
  }
  EXPECT_EQ(plain.str(), "drive: something happened\n");
  EXPECT_EQ(out.str(), "");
}

TEST(TerminalTest, PrintsNumbersWithoutALocale) {
  EXPECT_EQ(Fixed(1234567.125, 2), "1234567.12");
  EXPECT_EQ(Fixed(-0.5, 0), "-0");
  EXPECT_EQ(Fixed(3.0, 3), "3.000");
}

}  // namespace
}  // namespace revisit::client
