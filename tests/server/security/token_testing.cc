#include "tests/server/security/token_testing.h"

#include <openssl/core_names.h>
#include <openssl/ec.h>
#include <openssl/pem.h>
#include <openssl/rsa.h>

#include <cstddef>

#include "absl/strings/escaping.h"
#include "absl/strings/string_view.h"

namespace revisit::server {
namespace {

const unsigned char* Bytes(const std::string& text) {
  return reinterpret_cast<const unsigned char*>(text.data());
}

std::string BigEndian(const BIGNUM* number, int bytes) {
  std::string text(static_cast<std::size_t>(bytes), '\0');
  BN_bn2binpad(number, reinterpret_cast<unsigned char*>(text.data()), bytes);
  return text;
}

EVP_PKEY* Make(SigningKey::Kind kind, int rsa_bits) {
  switch (kind) {
    case SigningKey::Kind::kRsa:
      return EVP_RSA_gen(static_cast<unsigned>(rsa_bits));
    case SigningKey::Kind::kP256:
      return EVP_EC_gen("P-256");
    case SigningKey::Kind::kEd25519:
      return EVP_PKEY_Q_keygen(nullptr, nullptr, "ED25519");
  }
  return nullptr;
}

}  // namespace

std::string Base64Url(const std::string& bytes) {
  std::string text;
  absl::WebSafeBase64Escape(absl::string_view(bytes.data(), bytes.size()),
                            &text);
  return text;
}

SigningKey::SigningKey(Kind kind, int rsa_bits)
    : kind_(kind), key_(Make(kind, rsa_bits)) {}

std::string SigningKey::Number(const char* parameter, int bytes) const {
  BIGNUM* number = nullptr;
  EVP_PKEY_get_bn_param(key_.get(), parameter, &number);
  const openssl::BigNumber owned(number);
  return Base64Url(BigEndian(number, bytes > 0 ? bytes : BN_num_bytes(number)));
}

std::string SigningKey::Jwk(const std::string& key_id,
                            const std::string& more) const {
  std::string jwk = R"({"kid":")" + key_id + R"(",)";
  switch (kind_) {
    case Kind::kRsa:
      jwk += R"("kty":"RSA","n":")" + Number(OSSL_PKEY_PARAM_RSA_N, 0) +
             R"(","e":")" + Number(OSSL_PKEY_PARAM_RSA_E, 0) + "\"";
      break;
    case Kind::kP256:
      jwk += R"("kty":"EC","crv":"P-256","x":")" +
             Number(OSSL_PKEY_PARAM_EC_PUB_X, 32) + R"(","y":")" +
             Number(OSSL_PKEY_PARAM_EC_PUB_Y, 32) + "\"";
      break;
    case Kind::kEd25519: {
      std::string raw(32, '\0');
      std::size_t size = raw.size();
      EVP_PKEY_get_raw_public_key(
          key_.get(), reinterpret_cast<unsigned char*>(raw.data()), &size);
      jwk += R"("kty":"OKP","crv":"Ed25519","x":")" + Base64Url(raw) + "\"";
      break;
    }
  }
  return jwk + more + "}";
}

std::string SigningKey::PublicPem() const {
  const openssl::Bio bio(BIO_new(BIO_s_mem()));
  PEM_write_bio_PUBKEY(bio.get(), key_.get());
  char* text = nullptr;
  const long size = BIO_get_mem_data(bio.get(), &text);
  return std::string(text, static_cast<std::size_t>(size));
}

std::string SigningKey::Sign(const std::string& message) const {
  const openssl::DigestContext context(EVP_MD_CTX_new());
  EVP_DigestSignInit(context.get(), nullptr,
                     kind_ == Kind::kEd25519 ? nullptr : EVP_sha256(), nullptr,
                     key_.get());
  std::size_t size = 0;
  EVP_DigestSign(context.get(), nullptr, &size, Bytes(message), message.size());
  std::string signature(size, '\0');
  EVP_DigestSign(context.get(),
                 reinterpret_cast<unsigned char*>(signature.data()), &size,
                 Bytes(message), message.size());
  signature.resize(size);
  if (kind_ != Kind::kP256) return signature;
  const unsigned char* der = Bytes(signature);
  const openssl::EcdsaSignature pair(
      d2i_ECDSA_SIG(nullptr, &der, static_cast<long>(signature.size())));
  return BigEndian(ECDSA_SIG_get0_r(pair.get()), 32) +
         BigEndian(ECDSA_SIG_get0_s(pair.get()), 32);
}

std::string SigningKey::Token(const std::string& header,
                              const std::string& payload) const {
  const std::string message = Base64Url(header) + "." + Base64Url(payload);
  return message + "." + Base64Url(Sign(message));
}

std::string KeySet(std::initializer_list<std::string> keys) {
  std::string set = R"({"keys":[)";
  const char* separator = "";
  for (const std::string& key : keys) {
    set += separator + key;
    separator = ",";
  }
  return set + "]}";
}

}  // namespace revisit::server
