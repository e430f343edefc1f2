#include "server/security/jwk_set.h"

#include <openssl/core_names.h>
#include <openssl/err.h>

#include <nlohmann/json.hpp>
#include <optional>
#include <utility>

#include "core/base/openssl_pointers.h"
#include "server/security/base64url.h"
#include "server/security/strict_json.h"

namespace revisit::server {
namespace {

using Json = nlohmann::json;

constexpr int kMinRsaBits = 2048;
// Longest RSA key: the time to verify grows with the square of its length.
constexpr int kMaxRsaBits = 8192;
constexpr int kMaxExponentBits = 64;
constexpr std::size_t kCoordinateBytes = 32;

const unsigned char* Bytes(const std::string& text) {
  return reinterpret_cast<const unsigned char*>(text.data());
}

// The text of a member; empty if there is no such member. Members that are not
// strings are found by the check of all members.
std::string Text(const Json& key, const char* member) {
  const auto found = key.find(member);
  return found != key.end() && found->is_string() ? found->get<std::string>()
                                                  : "";
}

// The bytes of a member; nullopt if it is missing or malformed.
std::optional<std::string> Binary(const Json& key, const char* member) {
  const std::string text = Text(key, member);
  if (text.empty()) return std::nullopt;
  return DecodeBase64Url(text);
}

openssl::BigNumber Number(const std::string& bytes) {
  return openssl::BigNumber(
      BN_bin2bn(Bytes(bytes), static_cast<int>(bytes.size()), nullptr));
}

openssl::Key FromParams(const char* type, OSSL_PARAM_BLD* builder) {
  const openssl::Params params(OSSL_PARAM_BLD_to_param(builder));
  const openssl::KeyContext context(
      EVP_PKEY_CTX_new_from_name(nullptr, type, nullptr));
  EVP_PKEY* key = nullptr;
  if (params == nullptr || context == nullptr ||
      EVP_PKEY_fromdata_init(context.get()) != 1 ||
      EVP_PKEY_fromdata(context.get(), &key, EVP_PKEY_PUBLIC_KEY,
                        params.get()) != 1) {
    ERR_clear_error();
    return nullptr;
  }
  return openssl::Key(key);
}

absl::StatusOr<openssl::Key> RsaKey(const Json& key, const std::string& where) {
  const auto n = Binary(key, "n");
  const auto e = Binary(key, "e");
  if (!n || !e)
    return ProblemAt(where, "\"n\" or \"e\" is missing or malformed");
  const openssl::BigNumber modulus = Number(*n);
  const openssl::BigNumber exponent = Number(*e);
  const int bits = BN_num_bits(modulus.get());
  if (bits < kMinRsaBits || bits > kMaxRsaBits) {
    return ProblemAt(where, "an RSA key of " + std::to_string(bits) +
                                " bits; allowed is " +
                                std::to_string(kMinRsaBits) + " to " +
                                std::to_string(kMaxRsaBits));
  }
  const int exponent_bits = BN_num_bits(exponent.get());
  if (BN_is_odd(modulus.get()) == 0 || BN_is_odd(exponent.get()) == 0 ||
      exponent_bits < 2 || exponent_bits > kMaxExponentBits) {
    return ProblemAt(where, "\"n\" and \"e\" are no RSA key");
  }
  const openssl::ParamsBuilder builder(OSSL_PARAM_BLD_new());
  OSSL_PARAM_BLD_push_BN(builder.get(), OSSL_PKEY_PARAM_RSA_N, modulus.get());
  OSSL_PARAM_BLD_push_BN(builder.get(), OSSL_PKEY_PARAM_RSA_E, exponent.get());
  openssl::Key made = FromParams("RSA", builder.get());
  if (made == nullptr)
    return ProblemAt(where, "\"n\" and \"e\" are no RSA key");
  return made;
}

absl::StatusOr<openssl::Key> EcKey(const Json& key, const std::string& where) {
  const auto x = Binary(key, "x");
  const auto y = Binary(key, "y");
  if (!x || !y || x->size() != kCoordinateBytes ||
      y->size() != kCoordinateBytes) {
    return ProblemAt(where, "\"x\" or \"y\" is missing or not of 32 bytes");
  }
  const std::string point = '\x04' + *x + *y;
  const openssl::ParamsBuilder builder(OSSL_PARAM_BLD_new());
  OSSL_PARAM_BLD_push_utf8_string(builder.get(), OSSL_PKEY_PARAM_GROUP_NAME,
                                  "prime256v1", 0);
  OSSL_PARAM_BLD_push_octet_string(builder.get(), OSSL_PKEY_PARAM_PUB_KEY,
                                   point.data(), point.size());
  openssl::Key made = FromParams("EC", builder.get());
  if (made == nullptr)
    return ProblemAt(where, "\"x\", \"y\" is no point of P-256");
  return made;
}

absl::StatusOr<openssl::Key> Ed25519Key(const Json& key,
                                        const std::string& where) {
  const auto x = Binary(key, "x");
  if (!x || x->size() != kCoordinateBytes) {
    return ProblemAt(where, "\"x\" is missing or not of 32 bytes");
  }
  openssl::Key made(EVP_PKEY_new_raw_public_key(EVP_PKEY_ED25519, nullptr,
                                                Bytes(*x), x->size()));
  if (made == nullptr) return ProblemAt(where, "\"x\" is no key of Ed25519");
  return made;
}

// Kinds of keys that can be used.
struct Kind {
  const char* type;
  // Null if the type has no curves.
  const char* curve;
  const char* algorithm;
  absl::StatusOr<openssl::Key> (*make)(const Json&, const std::string&);
};
constexpr Kind kKinds[] = {{"RSA", nullptr, "RS256", RsaKey},
                           {"EC", "P-256", "ES256", EcKey},
                           {"OKP", "Ed25519", "EdDSA", Ed25519Key}};

// The kind of a key; null for a key that is not to be used here.
const Kind* KindOf(const Json& key) {
  const std::string use = Text(key, "use");
  if (!use.empty() && use != "sig") return nullptr;
  const std::string algorithm = Text(key, "alg");
  for (const Kind& kind : kKinds) {
    if (Text(key, "kty") != kind.type) continue;
    if (kind.curve != nullptr && Text(key, "crv") != kind.curve) continue;
    if (!algorithm.empty() && algorithm != kind.algorithm) continue;
    return &kind;
  }
  return nullptr;
}

// Converts a signature of ECDSA's two numbers side by side to the DER that
// OpenSSL takes. Empty if it fails.
std::string ToDer(const std::string& signature) {
  if (signature.size() != 2 * kCoordinateBytes) return "";
  openssl::EcdsaSignature pair(ECDSA_SIG_new());
  openssl::BigNumber r = Number(signature.substr(0, kCoordinateBytes));
  openssl::BigNumber s = Number(signature.substr(kCoordinateBytes));
  if (ECDSA_SIG_set0(pair.get(), r.get(), s.get()) != 1) return "";
  // The pair owns them now.
  static_cast<void>(r.release());
  static_cast<void>(s.release());
  unsigned char* encoded = nullptr;
  const int size = i2d_ECDSA_SIG(pair.get(), &encoded);
  if (size <= 0) return "";
  const std::string der(reinterpret_cast<const char*>(encoded),
                        static_cast<std::size_t>(size));
  OPENSSL_free(encoded);
  return der;
}

}  // namespace

struct JwkSet::PublicKey {
  const Kind* kind;
  openssl::Key key;
};

absl::StatusOr<JwkSet> JwkSet::Parse(const std::string& text) {
  Json set;
  if (absl::Status status = ParseStrictJson(text, &set); !status.ok()) {
    return status;
  }
  if (!set.is_object() || !set.contains("keys") || !set["keys"].is_array()) {
    return absl::InvalidArgumentError(
        "not a key set: an object with an array \"keys\"");
  }
  JwkSet result;
  std::size_t number = 0;
  for (const Json& key : set["keys"]) {
    const std::string where = "keys[" + std::to_string(number++) + "]";
    if (!key.is_object()) return ProblemAt(where, "not an object");
    if (key.contains("d") || key.contains("k")) {
      return ProblemAt(
          where,
          "a private or symmetric key; the server needs public keys "
          "only, and nobody else's secrets");
    }
    const Kind* const kind = KindOf(key);
    if (kind == nullptr) continue;
    const std::string id = Text(key, "kid");
    if (id.empty()) return ProblemAt(where, "\"kid\" is missing");
    absl::StatusOr<openssl::Key> made = kind->make(key, where);
    if (!made.ok()) return made.status();
    const auto shared =
        std::make_shared<const PublicKey>(PublicKey{kind, *std::move(made)});
    if (!result.keys_.emplace(id, shared).second) {
      return ProblemAt(where, "a second key of this \"kid\"");
    }
  }
  if (result.keys_.empty()) {
    return absl::InvalidArgumentError(
        "no key for RS256 (RSA), ES256 (EC, P-256) or EdDSA (OKP, Ed25519)");
  }
  return result;
}

JwkSet::Result JwkSet::Verify(const std::string& key_id,
                              const std::string& algorithm,
                              const std::string& message,
                              const std::string& signature) const {
  const auto found = keys_.find(key_id);
  if (found == keys_.end()) return Result::kUnknownKey;
  const PublicKey& key = *found->second;
  if (algorithm != key.kind->algorithm) return Result::kWrongAlgorithm;
  const int type = EVP_PKEY_get_base_id(key.key.get());
  const std::string encoded =
      type == EVP_PKEY_EC ? ToDer(signature) : signature;
  const openssl::DigestContext context(EVP_MD_CTX_new());
  // Ed25519 hashes by itself.
  const EVP_MD* const digest =
      type == EVP_PKEY_ED25519 ? nullptr : EVP_sha256();
  const bool good =
      !encoded.empty() &&
      EVP_DigestVerifyInit(context.get(), nullptr, digest, nullptr,
                           key.key.get()) == 1 &&
      EVP_DigestVerify(context.get(), Bytes(encoded), encoded.size(),
                       Bytes(message), message.size()) == 1;
  // Errors left in the queue would be taken for those of a later operation,
  // such as one of TLS.
  ERR_clear_error();
  return good ? Result::kGood : Result::kBadSignature;
}

}  // namespace revisit::server
