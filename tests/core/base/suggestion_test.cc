#include "core/base/suggestion.h"

#include <string>
#include <vector>

#include "gtest/gtest.h"

namespace revisit {
namespace {

TEST(SuggestionTest, CountsLettersThatDiffer) {
  EXPECT_EQ(EditDistance("stream", "stream"), 0u);
  EXPECT_EQ(EditDistance("stram", "stream"), 1u);
  EXPECT_EQ(EditDistance("stremas", "streams"), 1u);
  EXPECT_EQ(EditDistance("", "abc"), 3u);
  EXPECT_EQ(EditDistance("shwow", "show"), 1u);
  EXPECT_EQ(EditDistance("fnid it", "find"), 4u);
}

TEST(SuggestionTest, MistypedWordIsToldWithWhatIsAllowed) {
  EXPECT_EQ(MistypedWord("shwo", {"find", "show"}),
            "got \"shwo\"; did you mean show? allowed is find, show");
  EXPECT_EQ(MistypedWord("x", {"find", "show"}),
            "got \"x\"; allowed is find, show");
}

TEST(SuggestionTest, NamesTheNearestWordAndNoneThatIsFar) {
  const std::vector<std::string> known = {"stream", "show", "find", "vehicle"};
  EXPECT_EQ(Suggestion("stram", known), "stream");
  EXPECT_EQ(Suggestion("hsow", known), "show");
  EXPECT_EQ(Suggestion("veh", known), "vehicle");
  EXPECT_EQ(Suggestion("bogus", known), "");
  EXPECT_EQ(Suggestion("", known), "");
}

}  // namespace
}  // namespace revisit
