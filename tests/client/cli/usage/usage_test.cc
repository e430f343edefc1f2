// The texts that are made of commands and flags.
#include "client/cli/usage/help_text.h"
#include "client/cli/usage/man_page.h"
#include "client/cli/usage/text_blocks.h"
#include "gmock/gmock.h"
#include "gtest/gtest.h"

namespace revisit::client {
namespace {

using ::testing::HasSubstr;
using ::testing::Not;

CommandUsage Coffee() {
  FlagUsage kind;
  kind.word = "KIND";
  kind.names = {"--kind"};
  kind.value = "espresso|filter";
  kind.choices = {"espresso", "filter"};
  kind.help = "What to brew";
  kind.heading = "Options";
  kind.required = true;
  FlagUsage grind;
  grind.names = {"-g", "--grind"};
  grind.value = "MM";
  grind.help = "How coarse the grains are that the mill makes of the beans";
  grind.default_value = "0.4";
  grind.environment = "GRIND";
  grind.heading = "Mill";
  CommandUsage coffee;
  coffee.path = "bar coffee";
  coffee.name = "coffee";
  coffee.summary = "Brews coffee.";
  coffee.details =
      "Kinds, of which there\nare two:\n  espresso  short\n"
      "  filter    long, and it takes its time, as everybody knows";
  coffee.examples = "  bar coffee espresso --grind 0.2 --grind 0.3 --grind 0.4";
  coffee.flags = {kind, grind};
  return coffee;
}

TEST(HelpTextTest, HasAllPartsWithinTheWidth) {
  EXPECT_EQ(HelpText(Coffee(), 45),
            "Brews coffee.\n"
            "\n"
            "Usage: bar coffee [OPTIONS] KIND\n"
            "\n"
            "Kinds, of which there are two:\n"
            "  espresso  short\n"
            "  filter    long, and it takes its time, as\n"
            "            everybody knows\n"
            "\n"
            "Arguments:\n"
            "  KIND, --kind espresso|filter\n"
            "    What to brew\n"
            "\n"
            "Mill:\n"
            "  -g, --grind MM  How coarse the grains are\n"
            "                  that the mill makes of the\n"
            "                  beans (0.4; env GRIND)\n"
            "\n"
            "Examples:\n"
            "  bar coffee espresso --grind 0.2 --grind \\\n"
            "      0.3 --grind 0.4\n"
            "\n"
            "It also takes the flags of bar --help, which\n"
            "every command takes.\n");
}

TEST(HelpTextTest, HiddenCommandsAreLeftOut) {
  CommandUsage bar;
  bar.path = bar.name = "bar";
  bar.summary = "Serves drinks.";
  bar.commands = {Coffee(), Coffee()};
  bar.commands[1].name = "secret";
  bar.commands[1].hidden = true;
  const std::string help = HelpText(bar, 80);
  EXPECT_THAT(help, HasSubstr("Usage: bar [OPTIONS] COMMAND\n"));
  EXPECT_THAT(help, HasSubstr("Commands:\n  coffee  Brews coffee.\n"));
  EXPECT_THAT(help, Not(HasSubstr("secret")));
}

TEST(TextBlocksTest, ParagraphsFlowAndElementsKeepTheirColumn) {
  const auto blocks = ParseText(
      "one\ntwo\n\nthree:\n  a    first\n"
      "       line\n  bc   second\nfour");
  ASSERT_EQ(blocks.size(), 5u);
  EXPECT_EQ(blocks[0].text, "one two");
  EXPECT_EQ(blocks[1].text, "three:");
  EXPECT_TRUE(blocks[1].after_gap);
  EXPECT_EQ(blocks[2].term, "a");
  EXPECT_EQ(blocks[2].text, "first line");
  EXPECT_EQ(blocks[3].text, "second");
  EXPECT_EQ(blocks[4].text, "four");
}

TEST(TextBlocksTest, ElementWithoutTextDoesNotMoveTheOthers) {
  EXPECT_EQ(LaidOut(ParseText("  a long one that is alone\n  b  text"), 16),
            "  a long one\n    that is\n    alone\n  b  text\n");
}

TEST(TextBlocksTest, LongWordHasALineOfItsOwn) {
  EXPECT_EQ(Wrapped("a incomprehensibility b", 10, "x ", 2),
            "x a\n  incomprehensibility\n  b\n");
}

TEST(ManPageTest, NothingOfTheTextIsTakenForACommandOfTheFormatter) {
  CommandUsage bar;
  bar.path = bar.name = "bar";
  bar.summary = "Serves 'drinks'.";
  bar.details = ".hidden and C:\\path";
  bar.commands = {Coffee()};
  const auto pages = ManPages(bar, {"2026-01-02", "bar 1"});
  ASSERT_EQ(pages.size(), 2u);
  EXPECT_EQ(pages[0].file, "bar.1");
  EXPECT_EQ(pages[1].file, "bar-coffee.1");
  EXPECT_THAT(pages[0].text, HasSubstr("\n\\&.hidden and C:\\epath\n"));
  EXPECT_THAT(pages[0].text, HasSubstr("Serves \\(aqdrinks\\(aq"));
  EXPECT_THAT(pages[1].text,
              HasSubstr(".TP\n.B \\-g, \\-\\-grind MM\nHow coarse"));
  EXPECT_THAT(pages[1].text, HasSubstr(".SH ENVIRONMENT\n.TP\n.B GRIND\n"));
}

}  // namespace
}  // namespace revisit::client
