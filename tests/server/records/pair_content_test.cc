#include "server/records/pair_content.h"

#include <limits>
#include <string>
#include <vector>

#include "core/drive/confirmed_loop.h"
#include "gmock/gmock.h"
#include "google/protobuf/util/message_differencer.h"
#include "gtest/gtest.h"
#include "server/conversion/loop_content.h"
#include "server/conversion/pose_pairs.h"
#include "server/fields/loop_measurement.h"
#include "tests/server/conversion/conversion_testing.h"
#include "tests/server/error_matchers.h"

namespace revisit::server {
namespace {

using ::testing::ElementsAre;
using ::testing::IsEmpty;

constexpr char kMeasured[] = R"pb(
  query_sequence: 9
  matched_sequence: 3
  measurement {
    x_meters: 1.5
    y_meters: -2
    z_meters: 0.25
    heading_radians: 3
    covariance {
      form: COVARIANCE_FORM_PLANAR_6
      values: [ 4, 0.1, 0.2, 5, 0.3, 0.06 ]
    }
  }
  note: "icp\n412"
  score: -0.5
)pb";

constexpr char kRejected[] = R"pb(
  query_sequence: 9
  matched_sequence: 3
  note: "another road:\n\ta bridge, with the crossing below"
)pb";

template <typename Pair>
std::string PayloadOf(const Pair& pair) {
  const auto record = DecodePosePair(&pair, "", "");
  EXPECT_THAT(record.status(), IsOk());
  return record.ok() ? record->payload : "";
}

template <typename Pair>
std::vector<std::string> WrongFields(const Pair& pair) {
  return FieldsOf(DecodePosePair(&pair, "", "").status());
}

template <typename Pair>
void ExpectAnsweredAsSent(const char* text) {
  const auto pair = FromText<Pair>(text);
  PosePairRecord record{"a", 9, 3, 0, PayloadOf(pair)};
  Pair answer;
  EncodePosePair("v", record, &answer);
  answer.clear_name();
  answer.clear_create_time();
  EXPECT_TRUE(google::protobuf::util::MessageDifferencer::Equals(answer, pair))
      << answer.DebugString();
}

TEST(PairContentTest, IsAnsweredAsItWasSent) {
  ExpectAnsweredAsSent<v1::LoopClosure>(kMeasured);
  ExpectAnsweredAsSent<v1::RejectedCandidate>(kRejected);
}

TEST(PairContentTest, HasTheDeciderThatTheServerKnowsWhateverWasSent) {
  auto sent = FromText<v1::LoopClosure>(kMeasured);
  sent.set_decided_by("token:somebody-else");
  PosePairRecord record = *DecodePosePair(&sent, "", "token:eva");
  v1::LoopClosure closure;
  EncodePosePair("v", record, &closure);
  EXPECT_EQ(closure.decided_by(), "token:eva");
  auto rejected = FromText<v1::RejectedCandidate>(kRejected);
  rejected.set_decided_by("token:somebody-else");
  v1::RejectedCandidate rejection;
  EncodePosePair("v", *DecodePosePair(&rejected, "", "certificate:a.example"),
                 &rejection);
  EXPECT_EQ(rejection.decided_by(), "certificate:a.example");
  EncodePosePair("v", *DecodePosePair(&rejected, "", ""), &rejection);
  EXPECT_EQ(rejection.decided_by(), "");
}

TEST(PairContentTest, SaysTheSameWhoeverDecided) {
  const auto payload = [](const std::string& note, const std::string& by) {
    PairContent content;
    content.note = note;
    content.decided_by = by;
    return EncodePairContent(content);
  };
  EXPECT_TRUE(PairContentsSayTheSame(payload("a", ""), payload("a", "")));
  EXPECT_TRUE(PairContentsSayTheSame(payload("a", "x"), payload("a", "y")));
  EXPECT_TRUE(PairContentsSayTheSame(payload("", "x"), ""));
  EXPECT_FALSE(PairContentsSayTheSame(payload("a", "x"), payload("b", "x")));
  EXPECT_FALSE(PairContentsSayTheSame("\xff", payload("", "x")));
}

TEST(PairContentTest, KeepsAllButWhoDeletedItWhenItIsDeleted) {
  const std::string before = PayloadOf(FromText<v1::LoopClosure>(kMeasured));
  const std::string payload = PairContentWithDeleter(before, "token:tom");
  PairContent content;
  ASSERT_THAT(ReadPairContent(payload,
                              [&](const PairContent& read) {
                                content = read;
                                content.measurement.reset();
                              }),
              IsOk());
  EXPECT_EQ(content.deleted_by, "token:tom");
  EXPECT_EQ(content.note, "icp\n412");
  EXPECT_EQ(content.score, -0.5);
  EXPECT_TRUE(
      DecodePairMeasurement(payload, core::StateSpace::kPlanar)->has_value());
  EXPECT_EQ(PairContentWithDeleter(before, ""), before);
}

TEST(PairContentTest, OfPosesAloneIsEmpty) {
  v1::LoopClosure closure;
  closure.set_query_sequence(9);
  closure.set_matched_sequence(3);
  EXPECT_EQ(PayloadOf(closure), "");
  // A score of 0 is a score.
  closure.set_score(0.0);
  EXPECT_NE(PayloadOf(closure), "");
  auto rejection = FromText<v1::RejectedCandidate>(kRejected);
  rejection.clear_note();
  EXPECT_EQ(PayloadOf(rejection), "");
}

TEST(PairContentTest, NoteTakesTheSameBytesOnBothKinds) {
  const auto rejection = FromText<v1::RejectedCandidate>(kRejected);
  v1::LoopClosure closure;
  closure.set_query_sequence(rejection.query_sequence());
  closure.set_matched_sequence(rejection.matched_sequence());
  closure.set_note(rejection.note());
  EXPECT_EQ(PayloadOf(rejection), PayloadOf(closure));
}

TEST(PairContentTest, RejectedCandidateHasNoMeasurement) {
  const auto measurement = DecodePairMeasurement(
      PayloadOf(FromText<v1::RejectedCandidate>(kRejected)),
      core::StateSpace::kPlanar);
  ASSERT_THAT(measurement.status(), IsOk());
  EXPECT_EQ(*measurement, std::nullopt);
}

TEST(PairContentTest, MeasurementIsThatOfCore) {
  const auto measurement =
      DecodePairMeasurement(PayloadOf(FromText<v1::LoopClosure>(kMeasured)),
                            core::StateSpace::kPlanar);
  ASSERT_THAT(measurement.status(), IsOk());
  ASSERT_TRUE(measurement->has_value());
  const core::LoopMeasurement& m = **measurement;
  EXPECT_EQ(m.relative.x, 1.5);
  EXPECT_EQ(m.relative.y, -2.0);
  EXPECT_EQ(m.relative.z, 0.25);
  EXPECT_EQ(m.relative.heading, 3.0);
  EXPECT_EQ(m.covariance(0, 1), 0.1);
  EXPECT_EQ(m.covariance(1, 3), 0.3);
  EXPECT_EQ(m.covariance(3, 3), 0.06);
  EXPECT_EQ(*DecodePairMeasurement("", core::StateSpace::kPlanar),
            std::nullopt);
}

TEST(PairContentTest, CovarianceHasToFitTheStateSpace) {
  const std::string planar = PayloadOf(FromText<v1::LoopClosure>(kMeasured));
  EXPECT_THAT(
      FieldsOf(
          DecodePairMeasurement(planar, core::StateSpace::kSpatial).status()),
      ElementsAre("loop_closure.measurement.covariance.form"));
  auto closure = FromText<v1::LoopClosure>(kMeasured);
  closure.mutable_measurement()->mutable_covariance()->set_values(0, -4.0);
  EXPECT_THAT(
      DecodePairMeasurement(PayloadOf(closure), core::StateSpace::kPlanar)
          .status(),
      IsError(absl::StatusCode::kInvalidArgument,
              "COVARIANCE_NOT_POSITIVE_DEFINITE",
              ::testing::HasSubstr("the variance of x is -4")));
}

TEST(PairContentTest, TextAndNumbersAreBounded) {
  auto closure = FromText<v1::LoopClosure>(kMeasured);
  closure.set_note(std::string(kMaxNoteBytes, 'a'));
  closure.mutable_measurement()->set_x_meters(-kMaxMeasuredMeters);
  closure.mutable_measurement()->set_heading_radians(1e6);
  EXPECT_THAT(WrongFields(closure), IsEmpty());
  closure.set_note(std::string(kMaxNoteBytes + 1, 'a'));
  closure.set_score(std::numeric_limits<double>::infinity());
  closure.mutable_measurement()->set_x_meters(-kMaxMeasuredMeters - 1.0);
  closure.mutable_measurement()->set_heading_radians(1.1e6);
  closure.mutable_measurement()->clear_covariance();
  EXPECT_THAT(WrongFields(closure),
              ElementsAre("loop_closure.measurement.x_meters",
                          "loop_closure.measurement.heading_radians",
                          "loop_closure.measurement.covariance",
                          "loop_closure.note", "loop_closure.score"));
  auto rejection = FromText<v1::RejectedCandidate>(kRejected);
  rejection.set_note(std::string(kMaxNoteBytes, 'a'));
  EXPECT_THAT(WrongFields(rejection), IsEmpty());
  rejection.set_note(std::string(kMaxNoteBytes + 1, 'a'));
  rejection.clear_query_sequence();
  EXPECT_THAT(WrongFields(rejection),
              ElementsAre("rejected_candidate.query_sequence",
                          "rejected_candidate.note"));
}

TEST(PairContentTest, ControlCharactersAreRefusedWhereverTheyStand) {
  auto closure = FromText<v1::LoopClosure>(kMeasured);
  auto rejection = FromText<v1::RejectedCandidate>(kRejected);
  for (const char* const good : {"a\tb\nc", "caf\xc3\xa9", "\xc2\xa0"}) {
    closure.set_note(good);
    EXPECT_THAT(WrongFields(closure), IsEmpty()) << good;
    rejection.set_note(good);
    EXPECT_THAT(WrongFields(rejection), IsEmpty()) << good;
  }
  for (const char* const bad :
       {"\x1b[0m", "a\rb", "\x7f", "\xc2\x80", "a\xc2\x9f"}) {
    closure.set_note(bad);
    EXPECT_THAT(WrongFields(closure), ElementsAre("loop_closure.note"));
    rejection.set_note(bad);
    EXPECT_THAT(WrongFields(rejection), ElementsAre("rejected_candidate.note"));
  }
}

TEST(PairContentTest, PayloadOfAnotherKindIsDataLoss) {
  EXPECT_THAT(
      DecodePairMeasurement("\xff", core::StateSpace::kPlanar).status(),
      IsError(absl::StatusCode::kDataLoss, "STORE_CORRUPT", ::testing::_));
  EXPECT_THAT(
      ReadPairContent("\xff",
                      [](const PairContent&) { ADD_FAILURE() << "is none"; }),
      IsError(absl::StatusCode::kDataLoss, "STORE_CORRUPT", ::testing::_));
}

}  // namespace
}  // namespace revisit::server
