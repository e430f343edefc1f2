// Bearer tokens: JSON Web Tokens (RFC 7519), signed, in the compact form.
//
// Debian 12 has three libraries for them. libjwt 1.10 and cpp-jwt 1.4 know
// neither EdDSA nor key sets; rhonabwy 1.1 knows both, and brings GnuTLS, curl,
// LDAP and Kerberos into the process. So OpenSSL verifies signatures,
// nlohmann's parser reads JSON, and this file reads no more than a signed token
// needs: no encryption, no key or address of a key in the token, no extension.
#ifndef REVISIT_SERVER_SECURITY_TOKEN_H_
#define REVISIT_SERVER_SECURITY_TOKEN_H_

#include <chrono>
#include <map>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/security/jwk_set.h"

namespace revisit::server {

struct TokenRules {
  // Required value of `iss`.
  std::string issuer;
  // Required value of `aud`, or of one entry if that is an array.
  std::string audience;
  // How far the clocks of issuer and server may be apart.
  std::chrono::seconds leeway{0};
};

struct Token {
  using Time = std::chrono::system_clock::time_point;

  std::string subject;
  // The token is valid in [not_before, expires), which includes the leeway.
  Time not_before = Time::min();
  Time expires = Time::max();
  // All claims that are a string or an array with strings; `sub` is among them.
  std::map<std::string, std::vector<std::string>> claims;
};

// Longest token taken. Debian's gRPC takes 8 KiB of metadata in all.
inline constexpr std::size_t kMaxTokenBytes = 8192;

// Checks everything but the time. UNAUTHENTICATED (CREDENTIALS_INVALID) with a
// message that says what is wrong and repeats nothing of an unverified token.
//
// A valid token is header.payload.signature, each in strict base64url. Its
// header has `alg` RS256, ES256 or EdDSA, the `kid` of a key for just that
// algorithm, no `crit`, and no `typ` other than JWT or at+jwt. Its signature
// verifies. Its claims have `iss`, `aud`, a `sub` of 1 to 256 bytes, `exp`, and
// numbers in `nbf` and `iat` if these are present.
absl::StatusOr<Token> VerifyToken(const std::string& text, const JwkSet& keys,
                                  const TokenRules& rules);

// UNAUTHENTICATED (TOKEN_EXPIRED, TOKEN_NOT_YET_VALID) if the token is not
// valid at `now`.
absl::Status CheckTokenTime(const Token& token, Token::Time now);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SECURITY_TOKEN_H_
