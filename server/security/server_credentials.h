// TLS for the listeners of gRPC.
#ifndef REVISIT_SERVER_SECURITY_SERVER_CREDENTIALS_H_
#define REVISIT_SERVER_SECURITY_SERVER_CREDENTIALS_H_

#include <memory>

#include "grpcpp/security/server_credentials.h"
#include "server/security/client_certificates.h"
#include "server/security/tls_files.h"

namespace revisit::server {

// Credentials for TLS 1.2 or later, which use the contents of `files` at the
// time of each handshake. They may serve any number of listeners. `files` and
// the credentials must outlive the server.
std::shared_ptr<grpc::ServerCredentials> MakeTlsServerCredentials(
    const TlsFiles* files, ClientCertificates clients);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SECURITY_SERVER_CREDENTIALS_H_
