#include "client/cli/commands/convert_command.h"

#include <filesystem>
#include <fstream>
#include <sstream>

#include "absl/strings/str_cat.h"
#include "gmock/gmock.h"
#include "google/protobuf/util/delimited_message_util.h"
#include "nlohmann/json.hpp"
#include "revisit/v1/pose_graph_service.pb.h"

namespace revisit::client {
namespace {

using ::testing::HasSubstr;
using ::testing::StartsWith;

class ConvertCommandTest : public ::testing::Test {
 protected:
  ConvertCommandTest() { std::filesystem::create_directories(directory_); }
  ~ConvertCommandTest() override { std::filesystem::remove_all(directory_); }

  std::string File(const std::string& name, const std::string& text) {
    const std::string path = directory_ / name;
    std::ofstream(path) << text;
    return path;
  }

  // Poses along x, a metre apart.
  std::string Straight(const std::string& name, int count) {
    std::string text = "t,x,y,yaw\n";
    for (int i = 0; i < count; ++i) {
      text += std::to_string(i) + "," + std::to_string(i) + ",0,0\n";
    }
    return File(name, text);
  }

  absl::Status Convert(const std::vector<std::string>& files,
                       ConvertFormat format) {
    options_.files = files;
    options_.format = format;
    options_.reader.columns = "t=t,x=x,y=y,yaw=yaw";
    return RunConvert(options_, {out_, progress_, false});
  }

  const std::filesystem::path directory_ =
      std::filesystem::path(::testing::TempDir()) /
      ::testing::UnitTest::GetInstance()->current_test_info()->name();
  ConvertOptions options_;
  std::ostringstream out_;
  std::ostringstream progress_;
};

TEST_F(ConvertCommandTest, SequencesGoOnOverTheFiles) {
  const std::string file = Straight("drive.csv", 12);
  ASSERT_TRUE(Convert({file, file}, ConvertFormat::kJsonLines).ok());
  std::istringstream lines(out_.str());
  std::string line;
  int sequence = 0;
  while (std::getline(lines, line)) {
    EXPECT_EQ(nlohmann::json::parse(line)["sequence"], ++sequence);
  }
  EXPECT_EQ(sequence, 24);
}

TEST_F(ConvertCommandTest, MessagesHoldAThousandPosesEach) {
  const std::string file = Straight("drive.csv", 2500);
  ASSERT_TRUE(Convert({file}, ConvertFormat::kMessages).ok());
  std::istringstream bytes(out_.str());
  google::protobuf::io::IstreamInputStream input(&bytes);
  std::vector<int> sizes;
  v1::PoseBatch batch;
  bool clean_end = false;
  while (google::protobuf::util::ParseDelimitedFromZeroCopyStream(
      &batch, &input, &clean_end)) {
    sizes.push_back(batch.poses_size());
    batch.Clear();
  }
  EXPECT_TRUE(clean_end);
  EXPECT_EQ(sizes, (std::vector<int>{1000, 1000, 500}));
}

TEST_F(ConvertCommandTest, VerticesAreJoinedAndCsvHasItsTitles) {
  const std::string file = Straight("drive.csv", 3);
  ASSERT_TRUE(Convert({file}, ConvertFormat::kG2o).ok());
  EXPECT_THAT(out_.str(), HasSubstr("\nEDGE_SE2 2 3 1 0 0 "));
  out_.str("");
  ASSERT_TRUE(Convert({file}, ConvertFormat::kCsv).ok());
  EXPECT_THAT(out_.str(), StartsWith("sequence,t_s,est_x,"));
}

TEST_F(ConvertCommandTest, LinesOfTumNeedTimes) {
  const std::string file = File("drive.g2o",
                                "VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\n"
                                "VERTEX_SE2 2 2 0 0\n");
  options_.files = {file};
  options_.format = ConvertFormat::kTum;
  const absl::Status converted = RunConvert(options_, {out_, progress_, false});
  EXPECT_EQ(ExitCodeOf(converted), kExitLocalError);
  EXPECT_THAT(std::string(converted.message()), HasSubstr("--rate"));
}

TEST_F(ConvertCommandTest, ErrorLeavesTheFileThatWasThere) {
  const std::string bad = File("bad.csv", "t,x,y,yaw\n0,0,0,0\n1,one,0,0\n");
  options_.output = File("out.csv", "as it was");
  const absl::Status converted = Convert({bad}, ConvertFormat::kCsv);
  EXPECT_EQ(ExitCodeOf(converted), kExitLocalError);
  EXPECT_THAT(std::string(converted.message()), HasSubstr("bad.csv:3"));
  std::ifstream file(options_.output);
  std::string text;
  std::getline(file, text);
  EXPECT_EQ(text, "as it was");
}

TEST_F(ConvertCommandTest, NoteSaysWhatIsClaimedUnlessAFlagDoes) {
  std::string text = "t,x,y,yaw,pxx,pxy,pxt,pyy,pyt,ptt\n";
  for (int i = 0; i < 50; ++i) {
    text += absl::StrCat(i, ",", i, ",0,0,", 0.01 * i, ",0,0,", 0.01 * i,
                         ",0,0.001\n");
  }
  options_.files = {File("drive.csv", text)};
  options_.format = ConvertFormat::kJsonLines;
  const Terminal terminal{out_, progress_, false};
  ASSERT_TRUE(RunConvert(options_, terminal).ok());
  EXPECT_THAT(progress_.str(), HasSubstr("drive: its covariances are claimed"));
  progress_.str("");
  options_.uncertainty_given = true;
  ASSERT_TRUE(RunConvert(options_, terminal).ok());
  EXPECT_EQ(progress_.str().find("claimed"), std::string::npos);
}

TEST_F(ConvertCommandTest, PositionsWithoutAHeadingNeedToBeToldOfTheirErrors) {
  std::string text = "t,x,y\n";
  for (int i = 0; i < 50; ++i) text += absl::StrCat(i, ",", 2 * i, ",0\n");
  options_.files = {File("positions.csv", text)};
  options_.reader.columns = "t=t,x=x,y=y";
  const Terminal terminal{out_, progress_, false};
  const absl::Status converted = RunConvert(options_, terminal);
  EXPECT_EQ(ExitCodeOf(converted), kExitLocalError);
  EXPECT_THAT(std::string(converted.message()), HasSubstr("--uncertainty"));
  EXPECT_EQ(out_.str(), "");
}

TEST_F(ConvertCommandTest, VehicleWithAFilterNeedsErrorTransitions) {
  options_.correlation_model = v1::CORRELATION_MODEL_FILTER;
  const std::string file = Straight("drive.csv", 12);
  EXPECT_EQ(ExitCodeOf(Convert({file}, ConvertFormat::kJsonLines)),
            kExitLocalError);
}

TEST_F(ConvertCommandTest, RecordingsAreInWhatHoldsWholePosesAndInTum) {
  const std::string monday = Straight("monday.csv", 30);
  const std::string tuesday = Straight("tuesday.csv", 30);
  ASSERT_EQ(ReadRecordingChoice("datum:2m,1deg,map", &options_.recording), "");
  ASSERT_TRUE(Convert({monday, tuesday}, ConvertFormat::kJsonLines).ok());
  const std::string whole = out_.str();
  std::istringstream lines(whole);
  std::vector<nlohmann::json> poses;
  for (std::string line; std::getline(lines, line);) {
    poses.push_back(nlohmann::json::parse(line));
  }
  ASSERT_EQ(poses.size(), 60u);
  for (std::size_t i = 0; i < poses.size(); ++i) {
    EXPECT_EQ(poses[i].contains("recordingStart"), i % 30 == 0) << i;
  }
  EXPECT_EQ(poses[30]["recordingStart"]["label"], "tuesday");
  EXPECT_EQ(poses[30]["covariance"], poses[0]["covariance"]);
  // There and back by the format of TUM.
  out_.str("");
  ASSERT_TRUE(Convert({monday, tuesday}, ConvertFormat::kTum).ok());
  const std::string tum = File("both.tum", out_.str());
  out_.str("");
  options_.recording = RecordingChoice();
  options_.reader.columns.clear();
  options_.files = {tum};
  options_.format = ConvertFormat::kJsonLines;
  options_.reader.accept_suspicious = true;
  ASSERT_TRUE(RunConvert(options_, {out_, progress_, false}).ok());
  std::istringstream again(out_.str());
  std::size_t next = 0;
  for (std::string line; std::getline(again, line); ++next) {
    const auto pose = nlohmann::json::parse(line);
    EXPECT_EQ(pose.contains("recordingStart"), next % 30 == 0) << next;
    if (next == 30) {
      EXPECT_EQ(pose["recordingStart"], poses[30]["recordingStart"]);
    }
  }
  EXPECT_EQ(next, 60u);
}

TEST_F(ConvertCommandTest, GeodeticPositionsTakeNoRecordings) {
  std::string text = "t,lat,lon\n";
  for (int i = 0; i < 30; ++i)
    absl::StrAppend(&text, i, ",", 50 + 1e-4 * i, ",8\n");
  options_.files = {File("fixes.csv", text)};
  options_.uncertainty_given = true;
  options_.uncertainty.source = UncertaintyOptions::Source::kFixes;
  ASSERT_EQ(ReadRecordingChoice("after", &options_.recording), "");
  const absl::Status converted = RunConvert(options_, {out_, progress_, false});
  EXPECT_EQ(ExitCodeOf(converted), kExitLocalError);
  EXPECT_THAT(std::string(converted.message()),
              HasSubstr("--recording goes with local ones"));
}

TEST_F(ConvertCommandTest, FilterThatBeginsAnewHasNoTransitionToTell) {
  std::string text =
      "t,x,y,yaw,pxx,pxy,pxt,pyy,pyt,ptt,fxx,fxy,fxt,fyx,fyy,fyt,ftx,fty,ftt\n";
  for (int i = 0; i < 30; ++i) {
    absl::StrAppend(&text, i, ",", 2 * i,
                    ",0,0,1,0,0,1,0,0.01,1,0,0,0,1,2,0,0,1\n");
  }
  const std::string file = File("filter.csv", text);
  options_.files = {file, file};
  options_.format = ConvertFormat::kJsonLines;
  options_.correlation_model = v1::CORRELATION_MODEL_FILTER;
  options_.reader.accept_suspicious = true;
  ASSERT_EQ(ReadRecordingChoice("unknown", &options_.recording), "");
  const absl::Status converted = RunConvert(options_, {out_, progress_, false});
  ASSERT_TRUE(converted.ok()) << converted;
  std::istringstream lines(out_.str());
  int sequence = 0;
  for (std::string line; std::getline(lines, line);) {
    const auto pose = nlohmann::json::parse(line);
    ++sequence;
    const bool begins = sequence == 1 || sequence == 31;
    EXPECT_EQ(pose["errorTransition"].empty(), begins) << sequence;
  }
  EXPECT_EQ(sequence, 60);
}

}  // namespace
}  // namespace revisit::client
