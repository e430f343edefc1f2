// The running text of a help: paragraphs and lists, to be laid out at any
// width.
#ifndef REVISIT_CLIENT_CLI_USAGE_TEXT_BLOCKS_H_
#define REVISIT_CLIENT_CLI_USAGE_TEXT_BLOCKS_H_

#include <cstddef>
#include <string>
#include <vector>

namespace revisit::client {

// A paragraph, or an element of a list: a term and what it means.
struct TextBlock {
  // Empty for a paragraph.
  std::string term;
  // One line.
  std::string text;
  // Whether an empty line stands before it.
  bool after_gap = false;
};

// Lines that begin with a blank are elements of lists, "  term  text", and go
// on in lines that begin below the text; all other lines are paragraphs, which
// end at an empty line or a list.
std::vector<TextBlock> ParseText(const std::string& text);

// Breaks a text between words into lines of at most `width` columns; a longer
// word has a line of its own. The first line begins with `first`, all others
// with `rest` blanks. Ends with a line break.
std::string Wrapped(const std::string& text, std::size_t width,
                    const std::string& first, std::size_t rest);

// All blocks at this width.
std::string LaidOut(const std::vector<TextBlock>& blocks, std::size_t width);

// Command lines, one a line, which go on behind a backslash where they are
// longer than `width`.
std::string LaidOutExamples(const std::string& examples, std::size_t width);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_USAGE_TEXT_BLOCKS_H_
