// Checks X.509 certificates before a listener uses them, and reads those that
// clients present.
#ifndef REVISIT_SERVER_SECURITY_CERTIFICATES_H_
#define REVISIT_SERVER_SECURITY_CERTIFICATES_H_

#include <chrono>
#include <cstddef>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"

namespace revisit::server {

using CertificateTime = std::chrono::system_clock::time_point;

// Key and certificates of a listener, and the authorities it trusts, in PEM.
struct TlsMaterial {
  std::string private_key;
  // The server's own certificate first, then those that issued it.
  std::string certificate_chain;
  // Who may issue clients' certificates; empty if clients are not asked for
  // any.
  std::string client_authorities;
};

struct TlsSummary {
  // When the server's own certificate expires.
  CertificateTime expires;
  std::string serial_number;
};

// Checks whether a listener can serve with the material: the key is whole, not
// encrypted, and belongs to the first certificate; each certificate of the
// chain was issued by the next; all of them are valid at `now`; OpenSSL takes
// them at its own level of security; and all client authorities are
// authorities, at least one of them valid. Otherwise INVALID_ARGUMENT, which
// says what is wrong and repeats nothing of the key.
absl::StatusOr<TlsSummary> CheckTlsMaterial(const TlsMaterial& material,
                                            CertificateTime now);

// Longest name of a client certificate that is read: SPIFFE ids are no longer.
inline constexpr std::size_t kMaxCertificateNameBytes = 2048;

struct ClientCertificate {
  // Alternative names, but for those that are too long or not of printable
  // ASCII, of which their type consists by its standard (RFC 5280).
  std::vector<std::string> uris;
  std::vector<std::string> dns_names;
  CertificateTime expires;
};

// Reads a certificate that the handshake has verified.
absl::StatusOr<ClientCertificate> ReadClientCertificate(const std::string& pem);

// OK if one of `authorities` vouches for a client's certificate now, by way of
// `chain`, which came with it and may be empty. All in PEM. Otherwise
// INVALID_ARGUMENT with OpenSSL's reason.
absl::Status CheckClientAuthority(const std::string& pem,
                                  const std::string& chain,
                                  const std::string& authorities);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SECURITY_CERTIFICATES_H_
