#include "client/cli/connection_hint.h"

#include "absl/strings/str_cat.h"
#include "client/revisit/channel.h"
#include "client/terminal/terminal.h"

namespace revisit::client {
namespace {

// Only the message of gRPC distinguishes the causes.
bool Says(const absl::Status& status, const char* words) {
  return status.message().find(words) != absl::string_view::npos;
}

bool IsWithoutConnection(const absl::Status& status) {
  return absl::IsUnavailable(status) && (Says(status, "failed to connect") ||
                                         Says(status, "DNS resolution failed"));
}

// A question at what may be wrong.
std::string Question(const absl::Status& status,
                     const ChannelOptions& options) {
  const auto says = [&status](const char* words) {
    return Says(status, words);
  };
  if (says("Connection refused")) {
    return absl::StrCat("(is revisitd running at ", options.address,
                        "? --server and REVISIT_SERVER name another address)");
  }
  const bool closed = says("Socket closed") || says("reset by peer");
  if (options.tls_authorities_file.empty()) {
    return closed ? "(connected without TLS: does the server want it? see "
                    "--tls-ca)"
                  : "";
  }
  if (says("wrong version number")) {
    return "(connected with TLS: does the server speak it? it is left out "
           "without --tls-ca)";
  }
  if (closed && options.tls_certificate_file.empty()) {
    return "(connected without a certificate: does the server want one? see "
           "--tls-cert)";
  }
  return "";
}

// Which context chose the server, and where it is written; empty if none did.
std::string ContextHint(const ChosenServer& server) {
  if (server.context.empty()) return "";
  return absl::StrCat("(the context ", server.context, " in ",
                      server.contexts_path, ", chosen by ", server.chosen_by,
                      ", names the server ", server.options.address, ")");
}

}  // namespace

std::string ConnectionHint(const absl::Status& status,
                           const ChosenServer& server) {
  if (absl::IsUnauthenticated(status)) return ContextHint(server);
  if (!IsWithoutConnection(status)) return "";
  const std::string question = Question(status, server.options);
  const std::string context = ContextHint(server);
  return absl::StrCat(question, question.empty() || context.empty() ? "" : "\n",
                      context);
}

absl::StatusOr<std::shared_ptr<grpc::Channel>> MakeChannelTo(
    const ChosenServer& server) {
  auto channel = MakeChannel(server.options);
  if (channel.ok()) return channel;
  const absl::Status error = LocalError(channel.status());
  const std::string context = ContextHint(server);
  return context.empty() ? error : WithHint(error, context);
}

}  // namespace revisit::client
