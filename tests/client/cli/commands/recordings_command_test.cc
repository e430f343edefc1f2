// Recordings over the commands, against a fake server.
#include "client/cli/commands/recordings_command.h"

#include <unistd.h>

#include <filesystem>
#include <fstream>
#include <string>
#include <vector>

#include "absl/strings/str_cat.h"
#include "client/cli/commands/export_command.h"
#include "client/cli/commands/find_command.h"
#include "client/cli/commands/stream_command.h"
#include "gmock/gmock.h"
#include "nlohmann/json.hpp"
#include "tests/client/cli/commands/command_test.h"

namespace revisit::client {
namespace {

using nlohmann::json;
using ::testing::ContainsRegex;
using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::Not;

class RecordingsCommandTest : public CommandTest {
 protected:
  void TearDown() override { std::filesystem::remove_all(folder_); }

  // Poses along x from the origin, 2 m and a second apart.
  std::string File(const std::string& name, int poses, int begin_seconds) {
    std::filesystem::create_directories(folder_);
    const std::string path = folder_ + "/" + name + "_recordings_test.csv";
    std::ofstream file(path);
    file << "t_s,est_x,est_y,est_yaw\n";
    for (int i = 0; i < poses; ++i) {
      file << begin_seconds + i << "," << 2 * i << ",0,0\n";
    }
    return path;
  }

  StreamOptions Stream(const std::vector<std::string>& files,
                       const std::string& recording) {
    StreamOptions options;
    options.files = files;
    options.vehicle = "shuttle";
    if (!recording.empty()) {
      EXPECT_EQ(ReadRecordingChoice(recording, &options.recording), "");
    }
    return options;
  }

  // The sequences of poses that begin recordings.
  std::vector<std::uint64_t> Begun() {
    std::vector<std::uint64_t> begun;
    for (const std::string& bytes : server_.Stored()) {
      v1::Pose pose;
      pose.ParseFromString(bytes);
      if (pose.has_recording_start()) begun.push_back(pose.sequence());
    }
    return begun;
  }

  v1::Pose Stored(std::uint64_t sequence) {
    v1::Pose pose;
    pose.ParseFromString(server_.Stored().at(sequence - 1));
    return pose;
  }

  // Two recordings, of which nothing ties the first; the second one, of the
  // datum "map", is turned by a right angle in the frame of the third.
  static std::vector<v1::Recording> Three() {
    std::vector<v1::Recording> all(3);
    for (int i = 0; i < 3; ++i) {
      const std::uint64_t first = 4u * static_cast<std::uint64_t>(i) + 1;
      all[i].set_name(absl::StrCat("vehicles/shuttle/recordings/", first));
      all[i].set_first_sequence(first);
      all[i].set_last_sequence(first + 3);
    }
    all[0].set_label("monday");
    all[0].set_frame_state(v1::FRAME_STATE_NONE);
    all[1].set_label("tuesday");
    all[1].mutable_start()->mutable_datum()->set_datum_id("map");
    v1::Covariance* const covariance =
        all[1].mutable_start()->mutable_datum()->mutable_covariance();
    covariance->set_form(v1::COVARIANCE_FORM_PLANAR_6);
    for (const double value : {100.0, 0.0, 0.0, 100.0, 0.0, 0.0003046174}) {
      covariance->add_values(value);
    }
    all[1].set_frame_state(v1::FRAME_STATE_DATUM);
    all[1].mutable_frame_pose()->set_x_meters(7.0);
    all[1].mutable_frame_pose()->set_heading_radians(1.5707963267948966);
    *all[1].mutable_frame_covariance() = *covariance;
    all[1].mutable_frame_reference()->set_x_meters(3.0);
    all[2].mutable_start()->set_unknown(true);
    all[2].set_frame_state(v1::FRAME_STATE_SAME);
    all[2].mutable_frame_pose();
    return all;
  }

  // Tests run beside each other, each in a process of its own.
  const std::string folder_ =
      ::testing::TempDir() + "recordings_" + std::to_string(getpid());
};

TEST_F(RecordingsCommandTest, ListIsATableOfAllPages) {
  server_.set_recordings(Three());
  ASSERT_TRUE(RunRecordingsList(client_, "shuttle", Text()).ok());
  EXPECT_THAT(out_.str(), ContainsRegex("FIRST +LAST +LABEL +START +FRAME +"
                                        "FRAME X m +FRAME Y m +FRAME YAW"));
  EXPECT_THAT(out_.str(), ContainsRegex("1 +4 +monday +- +NONE +- +- +-\n"));
  EXPECT_THAT(out_.str(),
              ContainsRegex("5 +8 +tuesday +datum within 10 m and 1.0 degrees, "
                            "map +DATUM +7.00 +0.00 +1.5708\n"));
  EXPECT_THAT(out_.str(),
              ContainsRegex("9 +12 +- +unknown +SAME +0.00 +0.00 +0.0000\n"));
  EXPECT_EQ(server_.unary_calls(), 2);
}

TEST_F(RecordingsCommandTest, WideListHasDeviationsAndWhereTheyHold) {
  server_.set_recordings(Three());
  ASSERT_TRUE(
      RunRecordingsList(client_, "shuttle", As(OutputFormat::kWide)).ok());
  EXPECT_THAT(
      out_.str(),
      ContainsRegex("1.5708 +10.000 +10.000 +- +0.01745 +3.00 +0.00\n"));
}

TEST_F(RecordingsCommandTest, ListIsOneMessageInJsonAndNamesByThemselves) {
  server_.set_recordings(Three());
  ASSERT_TRUE(RunRecordingsList(client_, "shuttle", Json()).ok());
  const json list = json::parse(out_.str());
  ASSERT_EQ(list["recordings"].size(), 3u);
  EXPECT_EQ(list["recordings"][1]["start"]["datum"]["datumId"], "map");
  EXPECT_EQ(list["recordings"][2]["firstSequence"], 9);
  EXPECT_EQ(list["nextPageToken"], "");
  out_.str("");
  ASSERT_TRUE(
      RunRecordingsList(client_, "shuttle", As(OutputFormat::kName)).ok());
  EXPECT_EQ(out_.str(),
            "vehicles/shuttle/recordings/1\nvehicles/shuttle/recordings/5\n"
            "vehicles/shuttle/recordings/9\n");
}

TEST_F(RecordingsCommandTest, SecondDayBeginsARecordingWithErrorsOfItsOwn) {
  const auto files = {File("monday", 200, 0), File("tuesday", 200, 90000)};
  ASSERT_TRUE(RunStream(channel_, Stream(files, ""), Json()).ok());
  EXPECT_THAT(Begun(), ElementsAre(201));
  EXPECT_EQ(Stored(201).recording_start().label(), "tuesday_recordings_test");
  EXPECT_EQ(Stored(201).covariance().values(0),
            Stored(1).covariance().values(0));
  EXPECT_EQ(Stored(400).covariance().values(3),
            Stored(200).covariance().values(3));
  EXPECT_THAT(progress_.str(), HasSubstr("lies 398 m from the pose before, so "
                                         "another recording begins, where"));
  EXPECT_EQ(json::parse(out_.str())["recordings"], 1);
}

TEST_F(RecordingsCommandTest, StreamIsResumedInTheMiddleOfASecondRecording) {
  const auto files = {File("monday", 200, 0), File("tuesday", 200, 90000)};
  const StreamOptions options = Stream(files, "datum:10m,1deg,map");
  ASSERT_TRUE(RunStream(channel_, options, Json()).ok());
  const std::vector<std::string> whole = server_.Stored();
  EXPECT_THAT(Begun(), ElementsAre(1, 201));
  for (const std::uint64_t durable : {200u, 201u, 300u}) {
    server_.Forget(durable);
    ASSERT_TRUE(RunStream(channel_, options, Json()).ok());
    EXPECT_EQ(server_.Stored(), whole) << durable;
  }
}

TEST_F(RecordingsCommandTest, AppendedFileBeginsTheSameRecording) {
  const std::string monday = File("monday", 200, 0);
  const std::string tuesday = File("tuesday", 200, 90000);
  ASSERT_TRUE(RunStream(channel_, Stream({monday, tuesday}, ""), Json()).ok());
  const std::vector<std::string> whole = server_.Stored();
  server_.Forget(200);
  StreamOptions appended = Stream({tuesday}, "");
  appended.append = true;
  ASSERT_TRUE(RunStream(channel_, appended, Json()).ok());
  EXPECT_EQ(server_.Stored(), whole);
}

TEST_F(RecordingsCommandTest, FilesInOneFrameAreToldToBe) {
  const auto files = {File("monday", 200, 0), File("tuesday", 200, 90000)};
  ASSERT_TRUE(RunStream(channel_, Stream(files, "same"), Text()).ok());
  EXPECT_THAT(Begun(), ElementsAre());
  EXPECT_THAT(out_.str(), Not(HasSubstr("recordings begun")));
  server_.Forget(0);
  // A given start makes it as uncertain in that frame as the flag says.
  StreamOptions options = Stream(files, "");
  options.uncertainty.start_is_given = true;
  options.uncertainty.start_position = 5.0;
  ASSERT_TRUE(RunStream(channel_, options, Text()).ok());
  EXPECT_THAT(Begun(), ElementsAre());
}

TEST_F(RecordingsCommandTest, TableOfCandidatesNamesTheRecordingAndItsFrame) {
  v1::CandidateSet set;
  set.mutable_query()->set_sequence(300);
  v1::Candidate* const none = set.add_candidates();
  none->set_rank(1);
  none->mutable_matched()->set_sequence(40);
  none->set_verdict(v1::VERDICT_ACCEPTED);
  none->set_probability(0.9);
  none->set_recording_of_match("vehicles/shuttle/recordings/1");
  none->set_frame_state(v1::FRAME_STATE_NONE);
  server_.set_candidates(set);
  for (const OutputFormat format : {OutputFormat::kText, OutputFormat::kWide}) {
    ASSERT_TRUE(RunFind(client_, {}, As(format)).ok());
  }
  EXPECT_THAT(out_.str(), ContainsRegex("RECORDING  FRAME +GATE"));
  EXPECT_THAT(out_.str(),
              ContainsRegex(" 1  NONE +none +- +- +- +0.9000 +- +ACCEPTED\n"));
  EXPECT_THAT(out_.str(), ContainsRegex("END D2"));
  EXPECT_THAT(out_.str(), Not(HasSubstr(" 0.000 ")));
}

TEST_F(RecordingsCommandTest, CheckOfAStreamNamesTheRecording) {
  v1::CandidateSet set;
  v1::Candidate* const known = set.add_candidates();
  known->mutable_matched()->set_sequence(40);
  known->set_verdict(v1::VERDICT_ACCEPTED);
  known->set_recording_of_match("vehicles/shuttle/recordings/5");
  known->set_frame_state(v1::FRAME_STATE_DATUM);
  known->mutable_gate()->set_threshold(7.5);
  server_.set_candidates(set);
  server_.set_check_interval(100);
  StreamOptions options = Stream({File("monday", 100, 0)}, "");
  options.candidates = true;
  ASSERT_TRUE(RunStream(channel_, options, Text()).ok());
  EXPECT_THAT(out_.str(), HasSubstr("recording 5 (DATUM), end d2 0.00 within "
                                    "7.50, ACCEPTED\n"));
}

TEST_F(RecordingsCommandTest, GraphInG2oIsInTheFrameOfTheLastRecording) {
  v1::PoseBatch batch;
  for (int i = 0; i < 12; ++i) {
    v1::Pose* pose = batch.add_poses();
    pose->set_sequence(static_cast<std::uint64_t>(i) + 1);
    pose->mutable_local()->set_x_meters(2.0 * (i % 4));
    pose->set_heading_radians(0.0);
    pose->mutable_covariance()->set_form(v1::COVARIANCE_FORM_PLANAR_6);
    for (const double value : {1.0, 0.0, 0.0, 1.0, 0.0, 0.01}) {
      pose->mutable_covariance()->add_values(value);
    }
    if (i == 4) pose->mutable_recording_start()->set_label("tuesday");
    if (i == 8) pose->mutable_recording_start()->set_unknown(true);
  }
  server_.Replace("first", batch);
  server_.set_recordings(Three());
  ExportOptions options;
  options.vehicle = "shuttle";
  options.format = ExportFormat::kG2o;
  ASSERT_TRUE(RunExport(client_, options, Text()).ok());
  EXPECT_THAT(out_.str(), HasSubstr("VERTEX_SE2 2 2 0 0\n"));
  EXPECT_THAT(out_.str(), ContainsRegex("VERTEX_SE2 6 7 2 1.5707963"));
  EXPECT_THAT(out_.str(), HasSubstr("VERTEX_SE2 10 2 0 0\n"));
  // 10 m and 0.3 rad where nothing else was said.
  EXPECT_THAT(out_.str(), ContainsRegex("EDGE_SE2 4 5 0 0 0 0\\.01[0-9]* 0 0 "
                                        "0\\.01[0-9]* 0 11\\.1"));
  EXPECT_THAT(out_.str(), Not(HasSubstr("EDGE_SE2 8 9 ")));
  EXPECT_THAT(progress_.str(), HasSubstr("recordings behind the first: 2, "
                                         "without an edge to them: 1"));
}

}  // namespace
}  // namespace revisit::client
