#include "client/trajectory/recording_starts.h"

#include "client/formats/angles.h"
#include "gmock/gmock.h"
#include "gtest/gtest.h"

namespace revisit::client {
namespace {

using Kind = RecordingChoice::Kind;
using ::testing::ElementsAre;
using ::testing::HasSubstr;

RecordingChoice Read(const std::string& text) {
  RecordingChoice choice;
  EXPECT_EQ(ReadRecordingChoice(text, &choice), "") << text;
  return choice;
}

TEST(RecordingChoiceTest, WordsAreReadWithTheirUnits) {
  EXPECT_EQ(Read("unknown").kind, Kind::kUnknown);
  EXPECT_EQ(Read("same").kind, Kind::kSame);
  EXPECT_EQ(Read("after").kind, Kind::kAfter);
  EXPECT_FALSE(Read("after").size.has_value());
  const RecordingChoice after = Read("after:5m,17.5deg");
  EXPECT_EQ(after.kind, Kind::kAfter);
  EXPECT_EQ(after.size->meters, 5.0);
  EXPECT_NEAR(after.size->radians, 17.5 * kPi / 180.0, 1e-15);
  const RecordingChoice datum = Read("datum:1e1m,1deg,survey, May");
  EXPECT_EQ(datum.kind, Kind::kDatum);
  EXPECT_EQ(datum.size->meters, 10.0);
  EXPECT_EQ(datum.datum_id, "survey, May");
}

TEST(RecordingChoiceTest, NumbersWithoutUnitsAndOtherWordsAreRefused) {
  for (const char* text :
       {"", "yes", "after:", "after:5,17", "after:5m", "after:5deg,17m",
        "after:-5m,17deg", "after:0m,17deg", "after:nanm,1deg",
        "after:5m,17deg,map", "datum", "datum:10m", "datum:10m,1", "unknown:1m",
        "After", "after:5 m,17deg", "datum:10m,1deg,"}) {
    RecordingChoice choice;
    EXPECT_NE(ReadRecordingChoice(text, &choice), "") << text;
    EXPECT_EQ(choice.kind, Kind::kByPoses) << text;
  }
  RecordingChoice choice;
  EXPECT_THAT(ReadRecordingChoice("datum:10,1", &choice),
              HasSubstr("datum:10m,1deg"));
  EXPECT_NE(
      ReadRecordingChoice("datum:1m,1deg," + std::string(129, 'x'), &choice),
      "");
}

TEST(RecordingStartTest, MessageSaysWhatTheWordsSay) {
  const auto make = [](const std::string& text, v1::StateSpace space) {
    return MakeRecordingStart(Read(text), "tuesday", space);
  };
  const v1::RecordingStart plain = make("after", v1::STATE_SPACE_PLANAR);
  EXPECT_EQ(plain.label(), "tuesday");
  EXPECT_EQ(plain.relation_case(), v1::RecordingStart::RELATION_NOT_SET);
  const v1::RecordingStart after =
      make("after:3m,57.29577951308232deg", v1::STATE_SPACE_SPATIAL);
  EXPECT_EQ(after.after().form(), v1::COVARIANCE_FORM_SPATIAL_10);
  EXPECT_THAT(after.after().values(),
              ElementsAre(9, 0, 0, 0, 9, 0, 0, 9, 0, ::testing::DoubleEq(1)));
  const v1::RecordingStart datum =
      make("datum:2m,57.29577951308232deg,map", v1::STATE_SPACE_PLANAR);
  EXPECT_EQ(datum.datum().datum_id(), "map");
  EXPECT_FALSE(datum.datum().has_pose());
  EXPECT_THAT(datum.datum().covariance().values(),
              ElementsAre(4, 0, 0, 4, 0, ::testing::DoubleEq(1)));
  EXPECT_TRUE(make("unknown", v1::STATE_SPACE_PLANAR).unknown());
}

TEST(RecordingStartTest, RelationIsSaidInWords) {
  const auto text = [](const std::string& choice) {
    return RelationText(
        MakeRecordingStart(Read(choice), "", v1::STATE_SPACE_PLANAR));
  };
  EXPECT_EQ(text("after"), "after");
  EXPECT_EQ(text("after:5m,17deg"), "after, within 5 m and 17.0 degrees");
  EXPECT_EQ(text("datum:10m,1deg,map"),
            "datum within 10 m and 1.0 degrees, map");
  EXPECT_EQ(text("unknown"), "unknown");
}

Sample Pose(double x, double seconds) {
  Sample sample;
  sample.estimate = {x, 0.0, 0.0};
  sample.time_nanoseconds = static_cast<std::int64_t>(seconds * 1e9);
  sample.line = 7;
  return sample;
}

class RecordingStartsTest : public ::testing::Test {
 protected:
  void Make(const std::string& choice, bool looks_at_poses = true) {
    starts_.emplace(choice.empty() ? RecordingChoice() : Read(choice),
                    v1::STATE_SPACE_PLANAR, looks_at_poses);
  }

  // The recording that begins with the next sample; null if none does.
  std::optional<RecordingStarts::Begun> Next(const Sample& sample) {
    auto begun = starts_->Next(sample);
    EXPECT_TRUE(begun.ok()) << begun.status();
    return *begun;
  }

  // Ten poses of a file, each 2 m and a second behind the one before; those
  // that begin a recording.
  std::vector<int> Drive(const std::string& file, double x, double seconds) {
    starts_->BeginFile(file);
    std::vector<int> begun;
    for (int i = 0; i < 10; ++i) {
      if (Next(Pose(x + 2.0 * i, seconds + i))) begun.push_back(i);
    }
    return begun;
  }

  std::optional<RecordingStarts> starts_;
};

TEST_F(RecordingStartsTest, FileThatGoesOnWhereTheLastEndedBeginsNothing) {
  Make("");
  EXPECT_THAT(Drive("a.csv", 0.0, 0.0), ElementsAre());
  EXPECT_THAT(Drive("b.csv", 20.0, 10.0), ElementsAre());
  EXPECT_EQ(starts_->count(), 0);
}

TEST_F(RecordingStartsTest, FileThatBeginsElsewhereOrLaterIsARecording) {
  Make("");
  Drive("monday.csv", 0.0, 0.0);
  starts_->BeginFile("dir/tuesday.csv.gz");
  const auto begun = Next(Pose(0.0, 86400.0));
  ASSERT_TRUE(begun.has_value());
  EXPECT_EQ(begun->start.label(), "tuesday");
  EXPECT_EQ(begun->start.relation_case(), v1::RecordingStart::RELATION_NOT_SET);
  EXPECT_TRUE(begun->by_poses);
  EXPECT_THAT(begun->note, HasSubstr("dir/tuesday.csv.gz:7: lies 18 m from"));
  // At the place where the last one ended, but a day later.
  EXPECT_THAT(Drive("wednesday.csv", 1.0, 2 * 86400.0), ElementsAre(0));
  Sample turned = Pose(20.0, 2 * 86400.0 + 11.0);
  turned.estimate.heading = 2.0;
  starts_->BeginFile("other.csv");
  EXPECT_THAT(Next(turned)->note, HasSubstr("heads 115 degrees away"));
}

TEST_F(RecordingStartsTest, LongStepsAreUsualWhereTheyWereBefore) {
  Make("");
  starts_->BeginFile("a.csv");
  for (int i = 0; i < 3; ++i) EXPECT_FALSE(Next(Pose(30.0 * i, i)));
  starts_->BeginFile("b.csv");
  EXPECT_FALSE(Next(Pose(90.0, 3.0)));
}

TEST_F(RecordingStartsTest, PosesTellNothingWhereErrorsAreNotCarriedOn) {
  Make("", /*looks_at_poses=*/false);
  Drive("a.csv", 0.0, 0.0);
  Sample back = Pose(0.0, 100.0);
  back.restarts = true;
  starts_->BeginFile("b.csv");
  EXPECT_FALSE(Next(Pose(500.0, 99.0)));
  EXPECT_FALSE(Next(back));
}

TEST_F(RecordingStartsTest, EachFileButTheFirstBeginsWhatWasChosen) {
  Make("unknown");
  EXPECT_THAT(Drive("a.csv", 0.0, 0.0), ElementsAre());
  starts_->BeginFile("b.csv");
  const auto begun = Next(Pose(20.0, 10.0));
  ASSERT_TRUE(begun.has_value());
  EXPECT_TRUE(begun->start.unknown());
  EXPECT_FALSE(begun->by_poses);
  EXPECT_EQ(begun->note, "");
  EXPECT_EQ(starts_->count(), 1);
}

TEST_F(RecordingStartsTest, FirstFileHasADatumToo) {
  Make("datum:10m,1deg,map");
  EXPECT_THAT(Drive("a.csv", 0.0, 0.0), ElementsAre(0));
  EXPECT_THAT(Drive("b.csv", 20.0, 10.0), ElementsAre(0));
}

TEST_F(RecordingStartsTest, FirstFileBehindStoredPosesIsNotTheFirst) {
  Make("after");
  starts_->BeginFile("b.csv");
  starts_->ContinueFrom(std::nullopt, {});
  EXPECT_TRUE(Next(Pose(0.0, 0.0)).has_value());
  Make("");
  starts_->BeginFile("b.csv");
  starts_->ContinueFrom(RecordingStarts::Place{{-30.0, 0.0, 0.0}, {}}, {});
  EXPECT_FALSE(Next(Pose(31.0, 0.0)).has_value());
}

TEST_F(RecordingStartsTest, RestartWithinAFileIsAfterWhateverTheFilesDatum) {
  Sample back = Pose(0.0, 100.0);
  back.restarts = true;
  Make("");
  Drive("odom.csv", 0.0, 0.0);
  const auto begun = Next(back);
  ASSERT_TRUE(begun.has_value());
  EXPECT_EQ(begun->start.relation_case(), v1::RecordingStart::RELATION_NOT_SET);
  EXPECT_THAT(begun->note, HasSubstr("odom.csv:7: the odometry is back at its "
                                     "start"));
  Make("datum:1m,1deg");
  Drive("odom.csv", 0.0, 0.0);
  EXPECT_EQ(Next(back)->start.relation_case(),
            v1::RecordingStart::RELATION_NOT_SET);
  Make("unknown");
  Drive("odom.csv", 0.0, 0.0);
  EXPECT_TRUE(Next(back)->start.unknown());
  Make("same");
  Drive("odom.csv", 0.0, 0.0);
  EXPECT_FALSE(Next(back).has_value());
}

TEST_F(RecordingStartsTest, StartThatAFileStatesIsTaken) {
  Make("", /*looks_at_poses=*/false);
  starts_->BeginFile("a.tum");
  Sample stated = Pose(0.0, 0.0);
  stated.recording_start = R"({"label":"b","unknown":true})";
  const auto begun = Next(stated);
  ASSERT_TRUE(begun.has_value());
  EXPECT_EQ(begun->start.label(), "b");
  EXPECT_TRUE(begun->start.unknown());
  stated.recording_start = R"({"labels":1})";
  const auto wrong = starts_->Next(stated);
  EXPECT_EQ(wrong.status().code(), absl::StatusCode::kInvalidArgument);
  EXPECT_THAT(std::string(wrong.status().message()), HasSubstr("a.tum:7"));
  Make("same");
  EXPECT_FALSE(Next(stated).has_value());
}

TEST_F(RecordingStartsTest, LabelOfALongNameIsCutBetweenCharacters) {
  Make("after");
  Drive("a.csv", 0.0, 0.0);
  std::string name = "x";
  for (int i = 0; i < 200; ++i) name += "\u00e9";
  starts_->BeginFile(name + ".csv");
  const std::string label = Next(Pose(0.0, 0.0))->start.label();
  EXPECT_EQ(label, name.substr(0, 255));
}

}  // namespace
}  // namespace revisit::client
