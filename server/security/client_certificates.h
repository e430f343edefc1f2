// Whether the clients of a TLS listener must present a certificate.
#ifndef REVISIT_SERVER_SECURITY_CLIENT_CERTIFICATES_H_
#define REVISIT_SERVER_SECURITY_CLIENT_CERTIFICATES_H_

namespace revisit::server {

// kVerifyIfGiven: a client may come without one, but not with a wrong one.
enum class ClientCertificates { kDoNotAsk, kVerifyIfGiven, kRequire };

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SECURITY_CLIENT_CERTIFICATES_H_
