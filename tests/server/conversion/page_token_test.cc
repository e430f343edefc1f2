#include "server/conversion/page_token.h"

#include <string>

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "server/base/sequences.h"
#include "tests/server/error_matchers.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using ::testing::StartsWith;

TEST(PageTokenTest, GivesBackItsKey) {
  for (const std::string& key :
       {std::string("1"), std::string("a-b"), std::string(63, 'z')}) {
    EXPECT_EQ(ParsePageToken("list", MakePageToken("list", key)).value(), key);
  }
  EXPECT_EQ(ParsePageToken("list", "").value(), "");
}

TEST(PageTokenTest, GivesBackItsSequence) {
  for (const std::uint64_t sequence :
       {std::uint64_t{1}, std::uint64_t{1000}, kMaxSequence}) {
    EXPECT_EQ(
        ParseSequenceToken("list", MakePageToken("list", sequence)).value(),
        sequence);
  }
  EXPECT_EQ(ParseSequenceToken("list", "").value(), 0u);
}

TEST(PageTokenTest, RefusesWhatNoListHasAsAKeyThoughTheSealIsRight) {
  const auto refused =
      IsError(StatusCode::kInvalidArgument, "INVALID_PAGE_TOKEN",
              StartsWith("page_token: "));
  for (const std::string& key :
       {std::string("0"), std::string("-1"), std::string("+1"),
        std::string("01"), std::string(" 1"), std::string("1 "),
        std::string("1\0", 2), std::string("a"), std::string("0x1"),
        std::string("9223372036854775808"), std::string("18446744073709551615"),
        std::string("99999999999999999999"), std::string(1000, '1')}) {
    EXPECT_THAT(ParseSequenceToken("list", MakePageToken("list", key)), refused)
        << key;
  }
  for (const std::string& key :
       {std::string("\0\n\xff", 3), std::string("A"), std::string("a b"),
        std::string("%"), std::string("a'"), std::string(1000, 'a')}) {
    EXPECT_THAT(ParsePageToken("list", MakePageToken("list", key)), refused)
        << key;
  }
}

TEST(PageTokenTest, RefusesTokensThatWereNotIssuedForTheList) {
  const std::string token = MakePageToken("list a", "key");
  for (const std::string& other :
       {MakePageToken("list b", "key"), token + "A", token.substr(1),
        std::string("x"), std::string("AAAAAAAAAAAAAAAA"), std::string("é"),
        std::string(10000, 'A')}) {
    EXPECT_THAT(ParsePageToken("list a", other),
                IsError(StatusCode::kInvalidArgument, "INVALID_PAGE_TOKEN",
                        StartsWith("page_token: ")))
        << other;
  }
}

TEST(PageTokenTest, RefusesATokenWithAnyCharacterChanged) {
  const std::string token = MakePageToken("list", "123456");
  for (std::size_t i = 0; i < token.size(); ++i) {
    std::string changed = token;
    changed[i] = changed[i] == 'Q' ? 'g' : 'Q';
    EXPECT_THAT(ParsePageToken("list", changed),
                IsError(StatusCode::kInvalidArgument, "INVALID_PAGE_TOKEN",
                        StartsWith("page_token: ")))
        << i;
  }
}

TEST(PageSizeTest, FollowsItsRules) {
  EXPECT_EQ(PageSize(0, 100, 1000).value(), 100);
  EXPECT_EQ(PageSize(1, 100, 1000).value(), 1);
  EXPECT_EQ(PageSize(1000, 100, 1000).value(), 1000);
  EXPECT_EQ(PageSize(1001, 100, 1000).value(), 1000);
  EXPECT_THAT(PageSize(-1, 100, 1000),
              IsError(StatusCode::kInvalidArgument, "INVALID_FIELD",
                      StartsWith("page_size: got -1")));
}

}  // namespace
}  // namespace revisit::server
