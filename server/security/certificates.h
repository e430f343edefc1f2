// X.509 certificates: checked before they are used, read when a client shows
// one.
#ifndef REVISIT_SERVER_SECURITY_CERTIFICATES_H_
#define REVISIT_SERVER_SECURITY_CERTIFICATES_H_

#include <chrono>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"

namespace revisit::server {

using CertificateTime = std::chrono::system_clock::time_point;

// What a listener shows and trusts, in PEM.
struct TlsMaterial {
  std::string private_key;
  // The server's own certificate first, then those that issued it.
  std::string certificate_chain;
  // Who may issue clients' certificates; empty if clients are not asked for
  // any.
  std::string client_authorities;
};

struct TlsSummary {
  // Of the server's own certificate.
  CertificateTime expires;
  std::string serial_number;
};

// Whether a listener can serve with it: the key is whole, not encrypted, and
// that of the first certificate; each certificate of the chain was issued by
// the next; all of them are valid at `now`; OpenSSL takes them at its own level
// of security; and all client authorities are authorities, at least one of them
// valid. INVALID_ARGUMENT with what is wrong otherwise; nothing of the key is
// repeated.
absl::StatusOr<TlsSummary> CheckTlsMaterial(const TlsMaterial& material,
                                            CertificateTime now);

struct ClientCertificate {
  // Alternative names.
  std::vector<std::string> uris;
  std::vector<std::string> dns_names;
  CertificateTime expires;
};

// Reads one that the handshake has verified.
absl::StatusOr<ClientCertificate> ReadClientCertificate(const std::string& pem);

// Whether one of `authorities` stands behind a client's certificate now, by way
// of `chain`, which came with it and may be empty. All in PEM. INVALID_ARGUMENT
// with OpenSSL's reason otherwise.
absl::Status CheckClientAuthority(const std::string& pem,
                                  const std::string& chain,
                                  const std::string& authorities);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SECURITY_CERTIFICATES_H_
