#include "server/security/server_credentials.h"

#include <grpc/grpc.h>
#include <grpc/grpc_security.h>

#include <deque>
#include <string>

#include "core/base/mutex.h"

namespace revisit::server {
namespace {

// The state of one listener: which version of the files it was given last.
struct Listener {
  const TlsFiles* files;
  std::int64_t version = 0;
};

// gRPC asks before each handshake, one at a time for each listener.
grpc_ssl_certificate_config_reload_status Fetch(
    void* user_data, grpc_ssl_server_certificate_config** config) {
  auto* const listener = static_cast<Listener*>(user_data);
  const TlsFiles::Current current = listener->files->current();
  if (current.version == listener->version) {
    return GRPC_SSL_CERTIFICATE_CONFIG_RELOAD_UNCHANGED;
  }
  const TlsMaterial& material = *current.material;
  const grpc_ssl_pem_key_cert_pair pair = {material.private_key.c_str(),
                                           material.certificate_chain.c_str()};
  // gRPC ends the process if there are no authorities, also where no client is
  // asked for a certificate. Nothing is then compared with those that it gets.
  const std::string& authorities = material.client_authorities.empty()
                                       ? material.certificate_chain
                                       : material.client_authorities;
  *config =
      grpc_ssl_server_certificate_config_create(authorities.c_str(), &pair, 1);
  if (*config == nullptr) return GRPC_SSL_CERTIFICATE_CONFIG_RELOAD_FAIL;
  listener->version = current.version;
  return GRPC_SSL_CERTIFICATE_CONFIG_RELOAD_NEW;
}

// The C++ API of this version of gRPC has nothing that asks for certificates at
// each handshake; the C API beneath it does.
class TlsServerCredentials final : public grpc::ServerCredentials {
 public:
  TlsServerCredentials(const TlsFiles* files,
                       grpc_ssl_client_certificate_request_type request)
      : files_(files), request_(request) {}

  void SetAuthMetadataProcessor(
      const std::shared_ptr<grpc::AuthMetadataProcessor>&) override {}

 private:
  int AddPortToServer(const std::string& address,
                      grpc_server* server) override {
    Listener* listener;
    {
      const MutexLock lock(&mutex_);
      listener = &listeners_.emplace_back(Listener{files_});
    }
    grpc_server_credentials* const credentials =
        grpc_ssl_server_credentials_create_with_options(
            grpc_ssl_server_credentials_create_options_using_config_fetcher(
                request_, Fetch, listener));
    const int port =
        grpc_server_add_http2_port(server, address.c_str(), credentials);
    grpc_server_credentials_release(credentials);
    return port;
  }

  const TlsFiles* const files_;
  const grpc_ssl_client_certificate_request_type request_;
  Mutex mutex_;
  // A deque, because its elements stay at their addresses.
  std::deque<Listener> listeners_ ABSL_GUARDED_BY(mutex_);
};

}  // namespace

std::shared_ptr<grpc::ServerCredentials> MakeTlsServerCredentials(
    const TlsFiles* files, ClientCertificates clients) {
  grpc_ssl_client_certificate_request_type request =
      GRPC_SSL_DONT_REQUEST_CLIENT_CERTIFICATE;
  if (clients == ClientCertificates::kVerifyIfGiven) {
    request = GRPC_SSL_REQUEST_CLIENT_CERTIFICATE_AND_VERIFY;
  } else if (clients == ClientCertificates::kRequire) {
    request = GRPC_SSL_REQUEST_AND_REQUIRE_CLIENT_CERTIFICATE_AND_VERIFY;
  }
  return std::make_shared<TlsServerCredentials>(files, request);
}

}  // namespace revisit::server
