// TLS for the listeners of gRPC.
#ifndef REVISIT_SERVER_SECURITY_SERVER_CREDENTIALS_H_
#define REVISIT_SERVER_SECURITY_SERVER_CREDENTIALS_H_

#include <memory>

#include "grpcpp/security/server_credentials.h"
#include "server/security/client_certificates.h"
#include "server/security/tls_files.h"

namespace revisit::server {

// TLS 1.2 or later, with what `files` hold at each handshake. May serve any
// number of listeners. `files`, and what is returned, must outlive the server.
std::shared_ptr<grpc::ServerCredentials> MakeTlsServerCredentials(
    const TlsFiles* files, ClientCertificates clients);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SECURITY_SERVER_CREDENTIALS_H_
