// Internal to the client library and the command line: texts of others, such as
// a server or whoever named a vehicle, as a terminal may show them.
#ifndef REVISIT_CLIENT_REVISIT_PRINTABLE_TEXT_H_
#define REVISIT_CLIENT_REVISIT_PRINTABLE_TEXT_H_

#include <string>

namespace revisit::client {

// The text with the number of each character that could steer a terminal, begin
// a line of its own, change the direction of what is around it, or show as
// nothing, in place of the character: "<U+001B>". These are the control
// characters, the separators of lines and paragraphs, the interlinear
// annotations, and what Unicode 15 calls Default_Ignorable_Code_Point. A byte
// that is no UTF-8 becomes "<9B>". All else stays.
std::string Printable(const std::string& text);

// As Printable(), but line feeds and tabs stay: for a text that may have
// several lines, where it stands alone.
std::string PrintableLines(const std::string& text);

// JSON with the same characters escaped as JSON has it ("\u202e"), so that its
// values are as they were. Line feeds between them stay. REQUIRES: valid UTF-8.
std::string PrintableJson(const std::string& json);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_REVISIT_PRINTABLE_TEXT_H_
