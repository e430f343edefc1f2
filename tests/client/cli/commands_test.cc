// The commands against a fake server, without the flags.
#include <cstdio>
#include <fstream>
#include <sstream>
#include <string>

#include "client/cli/console.h"
#include "client/cli/export_command.h"
#include "client/cli/find_command.h"
#include "client/cli/show_command.h"
#include "client/cli/stream_command.h"
#include "client/cli/vehicle_command.h"
#include "client/revisit/channel.h"
#include "gmock/gmock.h"
#include "grpcpp/channel.h"
#include "gtest/gtest.h"
#include "nlohmann/json.hpp"
#include "tests/client/fake_server.h"

namespace revisit::client {
namespace {

using nlohmann::json;
using ::testing::HasSubstr;
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

  Console Text() { return {out_, progress_, false, false}; }
  Console Json() { return {out_, progress_, false, true}; }

  StreamOptions Stream() {
    StreamOptions options;
    options.file = path_;
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
  ASSERT_TRUE(RunVehicleCreate(client_, "a", settings, Json()).ok());
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
  EXPECT_EQ(status.message(), path_ + ": No such file or directory");
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
  WriteDrive(300, 0.5);
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
  EXPECT_EQ(
      status.message(),
      "vehicles/shuttle has 100 poses already, more than the 50 of " + path_);
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
  EXPECT_EQ(json::parse(line)["query"]["sequence"], "100");
  ASSERT_TRUE(std::getline(lines, line));
  EXPECT_EQ(json::parse(line)["query"]["sequence"], "200");
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
  EXPECT_EQ(elements[2]["node"]["index"], "1");
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

TEST(ConsoleTest, DrawsABarOnATerminalOnly) {
  std::ostringstream out;
  std::ostringstream terminal;
  {
    Progress progress({out, terminal, true, false}, "drive", 10, "poses");
    while (terminal.str().empty()) progress.Update(5);
    EXPECT_THAT(terminal.str(),
                HasSubstr("drive [===============               ] 50 %"));
    progress.Note("something happened");
    EXPECT_THAT(terminal.str(),
                HasSubstr("\r\x1b[Kdrive: something happened\n"));
  }
  std::ostringstream plain;
  {
    Progress progress({out, plain, false, false}, "drive", 10, "poses");
    progress.Update(5);
    progress.Note("something happened");
  }
  EXPECT_EQ(plain.str(), "drive: something happened\n");
  EXPECT_EQ(out.str(), "");
}

TEST(ConsoleTest, PrintsNumbersWithoutALocale) {
  EXPECT_EQ(Fixed(1234567.125, 2), "1234567.12");
  EXPECT_EQ(Fixed(-0.5, 0), "-0");
  EXPECT_EQ(Fixed(3.0, 3), "3.000");
}

}  // namespace
}  // namespace revisit::client
