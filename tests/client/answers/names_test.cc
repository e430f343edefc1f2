#include "client/answers/names.h"

#include <map>
#include <string>

#include "gtest/gtest.h"
#include "revisit/v1/candidate.pb.h"

namespace revisit::client {
namespace {

// All values have words, and each its own.
template <typename Enum>
void ExpectWordsOfTheirOwn(const google::protobuf::EnumDescriptor* reasons) {
  std::map<std::string, std::string> reasons_by_words;
  for (int i = 0; i < reasons->value_count(); ++i) {
    const auto* const reason = reasons->value(i);
    const auto [other, is_new] = reasons_by_words.emplace(
        Explain(static_cast<Enum>(reason->number())), reason->name());
    EXPECT_TRUE(is_new) << reason->name() << " and " << other->second << ": "
                        << other->first;
  }
}

TEST(ExplainTest, EveryReasonOfTheServiceHasWordsOfItsOwn) {
  ExpectWordsOfTheirOwn<v1::EmptyReason>(v1::EmptyReason_descriptor());
  ExpectWordsOfTheirOwn<v1::UnsearchedReason>(
      v1::UnsearchedReason_descriptor());
}

TEST(ExplainTest, ReasonsOfNewerServersCountAsNone) {
  EXPECT_EQ(Explain(static_cast<v1::EmptyReason>(1000)),
            Explain(v1::EMPTY_REASON_UNSPECIFIED));
  EXPECT_EQ(Explain(static_cast<v1::UnsearchedReason>(1000)),
            Explain(v1::UNSEARCHED_REASON_UNSPECIFIED));
}

}  // namespace
}  // namespace revisit::client
