// Tables for people.
#ifndef REVISIT_CLIENT_TERMINAL_TABLE_H_
#define REVISIT_CLIENT_TERMINAL_TABLE_H_

#include <cstddef>
#include <ostream>
#include <string>
#include <vector>

namespace revisit::client {

// Prints columns as wide as they need to be. Numbers are the caller's text;
// what a terminal should not see as it is in a cell is shown as Printable()
// does.
class Table {
 public:
  enum class Align { kLeft, kRight };
  struct Column {
    std::string title;
    Align align = Align::kLeft;
    // For a table that is printed in parts, whose columns shall agree.
    std::size_t least_width = 0;
  };

  explicit Table(std::vector<Column> columns);

  // REQUIRES: as many cells as columns.
  void AddRow(std::vector<std::string> cells);
  // A line across before the next row.
  void AddRule();
  bool empty() const { return rows_.empty(); }

  // Prints at most `width` columns of the terminal across; 0 means as many as
  // the table needs. Where that is more than `width`, each row is a paragraph:
  // the first cell, and below it the other cells behind their titles.
  void Print(std::ostream& out, std::size_t width = 0,
             bool with_titles = true) const;

 private:
  std::vector<std::size_t> Widths() const;
  void PrintParagraphs(const std::vector<std::size_t>& widths,
                       std::size_t width, std::ostream& out) const;

  const std::vector<Column> columns_;
  // An empty row is a rule.
  std::vector<std::vector<std::string>> rows_;
};

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_TERMINAL_TABLE_H_
