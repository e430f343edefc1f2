#include "client/terminal/table.h"

#include <sstream>

#include "gtest/gtest.h"

namespace revisit::client {
namespace {

std::string Printed(const Table& table, std::size_t width) {
  std::ostringstream out;
  table.Print(out, width);
  return out.str();
}

Table Cities() {
  Table table({{"CITY"}, {"PEOPLE", Table::Align::kRight}, {"RIVER"}});
  table.AddRow({"Bern", "133000", "Aare"});
  table.AddRow({"Rheinfelden", "13000", "Rhein"});
  return table;
}

TEST(TableTest, ColumnsAreAsWideAsTheyNeedToBe) {
  EXPECT_EQ(Printed(Cities(), 0),
            "CITY         PEOPLE  RIVER\n"
            "Bern         133000  Aare\n"
            "Rheinfelden   13000  Rhein\n");
  EXPECT_EQ(Printed(Cities(), 26), Printed(Cities(), 0));
}

TEST(TableTest, RowsAreParagraphsWhereTheTerminalIsNarrower) {
  EXPECT_EQ(Printed(Cities(), 25),
            "CITY Bern\n"
            "  PEOPLE 133000\n"
            "  RIVER Aare\n"
            "CITY Rheinfelden\n"
            "  PEOPLE  13000\n"
            "  RIVER Rhein\n");
}

TEST(TableTest, RuleIsAsWideAsTheTable) {
  Table table({{"A"}, {"B"}});
  table.AddRow({"1", "2"});
  table.AddRule();
  EXPECT_EQ(Printed(table, 0), "A  B\n1  2\n----\n");
}

}  // namespace
}  // namespace revisit::client
