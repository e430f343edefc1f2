#include "client/cli/connection_hint.h"

#include "absl/strings/str_cat.h"

namespace revisit::client {

std::string ConnectionHint(const absl::Status& status,
                           const ChannelOptions& options) {
  // Only the message of gRPC distinguishes these causes.
  const auto says = [&status](const char* words) {
    return status.message().find(words) != absl::string_view::npos;
  };
  if (!absl::IsUnavailable(status) || !says("failed to connect")) return "";
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

}  // namespace revisit::client
