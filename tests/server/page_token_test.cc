#include "server/page_token.h"

#include <string>

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "tests/server/error_matchers.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using ::testing::StartsWith;

TEST(PageTokenTest, GivesBackItsKey) {
  for (const std::string& key :
       {std::string("1"), std::string("a-b"), std::string("\0\n\xff", 3)}) {
    EXPECT_EQ(ParsePageToken("list", MakePageToken("list", key)).value(), key);
  }
  EXPECT_EQ(ParsePageToken("list", "").value(), "");
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
