// Prints what a command has changed.
#ifndef REVISIT_CLIENT_CLI_COMMANDS_PRINTED_CHANGE_H_
#define REVISIT_CLIENT_CLI_COMMANDS_PRINTED_CHANGE_H_

#include <cstdint>
#include <string>

#include "client/revisit/printable_text.h"
#include "client/terminal/terminal.h"
#include "nlohmann/json.hpp"

namespace revisit::client {

// "confirmed NAME, revision 7", the name alone, or as JSON the response.
template <typename Response>
void PrintChange(const char* done, const std::string& name,
                 const Response& response, const Terminal& terminal) {
  if (terminal.json()) {
    terminal.out << ToJson(response, true) << '\n';
  } else if (terminal.names()) {
    terminal.out << Printable(name) << '\n';
  } else {
    terminal.out << done << " " << Printable(name) << ", revision "
                 << response.revision() << '\n';
  }
}

// The same of what is gone, whose response has no name; as JSON, {"name",
// "revision"}.
template <typename Response>
void PrintRemoval(const char* done, const std::string& name,
                  const Response& response, const Terminal& terminal) {
  if (!terminal.json()) return PrintChange(done, name, response, terminal);
  nlohmann::ordered_json json;
  json["name"] = name;
  json["revision"] = response.revision();
  terminal.out << JsonText(json, true) << '\n';
}

// All names of a list, each on a line.
template <typename Items>
void PrintNames(const Items& items, const Terminal& terminal) {
  for (const auto& item : items) terminal.out << Printable(item.name()) << '\n';
}

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_COMMANDS_PRINTED_CHANGE_H_
