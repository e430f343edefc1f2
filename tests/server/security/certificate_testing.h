// Issues certificates.
#ifndef REVISIT_TESTS_SERVER_SECURITY_CERTIFICATE_TESTING_H_
#define REVISIT_TESTS_SERVER_SECURITY_CERTIFICATE_TESTING_H_

#include <chrono>
#include <string>

#include "core/base/openssl_pointers.h"

namespace revisit::server {

inline std::chrono::system_clock::time_point Now() {
  return std::chrono::system_clock::now();
}

struct CertificateRequest {
  std::string common_name = "localhost";
  // As OpenSSL writes them: "URI:spiffe://a/b,DNS:c". Empty: none.
  std::string alternative_names;
  bool is_authority = false;
  std::chrono::system_clock::time_point from = Now() - std::chrono::hours(1);
  std::chrono::system_clock::time_point until =
      Now() + std::chrono::hours(24 * 365);
  int rsa_bits = 0;  // 0: a key on P-256.
};

// A certificate and its key.
class TestCertificate {
 public:
  // Issued by `issuer`, or by itself if that is null.
  explicit TestCertificate(const CertificateRequest& request,
                           const TestCertificate* issuer = nullptr);

  std::string Pem() const;
  std::string KeyPem() const;

 private:
  openssl::Key key_;
  openssl::Certificate certificate_;
};

}  // namespace revisit::server

#endif  // REVISIT_TESTS_SERVER_SECURITY_CERTIFICATE_TESTING_H_
