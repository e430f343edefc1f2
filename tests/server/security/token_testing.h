// Issues tokens, good ones and others.
#ifndef REVISIT_TESTS_SERVER_SECURITY_TOKEN_TESTING_H_
#define REVISIT_TESTS_SERVER_SECURITY_TOKEN_TESTING_H_

#include <string>

#include "core/base/openssl_pointers.h"

namespace revisit::server {

std::string Base64Url(const std::string& bytes);

class SigningKey {
 public:
  enum class Kind { kRsa, kP256, kEd25519 };
  // A new key.
  explicit SigningKey(Kind kind, int rsa_bits = 2048);

  // The public key as an object of JSON, with more members before its end, such
  // as R"(,"alg":"RS256")".
  std::string Jwk(const std::string& key_id,
                  const std::string& more = "") const;
  std::string PublicPem() const;

  // As a JSON Web Signature has it.
  std::string Sign(const std::string& message) const;

  // header.payload.signature.
  std::string Token(const std::string& header,
                    const std::string& payload) const;

 private:
  std::string Number(const char* parameter, int bytes) const;

  const Kind kind_;
  openssl::Key key_;
};

// {"keys": [...]}
std::string KeySet(std::initializer_list<std::string> keys);

}  // namespace revisit::server

#endif  // REVISIT_TESTS_SERVER_SECURITY_TOKEN_TESTING_H_
