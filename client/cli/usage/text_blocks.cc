#include "client/cli/usage/text_blocks.h"

#include <algorithm>
#include <sstream>

namespace revisit::client {
namespace {

constexpr std::size_t kIndent = 2;

std::vector<std::string> LinesOf(const std::string& text) {
  std::vector<std::string> lines;
  std::istringstream stream(text);
  for (std::string line; std::getline(stream, line);) lines.push_back(line);
  return lines;
}

// "  term  text" cut in two; without a wide gap, all of it is the term.
TextBlock Element(const std::string& line, std::size_t indent,
                  std::size_t* text_column) {
  const std::size_t gap = line.find("  ", indent);
  const std::size_t text = line.find_first_not_of(' ', gap);
  TextBlock block;
  block.term = line.substr(indent, gap - indent);
  if (gap != std::string::npos && text != std::string::npos) {
    block.text = line.substr(text);
    *text_column = text;
  } else {
    *text_column = indent + kIndent;
  }
  return block;
}

}  // namespace

std::vector<TextBlock> ParseText(const std::string& text) {
  std::vector<TextBlock> blocks;
  bool gap = false;
  // The column of the list's element that may go on; 0 outside of lists.
  std::size_t text_column = 0;
  for (const std::string& line : LinesOf(text)) {
    const std::size_t indent = line.find_first_not_of(' ');
    if (indent == std::string::npos) {
      gap = true;
      continue;
    }
    const bool goes_on =
        !blocks.empty() && !gap &&
        (indent == 0 ? blocks.back().term.empty()
                     : text_column > 0 && indent >= text_column);
    if (goes_on) {
      blocks.back().text += ' ' + line.substr(indent);
    } else if (indent > 0) {
      blocks.push_back(Element(line, indent, &text_column));
    } else {
      blocks.push_back({"", line});
      text_column = 0;
    }
    if (!goes_on) blocks.back().after_gap = gap;
    gap = false;
  }
  return blocks;
}

std::string Wrapped(const std::string& text, std::size_t width,
                    const std::string& first, std::size_t rest) {
  std::string wrapped;
  std::string line = first;
  bool empty = true;
  std::istringstream words(text);
  for (std::string word; words >> word;) {
    if (!empty && line.size() + 1 + word.size() > width) {
      wrapped += line + '\n';
      line.assign(rest, ' ');
      empty = true;
    }
    if (!empty) line += ' ';
    line += word;
    empty = false;
  }
  line.erase(line.find_last_not_of(' ') + 1);
  return wrapped + line + '\n';
}

std::string LaidOut(const std::vector<TextBlock>& blocks, std::size_t width) {
  std::size_t terms = 0;
  for (const TextBlock& block : blocks) {
    if (!block.text.empty()) terms = std::max(terms, block.term.size());
  }
  const std::size_t column = 2 * kIndent + terms;
  std::string laid_out;
  for (const TextBlock& block : blocks) {
    if (block.after_gap) laid_out += '\n';
    if (block.term.empty()) {
      laid_out += Wrapped(block.text, width, "", 0);
    } else if (block.text.empty()) {
      laid_out +=
          Wrapped(block.term, width, std::string(kIndent, ' '), 2 * kIndent);
    } else {
      std::string first = std::string(kIndent, ' ') + block.term;
      first.append(column - first.size(), ' ');
      laid_out += Wrapped(block.text, width, first, column);
    }
  }
  return laid_out;
}

std::string LaidOutExamples(const std::string& examples, std::size_t width) {
  constexpr char kGoesOn[] = " \\";
  constexpr std::size_t kDeeper = 3 * kIndent;
  std::string laid_out;
  for (const std::string& line : LinesOf(examples)) {
    if (line.size() <= width) {
      laid_out += line + '\n';
      continue;
    }
    std::string wrapped = Wrapped(line, width - std::min(width, kIndent),
                                  std::string(kIndent, ' '), kDeeper);
    wrapped.pop_back();
    for (std::size_t end = 0;
         (end = wrapped.find('\n', end)) != std::string::npos;
         end += kIndent + 1) {
      wrapped.insert(end, kGoesOn);
    }
    laid_out += wrapped + '\n';
  }
  return laid_out;
}

}  // namespace revisit::client
