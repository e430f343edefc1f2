#include "server/conversion/pose_pairs.h"

#include <string>
#include <vector>

#include "gmock/gmock.h"
#include "google/protobuf/util/message_differencer.h"
#include "gtest/gtest.h"
#include "server/records/pair_content.h"
#include "tests/server/conversion/conversion_testing.h"
#include "tests/server/error_matchers.h"

namespace revisit::server {
namespace {

using ::testing::ElementsAre;

// Decodes the pair; returns its id or, if it is refused, the fields that are
// wrong.
template <typename Pair>
std::vector<std::string> Decoded(const std::string& text,
                                 const std::string& id) {
  const Pair pair = FromText<Pair>(text);
  const auto record = DecodePosePair(&pair, id, "");
  if (!record.ok()) return FieldsOf(record.status());
  EXPECT_EQ(record->query_sequence, pair.query_sequence());
  EXPECT_EQ(record->matched_sequence, pair.matched_sequence());
  return {record->id};
}

TEST(PosePairTest, TakesItsIdFromTheSequencesUnlessItIsGiven) {
  const std::string pair = "query_sequence: 9 matched_sequence: 3";
  EXPECT_THAT(Decoded<v1::LoopClosure>(pair, ""), ElementsAre("9-3"));
  EXPECT_THAT(Decoded<v1::RejectedCandidate>(pair, ""), ElementsAre("9-3"));
  EXPECT_THAT(Decoded<v1::RejectedCandidate>(pair, "mine"),
              ElementsAre("mine"));
}

TEST(PosePairTest, NamesTheFieldsThatAreWrong) {
  EXPECT_THAT(Decoded<v1::RejectedCandidate>("", ""),
              ElementsAre("rejected_candidate.query_sequence",
                          "rejected_candidate.matched_sequence"));
  EXPECT_THAT(Decoded<v1::RejectedCandidate>(
                  "query_sequence: 3 matched_sequence: 3", ""),
              ElementsAre("rejected_candidate.matched_sequence"));
  EXPECT_THAT(Decoded<v1::RejectedCandidate>(
                  "query_sequence: 3 matched_sequence: 2", "No"),
              ElementsAre("rejected_candidate_id"));
  EXPECT_THAT(
      Decoded<v1::LoopClosure>("query_sequence: 3 matched_sequence: 2", "No"),
      ElementsAre("loop_closure_id"));
  const v1::RejectedCandidate* const left_out = nullptr;
  EXPECT_THAT(FieldsOf(DecodePosePair(left_out, "", "").status()),
              ElementsAre("rejected_candidate"));
}

TEST(PosePairTest, AnswersWithNameAndTime) {
  const PosePairRecord record{"9-3", 9, 3, -1};
  v1::LoopClosure closure;
  EncodePosePair("a", record, &closure);
  EXPECT_EQ(closure.name(), "vehicles/a/loopClosures/9-3");
  v1::RejectedCandidate rejected;
  EncodePosePair("a", record, &rejected);
  EXPECT_TRUE(google::protobuf::util::MessageDifferencer::Equals(
      rejected, FromText<v1::RejectedCandidate>(R"pb(
        name: "vehicles/a/rejectedCandidates/9-3"
        query_sequence: 9
        matched_sequence: 3
        create_time { seconds: -1 nanos: 999999999 }
      )pb")))
      << rejected.DebugString();
}

TEST(PosePairTest, DeletedOneIsAnsweredAsItWasWithWhoDeletedIt) {
  PairContent content;
  content.note = "a bridge";
  content.decided_by = "token:eva";
  content.deleted_by = "token:tom";
  DeletedPairRecord record{
      7,
      PairKind::kRejectedCandidate,
      {"9-3", 9, 3, 1'000'000'000, EncodePairContent(content)},
      2'000'000'000};
  v1::DeletedPosePair message;
  EncodeDeletedPair("a", record, &message);
  EXPECT_TRUE(google::protobuf::util::MessageDifferencer::Equals(
      message, FromText<v1::DeletedPosePair>(R"pb(
        name: "vehicles/a/deletedPosePairs/7"
        rejected_candidate {
          name: "vehicles/a/rejectedCandidates/9-3"
          query_sequence: 9
          matched_sequence: 3
          create_time { seconds: 1 }
          note: "a bridge"
          decided_by: "token:eva"
        }
        delete_time { seconds: 2 }
        deleted_by: "token:tom"
      )pb")))
      << message.DebugString();
  record.kind = PairKind::kLoopClosure;
  v1::DeletedPosePair other;
  EncodeDeletedPair("a", record, &other);
  EXPECT_EQ(other.loop_closure().name(), "vehicles/a/loopClosures/9-3");
}

}  // namespace
}  // namespace revisit::server
