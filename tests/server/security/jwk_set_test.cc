#include "server/security/jwk_set.h"

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "tests/server/error_matchers.h"
#include "tests/server/security/token_testing.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using ::testing::HasSubstr;

using Result = JwkSet::Result;

const SigningKey& Rsa() {
  static const auto* const key = new SigningKey(SigningKey::Kind::kRsa);
  return *key;
}
const SigningKey& P256() {
  static const auto* const key = new SigningKey(SigningKey::Kind::kP256);
  return *key;
}
const SigningKey& Ed25519() {
  static const auto* const key = new SigningKey(SigningKey::Kind::kEd25519);
  return *key;
}

TEST(JwkSetTest, VerifiesWithTheKeyThatIsNamed) {
  const JwkSet keys =
      JwkSet::Parse(
          KeySet({Rsa().Jwk("r", R"(,"alg":"RS256","use":"sig","x5t":"abc")"),
                  P256().Jwk("e", R"(,"key_ops":["verify"])"),
                  Ed25519().Jwk("d")}))
          .value();
  EXPECT_EQ(keys.size(), 3u);
  const std::string text = "message";
  EXPECT_EQ(keys.Verify("r", "RS256", text, Rsa().Sign(text)), Result::kGood);
  EXPECT_EQ(keys.Verify("e", "ES256", text, P256().Sign(text)), Result::kGood);
  EXPECT_EQ(keys.Verify("d", "EdDSA", text, Ed25519().Sign(text)),
            Result::kGood);
  EXPECT_EQ(keys.Verify("r", "RS256", "other", Rsa().Sign(text)),
            Result::kBadSignature);
  EXPECT_EQ(keys.Verify("e", "ES256", text, ""), Result::kBadSignature);
  EXPECT_EQ(keys.Verify("e", "RS256", text, Rsa().Sign(text)),
            Result::kWrongAlgorithm);
  EXPECT_EQ(keys.Verify("x", "RS256", text, Rsa().Sign(text)),
            Result::kUnknownKey);
}

TEST(JwkSetTest, PassesOverKeysForOtherUse) {
  const JwkSet keys =
      JwkSet::Parse(
          KeySet({Rsa().Jwk("a", R"(,"use":"enc")"),
                  Rsa().Jwk("b", R"(,"alg":"RS512")"),
                  R"({"kty":"EC","crv":"P-384","kid":"c","x":"AA","y":"AA"})",
                  R"({"kty":"OKP","crv":"X25519","kid":"d","x":"AA"})",
                  R"({"kty":"later"})", P256().Jwk("e")}))
          .value();
  EXPECT_EQ(keys.size(), 1u);
  EXPECT_EQ(keys.Verify("e", "ES256", "m", P256().Sign("m")), Result::kGood);
}

TEST(JwkSetTest, RefusesWhatIsNoSetOfGoodPublicKeys) {
  const SigningKey small(SigningKey::Kind::kRsa, 1024);
  const std::string good = P256().Jwk("e");
  const std::string x32 = Base64Url(std::string(32, '\x01'));
  const struct {
    std::string text;
    const char* problem;
  } kCases[] = {
      {"", "line 1, column 1"},
      {"[]", "not a key set"},
      {"{}", "not a key set"},
      {R"({"keys":{}})", "not a key set"},
      {R"({"keys":[]})", "no key for RS256"},
      {KeySet({good}).substr(0, 60), "syntax error"},
      {KeySet({good}) + "x", "syntax error"},
      {KeySet({"1"}), "keys[0]: not an object"},
      {R"({"keys":[],"keys":[]})", "stands twice"},
      {KeySet({good, good}), "keys[1]: a second key of this \"kid\""},
      {KeySet({P256().Jwk("")}), "keys[0]: \"kid\" is missing"},
      {KeySet({P256().Jwk("e", R"(,"d":"AAAA")")}), "keys[0]: a private"},
      {KeySet({good, R"({"kty":"oct","kid":"k","k":"AAAA"})"}),
       "keys[1]: a private or symmetric key"},
      {KeySet({small.Jwk("s")}), "an RSA key of 1024 bits"},
      {KeySet({R"({"kty":"RSA","kid":"a","n":"AQ","e":"AQAB"})"}),
       "an RSA key of 1 bits"},
      {KeySet({R"({"kty":"RSA","kid":"a","e":"AQAB"})"}), "\"n\" or \"e\""},
      {KeySet({R"({"kty":"RSA","kid":"a","n":")" +
               Base64Url(std::string(256, '\xff')) + R"(","e":"AQ"})"}),
       "no RSA key"},
      {KeySet({R"({"kty":"RSA","kid":"a","n":")" +
               Base64Url(std::string(2048, '\xff')) + R"(","e":"AQAB"})"}),
       "an RSA key of 16384 bits"},
      {KeySet({R"({"kty":"EC","crv":"P-256","kid":"a","x":")" + x32 + "\"}"}),
       "\"x\" or \"y\""},
      {KeySet({R"({"kty":"EC","crv":"P-256","kid":"a","x":")" + x32 +
               R"(","y":")" + x32 + "\"}"}),
       "no point of P-256"},
      {KeySet({R"({"kty":"EC","crv":"P-256","kid":"a","x":"AQ","y":"AQ"})"}),
       "not of 32 bytes"},
      {KeySet({R"({"kty":"OKP","crv":"Ed25519","kid":"a","x":"AQ=="})"}),
       "not of 32 bytes"},
  };
  for (const auto& test : kCases) {
    const auto keys = JwkSet::Parse(test.text);
    EXPECT_EQ(keys.status().code(), StatusCode::kInvalidArgument) << test.text;
    EXPECT_THAT(std::string(keys.status().message()), HasSubstr(test.problem))
        << test.text;
  }
}

}  // namespace
}  // namespace revisit::server
