#include "server/security/caller.h"

#include "gmock/gmock.h"
#include "gtest/gtest.h"

namespace revisit::server {
namespace {

using ::testing::ElementsAre;
using ::testing::IsEmpty;

constexpr auto kRead = static_cast<std::uint8_t>(Verb::kRead);
constexpr auto kWrite = static_cast<std::uint8_t>(Verb::kWrite);

Caller With(std::vector<Grant> grants) {
  Caller caller;
  caller.grants = std::move(grants);
  return caller;
}

TEST(CallerTest, GlobMatchesTheWholeText) {
  const struct {
    const char* pattern;
    const char* text;
    bool matches;
  } kCases[] = {
      {"", "", true},          {"", "a", false},       {"*", "", true},
      {"*", "anything", true}, {"a", "a", true},       {"a", "ab", false},
      {"a", "ba", false},      {"a*", "a", true},      {"a*", "abc", true},
      {"a*", "ba", false},     {"*c", "abc", true},    {"*c", "abcd", false},
      {"a*c", "ac", true},     {"a*c", "abbc", true},  {"a*c", "abcb", false},
      {"*b*", "abc", true},    {"*ab*", "aab", true},  {"a**b", "axb", true},
      {"*aab", "aaab", true},  {"a*b*c", "abc", true}, {"a*b*c", "acb", false},
  };
  for (const auto& test : kCases) {
    EXPECT_EQ(MatchesGlob(test.pattern, test.text), test.matches)
        << "'" << test.pattern << "' on '" << test.text << "'";
  }
}

TEST(CallerTest, GlobOfManyStarsTakesNoTime) {
  std::string pattern;
  for (int i = 0; i < 60; ++i) pattern += "*a";
  EXPECT_FALSE(MatchesGlob(pattern + "b", std::string(10000, 'a')));
}

TEST(CallerTest, WithoutGrantsMayDoEverything) {
  const Caller caller;
  EXPECT_TRUE(caller.MaySee("a"));
  EXPECT_TRUE(caller.May(Verb::kAdmin, "a"));
  EXPECT_THAT(caller.PrefixesOf(Verb::kRead), ElementsAre(""));
}

TEST(CallerTest, WithAnEmptyListOfGrantsMayDoNothing) {
  const Caller caller = With({});
  EXPECT_FALSE(caller.MaySee("a"));
  EXPECT_FALSE(caller.May(Verb::kRead, "a"));
  EXPECT_THAT(caller.PrefixesOf(Verb::kRead), IsEmpty());
}

TEST(CallerTest, PatternsDoNotReachBeyondTheTenantsPrefix) {
  const Caller caller = With({{"acme-", {"*", "umbra-1"}, kRead}});
  EXPECT_TRUE(caller.MaySee("acme-1"));
  EXPECT_FALSE(caller.MaySee("umbra-1"));
  EXPECT_FALSE(caller.MaySee("acme"));
}

TEST(CallerTest, VerbsDoNotIncludeOneAnother) {
  const Caller caller =
      With({{"a-", {"a-1*"}, kRead}, {"a-", {"a-2"}, kWrite}});
  EXPECT_TRUE(caller.May(Verb::kRead, "a-17"));
  EXPECT_FALSE(caller.May(Verb::kWrite, "a-17"));
  EXPECT_TRUE(caller.May(Verb::kWrite, "a-2"));
  EXPECT_FALSE(caller.May(Verb::kRead, "a-2"));
  EXPECT_TRUE(caller.MaySee("a-2"));
  EXPECT_FALSE(caller.May(Verb::kAdmin, "a-2"));
}

TEST(CallerTest, PrefixesCoverWhatIsGrantedOnce) {
  const Caller caller = With({{"a-", {"*", "a-1*"}, kRead},
                              {"a-", {"b-*"}, kRead},
                              {"a-", {"a-2*"}, kWrite}});
  EXPECT_THAT(caller.PrefixesOf(Verb::kRead), ElementsAre("a-"));
  EXPECT_THAT(caller.PrefixesOf(Verb::kWrite), ElementsAre("a-2"));
  EXPECT_THAT(caller.PrefixesOf(Verb::kAdmin), IsEmpty());
  EXPECT_THAT(With({{"", {"b*", "a-1", "ba*", "a-1-*"}, kRead}})
                  .PrefixesOf(Verb::kRead),
              ElementsAre("a-1", "b"));
}

}  // namespace
}  // namespace revisit::server
