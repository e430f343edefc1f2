#include "server/conversion/found_evidence.h"

#include <gtest/gtest.h>

#include <string>

#include "revisit/v1/candidate.pb.h"
#include "tests/server/conversion/conversion_testing.h"

namespace revisit::server {
namespace {

v1::CandidateSet Set() {
  return FromText<v1::CandidateSet>(R"(
      query { sequence: 9 }
      revision: 300
      candidates { rank: 1 score: 0.5 matched { sequence: 4 } }
      candidates { matched { sequence: 2 } rank: 2 verdict: VERDICT_ACCEPTED }
      candidates { score: 0.25 }
      nodes_considered: 77
      new_place_probability: 0.125)");
}

TEST(FoundEvidenceTest, IsTheCandidateOfTheRankByteByByte) {
  const v1::CandidateSet set = Set();
  const std::string bytes = set.SerializeAsString();
  for (int i = 0; i < set.candidates_size(); ++i) {
    const FoundEvidence found = FindEvidence(bytes, set.candidates(i).rank());
    EXPECT_EQ(found.evidence, set.candidates(i).SerializeAsString());
    EXPECT_EQ(found.revision, 300u);
  }
}

TEST(FoundEvidenceTest, IsEmptyWhereNoCandidateHasTheRank) {
  const FoundEvidence found = FindEvidence(Set().SerializeAsString(), 7);
  EXPECT_EQ(found.evidence, "");
  EXPECT_EQ(found.revision, 300u);
}

TEST(FoundEvidenceTest, OfBytesThatAreCutOffNothingIsRead) {
  const std::string bytes = Set().SerializeAsString();
  for (std::size_t size = 0; size < bytes.size(); ++size) {
    const std::string cut = bytes.substr(0, size);
    const FoundEvidence found = FindEvidence(cut, 1);
    v1::CandidateSet parsed;
    if (parsed.ParseFromString(cut)) {
      EXPECT_EQ(found.revision, parsed.revision()) << size;
    } else {
      EXPECT_EQ(found.revision, 0u) << size;
      EXPECT_EQ(found.evidence, "") << size;
    }
  }
}

}  // namespace
}  // namespace revisit::server
