#include "client/revisit/channel.h"

#include <openssl/err.h>

#include <algorithm>
#include <cerrno>
#include <cstring>
#include <fstream>
#include <iterator>
#include <map>
#include <utility>

#include "core/base/openssl_pointers.h"
#include "grpcpp/create_channel.h"
#include "grpcpp/security/credentials.h"
#include "grpcpp/support/channel_arguments.h"

namespace revisit::client {
namespace {

grpc::ChannelArguments Arguments() {
  grpc::ChannelArguments arguments;
  arguments.SetInt(GRPC_ARG_INITIAL_RECONNECT_BACKOFF_MS, 100);
  arguments.SetInt(GRPC_ARG_MIN_RECONNECT_BACKOFF_MS, 5'000);
  arguments.SetInt(GRPC_ARG_MAX_RECONNECT_BACKOFF_MS, 2'000);
  arguments.SetMaxReceiveMessageSize(64 << 20);
  // Bytes that the peer leaves unread or unacknowledged for so long break the
  // connection (TCP_USER_TIMEOUT): gRPC ends no call, cancelled or not, while
  // its bytes wait to be written. That is set only where there is a keepalive;
  // its own pings come so rarely as not to matter to the server.
  arguments.SetInt(GRPC_ARG_KEEPALIVE_TIMEOUT_MS, 15'000);
  arguments.SetInt(GRPC_ARG_KEEPALIVE_TIME_MS, 24 * 3'600'000);
  // One process may speak to several servers that follow each other at one
  // address; channels that share a connection would share its back-off too.
  arguments.SetInt(GRPC_ARG_USE_LOCAL_SUBCHANNEL_POOL, 1);
  return arguments;
}

absl::StatusOr<std::string> ReadFile(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  std::string text((std::istreambuf_iterator<char>(file)),
                   std::istreambuf_iterator<char>());
  if (!file.is_open() || file.bad() || text.empty()) {
    return absl::InvalidArgumentError(
        ("cannot read " + path + ": " +
         (file.is_open() ? "it is empty" : std::strerror(errno)))
            .c_str());
  }
  return text;
}

absl::StatusOr<std::string> ReadToken(const std::string& path) {
  const absl::StatusOr<std::string> text = ReadFile(path);
  if (!text.ok()) return text.status();
  const char* space = " \t\r\n";
  const std::size_t first = text->find_first_not_of(space);
  const std::string token =
      first == std::string::npos
          ? ""
          : text->substr(first, text->find_last_not_of(space) - first + 1);
  const bool plain = std::all_of(token.begin(), token.end(),
                                 [](char c) { return c > ' ' && c <= '~'; });
  if (token.empty() || !plain) {
    return absl::InvalidArgumentError((path + " holds no token").c_str());
  }
  return token;
}

class TokenFile final : public grpc::MetadataCredentialsPlugin {
 public:
  explicit TokenFile(std::string path) : path_(std::move(path)) {}

  const char* GetType() const override { return "revisit-token-file"; }

  grpc::Status GetMetadata(
      grpc::string_ref, grpc::string_ref, const grpc::AuthContext&,
      std::multimap<grpc::string, grpc::string>* metadata) override {
    const absl::StatusOr<std::string> token = ReadToken(path_);
    if (!token.ok()) {
      return grpc::Status(grpc::StatusCode::UNAUTHENTICATED,
                          std::string(token.status().message()));
    }
    metadata->emplace("authorization", "Bearer " + *token);
    return grpc::Status::OK;
  }

 private:
  const std::string path_;
};

openssl::Certificate FirstCertificate(const std::string& pem) {
  return openssl::ReadCertificate(openssl::Memory(pem));
}

absl::Status Problem(const std::string& what) {
  ERR_clear_error();
  return absl::InvalidArgumentError(what.c_str());
}

// Finds faults of the files that gRPC would only report as "unreachable".
absl::Status CheckTls(const ChannelOptions& options,
                      const grpc::SslCredentialsOptions& tls) {
  if (FirstCertificate(tls.pem_root_certs) == nullptr) {
    return Problem(options.tls_authorities_file + " holds no certificate");
  }
  if (tls.pem_cert_chain.empty()) return absl::OkStatus();
  const openssl::Certificate certificate = FirstCertificate(tls.pem_cert_chain);
  if (certificate == nullptr) {
    return Problem(options.tls_certificate_file + " holds no certificate");
  }
  const openssl::Key key =
      openssl::ReadPrivateKey(openssl::Memory(tls.pem_private_key));
  if (key == nullptr) {
    return Problem(options.tls_key_file +
                   " holds no private key that can be read (it must not be "
                   "encrypted)");
  }
  if (X509_check_private_key(certificate.get(), key.get()) != 1) {
    return Problem("the private key is not that of the certificate: " +
                   options.tls_key_file + ", " + options.tls_certificate_file);
  }
  return absl::OkStatus();
}

absl::StatusOr<std::shared_ptr<grpc::ChannelCredentials>> TlsCredentials(
    const ChannelOptions& options) {
  grpc::SslCredentialsOptions tls;
  const std::pair<const std::string*, std::string*> files[] = {
      {&options.tls_authorities_file, &tls.pem_root_certs},
      {&options.tls_certificate_file, &tls.pem_cert_chain},
      {&options.tls_key_file, &tls.pem_private_key}};
  for (const auto& [path, text] : files) {
    if (path->empty()) continue;
    absl::StatusOr<std::string> read = ReadFile(*path);
    if (!read.ok()) return read.status();
    *text = *std::move(read);
  }
  if (absl::Status status = CheckTls(options, tls); !status.ok()) return status;
  return grpc::SslCredentials(tls);
}

// For a plaintext channel with a token, which must not leave this machine.
std::shared_ptr<grpc::ChannelCredentials> LocalCredentials(
    const std::string& address) {
  return grpc::experimental::LocalCredentials(
      address.rfind("unix", 0) == 0 ? UDS : LOCAL_TCP);
}

}  // namespace

absl::StatusOr<std::shared_ptr<grpc::Channel>> MakeChannel(
    const ChannelOptions& options) {
  const bool has_tls = !options.tls_authorities_file.empty();
  if (options.tls_certificate_file.empty() != options.tls_key_file.empty()) {
    return absl::InvalidArgumentError(
        "a client certificate and its key are needed together");
  }
  if (!has_tls && !options.tls_certificate_file.empty()) {
    return absl::InvalidArgumentError(
        "a client certificate needs TLS: name the file of who may have issued "
        "the server's certificate");
  }
  if (!has_tls && options.token_file.empty()) {
    return MakeInsecureChannel(options.address);
  }
  std::shared_ptr<grpc::ChannelCredentials> credentials;
  if (has_tls) {
    auto tls = TlsCredentials(options);
    if (!tls.ok()) return tls.status();
    credentials = *std::move(tls);
  } else {
    credentials = LocalCredentials(options.address);
  }
  if (!options.token_file.empty()) {
    // Read once here, so that a mistake shows at once.
    if (const auto token = ReadToken(options.token_file); !token.ok()) {
      return token.status();
    }
    credentials = grpc::CompositeChannelCredentials(
        credentials,
        grpc::experimental::MetadataCredentialsFromPlugin(
            std::make_unique<TokenFile>(options.token_file),
            has_tls ? GRPC_PRIVACY_AND_INTEGRITY : GRPC_SECURITY_NONE));
  }
  return grpc::CreateCustomChannel(options.address, credentials, Arguments());
}

std::shared_ptr<grpc::Channel> MakeInsecureChannel(const std::string& address) {
  return grpc::CreateCustomChannel(address, grpc::InsecureChannelCredentials(),
                                   Arguments());
}

}  // namespace revisit::client
