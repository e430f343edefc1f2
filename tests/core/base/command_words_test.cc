#include "core/base/command_words.h"

#include <string>
#include <vector>

#include "CLI/CLI.hpp"
#include "gmock/gmock.h"
#include "gtest/gtest.h"

namespace revisit {
namespace {

using ::testing::ElementsAre;
using ::testing::ElementsAreArray;

// A program with a flag of each kind, and a command with one of its own.
class CommandWordsTest : public ::testing::Test {
 protected:
  CommandWordsTest() {
    app_.add_option("--room,-r", room_);
    app_.add_flag("--json", json_);
    coffee_->add_option("--grind", grind_);
    coffee_->add_flag("--milk,!--no-milk", milk_);
  }

  CommandWords Separated(const std::vector<std::string>& words) {
    return SeparatedValues(app_, words);
  }

  CLI::App app_{"", "bar"};
  CLI::App* const coffee_ = app_.add_subcommand("coffee");
  std::string room_;
  std::string grind_;
  bool json_ = false;
  bool milk_ = false;
};

TEST_F(CommandWordsTest, EmptyValueIsAWordOfItsOwn) {
  EXPECT_THAT(Separated({"--room=", "coffee", "--grind=", "-r="}).words,
              ElementsAre("--room", "", "coffee", "--grind", "", "-r", ""));
}

TEST_F(CommandWordsTest, OtherWordsStayAsTheyAre) {
  for (const std::vector<std::string>& words :
       std::vector<std::vector<std::string>>{
           {},
           {"--room=terrace", "coffee", "--grind", "2", "filter", "--json"},
           {"coffee", "--room", "a=", "-rb", "--no-milk", "-2", "-"},
           // Other flags and commands than there are.
           {"--rom=", "tea", "--grind="},
           // Values that look like flags and commands.
           {"--room", "--json=yes", "--room", "coffee", "--milk=yes"},
           {"coffee", "--", "--room=", "--json=yes"},
           {"coffee", "--room"}}) {
    const CommandWords separated = Separated(words);
    EXPECT_EQ(separated.problem, "");
    EXPECT_THAT(separated.words, ElementsAreArray(words));
  }
}

TEST_F(CommandWordsTest, ValueOfAFlagThatTakesNoneIsToldWithItsCommand) {
  const CommandWords of_program = Separated({"--json=yes", "coffee"});
  EXPECT_EQ(of_program.problem, "--json: got \"yes\"; allowed is no value");
  EXPECT_EQ(of_program.command, &app_);
  const CommandWords of_command = Separated({"coffee", "--no-milk="});
  EXPECT_EQ(of_command.problem, "--no-milk: got \"\"; allowed is no value");
  EXPECT_EQ(of_command.command, coffee_);
}

}  // namespace
}  // namespace revisit
