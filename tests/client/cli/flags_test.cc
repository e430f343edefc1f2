#include "client/cli/flags.h"

#include <cstdlib>
#include <string>
#include <utility>
#include <vector>

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "nlohmann/json.hpp"

namespace revisit::client {
namespace {

using ::testing::ElementsAre;
using ::testing::HasSubstr;

// A program with a few commands.
class FlagsTest : public ::testing::Test {
 protected:
  FlagsTest() : line_({"bar", "Serves drinks.", "", "  bar coffee filter"}) {
    line_.program().AddText("--room", "NAME", &room_, "Which room");
    const Command coffee = line_.program().AddCommand(
        {"coffee", "Brews coffee.", "", "  bar coffee filter"});
    coffee
        .AddChoice("KIND", {{"espresso", 0}, {"filter", 1}}, &kind_,
                   "What to brew")
        .Required();
    coffee.AddNumber("--grind", "MM", &grind_, "How coarse");
    coffee.RunsAlone([](const Terminal&) { return absl::OkStatus(); });
    line_.program().AddCommand({"tea", "Brews tea.", "", ""});
  }

  // The problem with the usage of these words.
  std::string Wrong(std::vector<const char*> words) {
    words.insert(words.begin(), "bar");
    const auto parsed =
        line_.Parse(static_cast<int>(words.size()), words.data());
    EXPECT_EQ(ExitCodeOf(parsed.status()), 64);
    return std::string(parsed.status().message());
  }

  std::string room_;
  int kind_ = 0;
  double grind_ = 0.4;
  CommandLine line_;
};

TEST_F(FlagsTest, CommandIsChosenWithItsFlags) {
  const char* words[] = {"bar",     "coffee",  "filter", "--room",
                         "terrace", "--grind", "0.8"};
  const auto parsed = line_.Parse(7, words);
  ASSERT_TRUE(parsed.ok());
  EXPECT_NE(parsed->run_alone, nullptr);
  EXPECT_EQ(parsed->run, nullptr);
  EXPECT_EQ(room_, "terrace");
  EXPECT_EQ(kind_, 1);
  EXPECT_EQ(grind_, 0.8);
}

TEST_F(FlagsTest, EmptyValueTakesNoOtherWord) {
  room_ = "terrace";
  const char* words[] = {"bar", "coffee", "filter", "--room=", "--grind=0.8"};
  ASSERT_TRUE(line_.Parse(5, words).ok());
  EXPECT_EQ(room_, "");
  EXPECT_EQ(grind_, 0.8);
}

TEST_F(FlagsTest, EmptyValueIsRefusedWhereAnotherIsNeeded) {
  EXPECT_EQ(Wrong({"coffee", "filter", "--grind=", "--room=terrace"}),
            "--grind: got \"\"; allowed is a finite number");
}

TEST_F(FlagsTest, ValueIsRefusedOfAFlagThatTakesNone) {
  EXPECT_EQ(Wrong({"coffee", "filter", "--json=yes"}),
            "--json: got \"yes\"; allowed is no value");
}

TEST_F(FlagsTest, TextIsReadByWhoeverWantsIt) {
  std::string milk;
  line_.program().AddText(
      "--milk", "KIND",
      [&](const std::string& text) -> std::string {
        milk = text;
        return text == "oat" ? "" : "oat";
      },
      "Which milk");
  const char* words[] = {"bar", "coffee", "filter", "--milk", "oat"};
  EXPECT_TRUE(line_.Parse(5, words).ok());
  EXPECT_EQ(milk, "oat");
}

TEST_F(FlagsTest, ChoiceIsRepeatedWithAWordEach) {
  std::vector<int> cups;
  line_.program().AddRepeatedChoice(
      "--cup", {{"small", 1}, {"large", 2}},
      [&](int cup) { cups.push_back(cup); }, "Which cups");
  const char* words[] = {"bar",   "--cup",  "large", "--cup",
                         "small", "coffee", "filter"};
  EXPECT_TRUE(line_.Parse(7, words).ok());
  EXPECT_THAT(cups, ElementsAre(2, 1));
  const CommandUsage usage = line_.Usage();
  EXPECT_TRUE(usage.flags.back().repeated);
  EXPECT_THAT(usage.flags.back().choices, ElementsAre("large", "small"));
}

TEST_F(FlagsTest, TextThatIsWrongIsRefused) {
  line_.program().AddText(
      "--milk", "KIND", [](const std::string&) { return "oat"; }, "Which milk");
  EXPECT_EQ(Wrong({"coffee", "filter", "--milk", "soy"}),
            "--milk: got \"soy\"; allowed is oat");
}

TEST_F(FlagsTest, HelpIsThatOfTheCommand) {
  const char* words[] = {"bar", "coffee", "--help"};
  const auto parsed = line_.Parse(3, words);
  ASSERT_TRUE(parsed.ok());
  ASSERT_TRUE(parsed->help.has_value());
  EXPECT_EQ(parsed->help->path, "bar coffee");
}

TEST_F(FlagsTest, MistypedCommandIsToldWithWhatWasMeant) {
  EXPECT_EQ(Wrong({"cofee"}),
            "got \"cofee\"; did you mean coffee? allowed is coffee, tea");
}

TEST_F(FlagsTest, MistypedFlagIsToldWithWhatWasMeant) {
  EXPECT_EQ(Wrong({"coffee", "filter", "--gring=0.2"}),
            "got \"--gring\", which is no flag of bar coffee; did you mean "
            "--grind?");
}

TEST_F(FlagsTest, FlagOfTheProgramIsMeantToo) {
  EXPECT_THAT(Wrong({"coffee", "--rom", "x"}),
              HasSubstr("did you mean --room?"));
}

TEST_F(FlagsTest, WordTooManyIsTold) {
  EXPECT_EQ(Wrong({"coffee", "filter", "now"}),
            "got \"now\", which bar coffee has no place for");
}

TEST_F(FlagsTest, UsageHasEveryFlagWithItsValue) {
  const CommandUsage usage = line_.Usage();
  ASSERT_EQ(usage.commands.size(), 2u);
  const CommandUsage& coffee = *usage.Find("coffee");
  ASSERT_EQ(coffee.flags.size(), 4u);
  EXPECT_THAT(coffee.flags[0].names, ElementsAre("-h", "--help"));
  EXPECT_EQ(coffee.flags[0].value, "");
  EXPECT_EQ(coffee.flags[1].word, "KIND");
  EXPECT_THAT(coffee.flags[1].choices, ElementsAre("espresso", "filter"));
  EXPECT_TRUE(coffee.flags[1].required);
  EXPECT_EQ(coffee.flags[2].value, "MM");
  EXPECT_EQ(coffee.flags[2].default_value, "0.4");
  EXPECT_THAT(coffee.flags[3].names, ElementsAre("-o"));
  EXPECT_THAT(coffee.flags[3].choices, ElementsAre("json", "text"));
}

// The format that these words ask for.
class OutputFormatTest
    : public ::testing::TestWithParam<
          std::pair<std::vector<const char*>, OutputFormat>> {};

TEST_P(OutputFormatTest, IsWhatTheWordsSay) {
  CommandLine line({"bar", "Serves drinks.", "", ""});
  const Command menu = line.program().AddCommand({"menu", "Lists.", "", ""});
  menu.AlsoPrints({OutputFormat::kWide, OutputFormat::kName});
  menu.RunsAlone([](const Terminal&) { return absl::OkStatus(); });
  std::vector<const char*> words = GetParam().first;
  words.insert(words.begin(), "bar");
  const auto parsed = line.Parse(static_cast<int>(words.size()), words.data());
  ASSERT_TRUE(parsed.ok()) << parsed.status();
  EXPECT_EQ(parsed->format, GetParam().second);
}

INSTANTIATE_TEST_SUITE_P(
    AllSpellings, OutputFormatTest,
    ::testing::Values(std::pair{std::vector<const char*>{"menu"},
                                OutputFormat::kText},
                      std::pair{std::vector<const char*>{"menu", "-o", "text"},
                                OutputFormat::kText},
                      std::pair{std::vector<const char*>{"menu", "-o", "json"},
                                OutputFormat::kJson},
                      std::pair{std::vector<const char*>{"menu", "-o=json"},
                                OutputFormat::kJson},
                      std::pair{std::vector<const char*>{"menu", "-ojson"},
                                OutputFormat::kJson},
                      std::pair{std::vector<const char*>{"menu", "--json"},
                                OutputFormat::kJson},
                      std::pair{std::vector<const char*>{"--json", "menu"},
                                OutputFormat::kJson},
                      std::pair{std::vector<const char*>{"menu", "-o", "wide"},
                                OutputFormat::kWide},
                      std::pair{std::vector<const char*>{"menu", "-o", "name"},
                                OutputFormat::kName}));

TEST_F(FlagsTest, FormatThatACommandHasNotIsRefusedWithThoseThatItHas) {
  EXPECT_EQ(Wrong({"coffee", "filter", "-o", "wide"}),
            "-o: got \"wide\"; allowed is json, text");
}

TEST_F(FlagsTest, FormatIsAskedForOnce) {
  EXPECT_EQ(Wrong({"coffee", "filter", "-o", "text", "--json"}),
            "-o, --json: one of them only");
}

TEST_F(FlagsTest, FlagOfACommandBeforeItIsToldWhereItStands) {
  EXPECT_EQ(Wrong({"-o", "json", "coffee", "filter"}),
            "got \"-o\" before the command; it stands behind bar coffee");
}

TEST_F(FlagsTest, WhatTheEnvironmentGivesIsNotTyped) {
  std::string milk;
  line_.program()
      .AddText("--milk", "KIND", &milk, "Which milk")
      .OrEnvironment("REVISIT_TEST_MILK");
  setenv("REVISIT_TEST_MILK", "oat", 1);
  const char* words[] = {"bar", "coffee", "filter", "--room", "terrace"};
  EXPECT_TRUE(line_.Parse(5, words).ok());
  unsetenv("REVISIT_TEST_MILK");
  EXPECT_EQ(milk, "oat");
  EXPECT_TRUE(line_.program().Given("--milk"));
  EXPECT_FALSE(line_.program().Typed("--milk"));
  EXPECT_TRUE(line_.program().Typed("--room"));
}

TEST(AsksForJsonTest, AlsoOfALineThatCannotBeParsed) {
  const auto asks = [](std::vector<const char*> words) {
    return AsksForJson(static_cast<int>(words.size()), words.data());
  };
  EXPECT_TRUE(asks({"bar", "tee", "-o", "json"}));
  EXPECT_TRUE(asks({"bar", "-ojson"}));
  EXPECT_TRUE(asks({"bar", "-o=json"}));
  EXPECT_TRUE(asks({"bar", "--json", "tee"}));
  EXPECT_FALSE(asks({"bar", "json", "-o", "wide"}));
  EXPECT_FALSE(asks({"bar", "-o"}));
}

TEST(UsageErrorTest, IsJsonWithItsReason) {
  const auto error = nlohmann::json::parse(
      ErrorToJson(UsageError("got \"x\"", "bar --help tells more")))["error"];
  EXPECT_EQ(error["code"], "INVALID_ARGUMENT");
  EXPECT_EQ(error["reason"], "USAGE");
  EXPECT_EQ(error["message"], "got \"x\"");
  EXPECT_EQ(error["hint"], "bar --help tells more");
}

}  // namespace
}  // namespace revisit::client
