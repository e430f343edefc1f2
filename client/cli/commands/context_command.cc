#include "client/cli/commands/context_command.h"

#include <algorithm>
#include <filesystem>
#include <iterator>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "client/cli/contexts.h"
#include "client/revisit/printable_text.h"
#include "client/terminal/terminal.h"
#include "nlohmann/json.hpp"

namespace revisit::client {
namespace {

using Json = nlohmann::ordered_json;

constexpr char kContextDetails[] =
    "A context is the address of a server with the files by which it is "
    "reached: --tls-ca, --tls-cert, --tls-key and --token-file. Contexts are "
    "kept in the file that REVISIT_CONTEXTS_FILE names, otherwise in "
    "revisit/contexts.json in XDG_CONFIG_HOME or ~/.config. It has names of "
    "files, never a token itself.\n\n"
    "The first of these counts: --server or --context, REVISIT_SERVER or "
    "REVISIT_CONTEXT, the current context, 127.0.0.1:50051.";

Json ServerToJson(const ChannelOptions& server) {
  Json json = Json::object();
  for (const ContextKey& key : kContextKeys) {
    if (!(server.*key.option).empty()) json[key.json_name] = server.*key.option;
  }
  return json;
}

void AddContextName(const Command& command, std::string* name) {
  command.AddText("CONTEXT", "TEXT", name, "Its name").Required();
}

void PrintContexts(const Contexts& contexts, const Terminal& terminal) {
  using Align = Table::Align;
  std::vector<Table::Column> columns = {{"CURRENT", Align::kLeft},
                                        {"CONTEXT", Align::kLeft},
                                        {"SERVER", Align::kLeft},
                                        {"TLS", Align::kLeft},
                                        {"CREDENTIALS", Align::kLeft}};
  if (terminal.wide()) {
    columns.insert(columns.end(), {{"TLS-CA", Align::kLeft},
                                   {"TLS-CERT", Align::kLeft},
                                   {"TLS-KEY", Align::kLeft},
                                   {"TOKEN-FILE", Align::kLeft}});
  }
  Table table(columns);
  for (const auto& [name, server] : contexts.servers) {
    std::string credentials =
        server.tls_certificate_file.empty() ? "" : "certificate";
    if (!server.token_file.empty()) {
      absl::StrAppend(&credentials, credentials.empty() ? "" : ", ", "token");
    }
    std::vector<std::string> row = {
        name == contexts.current ? "*" : "", name, server.address,
        server.tls_authorities_file.empty() ? "" : "yes", credentials};
    for (const ContextKey& key : kContextKeys) {
      if (terminal.wide() && key.is_file) row.push_back(server.*key.option);
    }
    table.AddRow(std::move(row));
  }
  table.Print(terminal.out, terminal.width);
}

absl::Status RunList(const Terminal& terminal) {
  const auto contexts = ReadContexts(ContextsPath());
  if (!contexts.ok()) return contexts.status();
  if (terminal.json()) {
    Json list = Json::array();
    for (const auto& [name, server] : contexts->servers) {
      Json json = {{"context", name}, {"current", name == contexts->current}};
      json.update(ServerToJson(server));
      list.push_back(std::move(json));
    }
    terminal.out << JsonText({{"contexts", list}}, true) << '\n';
  } else if (terminal.names()) {
    for (const auto& [name, server] : contexts->servers) {
      terminal.out << name << '\n';
    }
  } else {
    PrintContexts(*contexts, terminal);
  }
  return absl::OkStatus();
}

// Says what was done to a context.
void PrintDone(const std::string& text, const std::string& name,
               const Terminal& terminal) {
  if (terminal.json()) {
    terminal.out << JsonText({{"context", name}}, true) << '\n';
  } else if (terminal.names()) {
    terminal.out << name << '\n';
  } else {
    terminal.out << text << '\n';
  }
}

absl::Status RunUse(const std::string& name, const Terminal& terminal) {
  const std::string path = ContextsPath();
  std::string address;
  const absl::Status changed =
      ChangeContexts(path, [&](Contexts* contexts) -> absl::Status {
        const auto server = ServerOf(*contexts, name, path);
        if (!server.ok()) return server.status();
        contexts->current = name;
        address = server->address;
        return absl::OkStatus();
      });
  if (!changed.ok()) return changed;
  PrintDone(absl::StrCat("commands ask ", Printable(address), " now"), name,
            terminal);
  return absl::OkStatus();
}

// Changes what the command line has of a server, and nothing else.
void SetTyped(const Command& program, const ChannelOptions& typed,
              ChannelOptions* server) {
  for (const ContextKey& key : kContextKeys) {
    if (!program.Typed(absl::StrCat("--", key.name))) continue;
    std::string& value = server->*key.option;
    value = typed.*key.option;
    // It has to lead to the same file wherever a command is typed.
    if (key.is_file && !value.empty()) {
      value = std::filesystem::absolute(value).lexically_normal().string();
    }
  }
}

absl::Status RunSet(const Command& program, const ChannelOptions& typed,
                    const std::string& name, const Terminal& terminal) {
  const std::string path = ContextsPath();
  bool is_current = false;
  const absl::Status changed =
      ChangeContexts(path, [&](Contexts* contexts) -> absl::Status {
        ChannelOptions& server = contexts->servers[name];
        SetTyped(program, typed, &server);
        is_current = contexts->current == name;
        const std::string problem = CheckServer(server, "--");
        return problem.empty() ? absl::OkStatus()
                               : UsageError(problem,
                                            "revisit context set --help tells "
                                            "more");
      });
  if (!changed.ok()) return changed;
  PrintDone(
      absl::StrCat(name, " is set in ", Printable(path),
                   is_current ? ""
                              : absl::StrCat("; revisit context use ", name,
                                             " makes it the current one")),
      name, terminal);
  return absl::OkStatus();
}

absl::Status RunDelete(const std::string& name, const Terminal& terminal) {
  const std::string path = ContextsPath();
  bool was_current = false;
  const absl::Status changed =
      ChangeContexts(path, [&](Contexts* contexts) -> absl::Status {
        const auto server = ServerOf(*contexts, name, path);
        if (!server.ok()) return server.status();
        contexts->servers.erase(name);
        was_current = contexts->current == name;
        if (was_current) contexts->current.clear();
        return absl::OkStatus();
      });
  if (!changed.ok()) return changed;
  PrintDone(absl::StrCat("deleted ", name,
                         was_current ? ", which was the current one" : ""),
            name, terminal);
  return absl::OkStatus();
}

absl::Status PrintServer(const ChosenServer& server, const Terminal& terminal) {
  if (terminal.json()) {
    Json json = Json::object();
    if (!server.context.empty()) json["context"] = server.context;
    json["chosenBy"] = server.chosen_by;
    json["file"] = server.contexts_path;
    json.update(ServerToJson(server.options));
    terminal.out << JsonText(json, true) << '\n';
    return absl::OkStatus();
  }
  if (terminal.names()) {
    if (!server.context.empty()) terminal.out << server.context << '\n';
    return absl::OkStatus();
  }
  std::vector<std::pair<std::string, std::string>> fields = {
      {"context", server.context.empty() ? "none" : server.context},
      {"chosen by", server.chosen_by},
      {"file", server.contexts_path}};
  for (const ContextKey& key : kContextKeys) {
    const std::string& value = server.options.*key.option;
    if (!value.empty()) fields.emplace_back(key.name, value);
  }
  PrintFields(fields, terminal.out);
  return absl::OkStatus();
}

absl::Status RunShow(const Command& program, const ConnectionFlags& connection,
                     const std::string& name, const Terminal& terminal) {
  if (name.empty()) {
    const auto server = ChooseServer(program, connection);
    return server.ok() ? PrintServer(*server, terminal) : server.status();
  }
  const std::string path = ContextsPath();
  const auto contexts = ReadContexts(path);
  if (!contexts.ok()) return contexts.status();
  auto server = ServerOf(*contexts, name, path);
  if (!server.ok()) return server.status();
  return PrintServer({*std::move(server), name, path, "its name"}, terminal);
}

void AddList(const Command& context) {
  const Command command =
      context.AddCommand({"list", "Lists the contexts.", "",
                          "  revisit context list\n"
                          "  revisit context list -o wide"});
  command.AlsoPrints({OutputFormat::kWide, OutputFormat::kName});
  command.RunsAlone(&RunList);
}

void AddUse(const Command& context) {
  const Command command = context.AddCommand(
      {"use", "Makes a context the current one.",
       "Commands ask its server where no flag and no variable names another.",
       "  revisit context use plant"});
  const auto name = std::make_shared<std::string>();
  AddContextName(command, name.get());
  command.AlsoPrints({OutputFormat::kName});
  command.RunsAlone(
      [name](const Terminal& terminal) { return RunUse(*name, terminal); });
}

void AddSet(const Command& context, const Command& program,
            const ConnectionFlags* connection) {
  const Command command = context.AddCommand(
      {"set", "Makes a context, or changes what is given of it.",
       "Takes --server, --tls-ca, --tls-cert, --tls-key and --token-file as "
       "every command does, from the command line only. Names of files are "
       "kept from the root on. An empty value takes a file away.",
       "  revisit context set plant --server plant.example:50051 --tls-ca "
       "ca.pem\n"
       "  revisit context set plant --token-file plant.token"});
  const auto name = std::make_shared<std::string>();
  AddContextName(command, name.get());
  command.AlsoPrints({OutputFormat::kName});
  const Check check = [name, program]() -> std::string {
    if (std::string problem = CheckContextName(*name); !problem.empty()) {
      return "CONTEXT: " + problem;
    }
    const bool typed =
        std::any_of(std::begin(kContextKeys), std::end(kContextKeys),
                    [&program](const ContextKey& key) {
                      return program.Typed(absl::StrCat("--", key.name));
                    });
    return typed ? "" : "--server, or another flag to keep, is required";
  };
  command.RunsAlone(
      [name, program, connection](const Terminal& terminal) {
        return RunSet(program, connection->server, *name, terminal);
      },
      check);
}

void AddShow(const Command& context, const Command& program,
             const ConnectionFlags* connection) {
  const Command command = context.AddCommand(
      {"show", "Shows a context, or which server a command would ask and why.",
       "", "  revisit context show\n  revisit context show plant -o json"});
  const auto name = std::make_shared<std::string>();
  command.AddText("CONTEXT", "TEXT", name.get(),
                  "Its name; without it, what counts now");
  command.AlsoPrints({OutputFormat::kName});
  command.RunsAlone([name, program, connection](const Terminal& terminal) {
    return RunShow(program, *connection, *name, terminal);
  });
}

void AddDelete(const Command& context) {
  const Command command =
      context.AddCommand({"delete", "Deletes a context, not its server.", "",
                          "  revisit context delete plant"});
  const auto name = std::make_shared<std::string>();
  AddContextName(command, name.get());
  command.AlsoPrints({OutputFormat::kName});
  command.RunsAlone(
      [name](const Terminal& terminal) { return RunDelete(*name, terminal); });
}

}  // namespace

void AddContextCommand(const Command& program,
                       const ConnectionFlags* connection) {
  const Command context = program.AddCommand(
      {"context", "Names servers, so that commands find them by a word.",
       kContextDetails, ""});
  AddList(context);
  AddUse(context);
  AddSet(context, program, connection);
  AddShow(context, program, connection);
  AddDelete(context);
}

}  // namespace revisit::client
