#include "client/terminal/table.h"

#include <algorithm>
#include <utility>

#include "client/revisit/printable_text.h"

namespace revisit::client {
namespace {

constexpr std::size_t kGap = 2;

std::string Padded(const std::string& text, std::size_t width,
                   Table::Align align) {
  const std::string blanks(width - std::min(width, text.size()), ' ');
  return align == Table::Align::kLeft ? text + blanks : blanks + text;
}

void PrintLine(std::string line, std::ostream& out) {
  line.erase(line.find_last_not_of(' ') + 1);
  out << line << '\n';
}

}  // namespace

Table::Table(std::vector<Column> columns) : columns_(std::move(columns)) {}

void Table::AddRow(std::vector<std::string> cells) {
  for (std::string& cell : cells) cell = Printable(cell);
  rows_.push_back(std::move(cells));
}

void Table::AddRule() { rows_.emplace_back(); }

std::vector<std::size_t> Table::Widths() const {
  std::vector<std::size_t> widths;
  for (std::size_t i = 0; i < columns_.size(); ++i) {
    std::size_t width =
        std::max(columns_[i].title.size(), columns_[i].least_width);
    for (const auto& row : rows_) {
      if (!row.empty()) width = std::max(width, row[i].size());
    }
    widths.push_back(width);
  }
  return widths;
}

void Table::Print(std::ostream& out, std::size_t width,
                  bool with_titles) const {
  const std::vector<std::size_t> widths = Widths();
  std::size_t across = kGap * (columns_.size() - 1);
  for (const std::size_t column : widths) across += column;
  if (width > 0 && across > width) {
    PrintParagraphs(widths, width, out);
    return;
  }
  const auto print_cells = [&](const auto& text_of) {
    std::string line;
    for (std::size_t i = 0; i < columns_.size(); ++i) {
      if (i > 0) line.append(kGap, ' ');
      line += Padded(text_of(i), widths[i], columns_[i].align);
    }
    PrintLine(std::move(line), out);
  };
  if (with_titles) {
    print_cells([this](std::size_t i) { return columns_[i].title; });
  }
  for (const auto& row : rows_) {
    if (row.empty()) {
      out << std::string(across, '-') << '\n';
    } else {
      print_cells([&row](std::size_t i) { return row[i]; });
    }
  }
}

void Table::PrintParagraphs(const std::vector<std::size_t>& widths,
                            std::size_t width, std::ostream& out) const {
  for (const auto& row : rows_) {
    if (row.empty()) {
      out << std::string(width, '-') << '\n';
      continue;
    }
    out << columns_[0].title << ' ' << row[0] << '\n';
    std::string line;
    for (std::size_t i = 1; i < columns_.size(); ++i) {
      const std::string cell = columns_[i].title + ' ' +
                               Padded(row[i], widths[i], columns_[i].align);
      if (!line.empty() && line.size() + kGap + cell.size() > width) {
        PrintLine(std::move(line), out);
        line.clear();
      }
      line.append(kGap, ' ');
      line += cell;
    }
    if (!line.empty()) PrintLine(std::move(line), out);
  }
}

}  // namespace revisit::client
