#include "client/cli/connection_flags.h"

#include <utility>

#include "absl/strings/str_cat.h"
#include "client/cli/contexts.h"

namespace revisit::client {
namespace {

constexpr char kHelpHint[] = "revisit --help tells more";

// Names the context that counts, if any, and what chose the server.
absl::StatusOr<ChosenServer> ChooseName(const Command& program,
                                        const ConnectionFlags& flags) {
  const bool context_typed = program.Typed("--context");
  const bool server_typed = program.Typed("--server");
  if (context_typed && server_typed) {
    return UsageError("--server, --context: one of them only", kHelpHint);
  }
  ChosenServer chosen;
  chosen.contexts_path = ContextsPath();
  if (context_typed || server_typed) {
    chosen.context = context_typed ? flags.context : "";
    chosen.chosen_by = context_typed ? "--context" : "--server";
    return chosen;
  }
  const bool context_given = program.Given("--context");
  const bool server_given = program.Given("--server");
  if (context_given && server_given) {
    return UsageError("REVISIT_SERVER, REVISIT_CONTEXT: one of them only",
                      kHelpHint);
  }
  if (context_given || server_given) {
    chosen.context = flags.context;
    chosen.chosen_by = context_given ? "REVISIT_CONTEXT" : "REVISIT_SERVER";
    return chosen;
  }
  const auto contexts = ReadContexts(chosen.contexts_path);
  if (!contexts.ok()) return contexts.status();
  chosen.context = contexts->current;
  chosen.chosen_by =
      chosen.context.empty() ? "the default" : "revisit context use";
  return chosen;
}

// Replaces what the context says by what was given instead.
void Override(const Command& program, const ConnectionFlags& flags,
              ChannelOptions* options) {
  const bool variables_count = !program.Typed("--context");
  const auto given = [&](const std::string& flag) {
    return program.Typed(flag) || (variables_count && program.Given(flag));
  };
  // A certificate without its own key is of no use.
  if (given("--tls-cert") || given("--tls-key")) {
    options->tls_certificate_file.clear();
    options->tls_key_file.clear();
  }
  for (const ContextKey& key : kContextKeys) {
    if (given(absl::StrCat("--", key.name))) {
      options->*key.option = flags.server.*key.option;
    }
  }
}

}  // namespace

void AddConnectionFlags(const Command& program, ConnectionFlags* flags) {
  program
      .AddText("--context", "CONTEXT", &flags->context,
               "Server that revisit context has set under this name")
      .OrEnvironment("REVISIT_CONTEXT");
  ChannelOptions& server = flags->server;
  program
      .AddText("--server", "ADDR", &server.address,
               absl::StrCat("Address of the server; without it, that of the "
                            "current context, or ",
                            kDefaultServer))
      .OrEnvironment("REVISIT_SERVER");
  program
      .AddText("--tls-ca", "FILE", &server.tls_authorities_file,
               "Speak TLS; who may have issued the server's certificate (PEM)")
      .OrEnvironment("REVISIT_TLS_CA");
  program
      .AddText("--tls-cert", "FILE", &server.tls_certificate_file,
               "Certificate of this client (PEM)")
      .OrEnvironment("REVISIT_TLS_CERT");
  program
      .AddText("--tls-key", "FILE", &server.tls_key_file,
               "Private key of --tls-cert (PEM)")
      .OrEnvironment("REVISIT_TLS_KEY");
  program
      .AddText("--token-file", "FILE", &server.token_file,
               "Bearer token; read again for each call")
      .OrEnvironment("REVISIT_TOKEN_FILE");
}

absl::StatusOr<ChosenServer> ChooseServer(const Command& program,
                                          const ConnectionFlags& flags) {
  auto chosen = ChooseName(program, flags);
  if (!chosen.ok()) return chosen;
  const bool by_name = chosen->chosen_by == "--context" ||
                       chosen->chosen_by == "REVISIT_CONTEXT" ||
                       !chosen->context.empty();
  chosen->options.address = kDefaultServer;
  if (by_name) {
    const auto contexts = ReadContexts(chosen->contexts_path);
    if (!contexts.ok()) return contexts.status();
    auto server = ServerOf(*contexts, chosen->context, chosen->contexts_path);
    if (!server.ok()) return server.status();
    chosen->options = *std::move(server);
  }
  Override(program, flags, &chosen->options);
  std::string problem = CheckServer(chosen->options, "--");
  if (!problem.empty()) return UsageError(problem, kHelpHint);
  return chosen;
}

}  // namespace revisit::client
