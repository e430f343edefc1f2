#include "client/answers/names.h"

#include <map>
#include <string>

#include "gtest/gtest.h"
#include "revisit/v1/candidate.pb.h"

namespace revisit::client {
namespace {

TEST(ExplainTest, EveryReasonOfTheServiceHasWordsOfItsOwn) {
  const auto* const reasons = v1::EmptyReason_descriptor();
  std::map<std::string, std::string> reasons_by_words;
  for (int i = 0; i < reasons->value_count(); ++i) {
    const auto* const reason = reasons->value(i);
    const auto [other, is_new] = reasons_by_words.emplace(
        Explain(static_cast<v1::EmptyReason>(reason->number())),
        reason->name());
    EXPECT_TRUE(is_new) << reason->name() << " and " << other->second << ": "
                        << other->first;
  }
}

TEST(ExplainTest, ReasonsOfNewerServersCountAsNone) {
  EXPECT_EQ(Explain(static_cast<v1::EmptyReason>(1000)),
            Explain(v1::EMPTY_REASON_UNSPECIFIED));
}

}  // namespace
}  // namespace revisit::client
