// Public keys by which tokens are verified, from a JSON Web Key Set (RFC 7517).
#ifndef REVISIT_SERVER_SECURITY_JWK_SET_H_
#define REVISIT_SERVER_SECURITY_JWK_SET_H_

#include <cstddef>
#include <map>
#include <memory>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"

namespace revisit::server {

// Immutable; copies share the keys. Thread-safe.
//
// A key is for one algorithm, which follows from its kind and nothing else:
//   RSA of 2048 to 8192 bits    RS256
//   EC on P-256                 ES256
//   OKP on Ed25519              EdDSA
// So a token cannot choose how its own signature is verified.
class JwkSet {
 public:
  // Keys of other kinds, for other algorithms or other uses are skipped:
  // issuers publish them side by side. INVALID_ARGUMENT if the text is no key
  // set, if a key to be used is malformed, has no `kid` or the `kid` of
  // another, if no key can be used, or if there is a private or symmetric key.
  static absl::StatusOr<JwkSet> Parse(const std::string& text);

  std::size_t size() const { return keys_.size(); }

  enum class Result { kGood, kUnknownKey, kWrongAlgorithm, kBadSignature };
  // Verifies that the key of this id made `signature`, in the form of a JSON
  // Web Signature (RFC 7518), over `message`. kWrongAlgorithm if the key is not
  // for `algorithm`.
  Result Verify(const std::string& key_id, const std::string& algorithm,
                const std::string& message, const std::string& signature) const;

 private:
  struct PublicKey;
  std::map<std::string, std::shared_ptr<const PublicKey>> keys_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SECURITY_JWK_SET_H_
