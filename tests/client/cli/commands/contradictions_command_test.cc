#include "client/cli/commands/contradictions_command.h"

#include "gmock/gmock.h"
#include "nlohmann/json.hpp"
#include "tests/client/cli/commands/command_test.h"

namespace revisit::client {
namespace {

class ContradictionsCommandTest : public CommandTest {
 protected:
  ContradictionsCommandTest() {
    v1::FindContradictionsResponse found;
    const auto add = [&found](const std::string& id, double p_value) {
      v1::Contradiction* const one = found.add_contradictions();
      one->set_loop_closure("vehicles/shuttle/loopClosures/" + id);
      one->set_p_value(p_value);
    };
    add("150-20", 1.5e-7);
    add("gone", 0.004);
    found.set_revision(12);
    server_.set_contradictions(found);
  }
};

TEST_F(ContradictionsCommandTest, TableHasThePosesAndWhoDecided) {
  ASSERT_TRUE(RunContradictions(client_, "shuttle", Text()).ok());
  EXPECT_EQ(out_.str(),
            "ID      P-VALUE  QUERY_SEQ  MATCHED_SEQ  CREATED               "
            "DECIDED_BY  NOTE\n"
            "150-20  1.5e-07        150           20  1970-01-01T00:00:00Z  "
            "token:eva\n"
            "gone      0.004          -            -  -                     "
            "-\n");
}

TEST_F(ContradictionsCommandTest, NamesAreThoseOfTheClosuresAndJsonTheAnswer) {
  ASSERT_TRUE(
      RunContradictions(client_, "shuttle", As(OutputFormat::kName)).ok());
  EXPECT_EQ(out_.str(),
            "vehicles/shuttle/loopClosures/150-20\n"
            "vehicles/shuttle/loopClosures/gone\n");
  out_.str("");
  ASSERT_TRUE(RunContradictions(client_, "shuttle", Json()).ok());
  const auto found = nlohmann::json::parse(out_.str());
  EXPECT_EQ(found["contradictions"][1]["pValue"], 0.004);
  EXPECT_EQ(found["revision"], 12);
}

}  // namespace
}  // namespace revisit::client
