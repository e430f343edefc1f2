#include "server/security/token.h"

#include <openssl/hmac.h>

#include <cstdint>

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "tests/random.h"
#include "tests/server/error_matchers.h"
#include "tests/server/security/token_testing.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using std::chrono::seconds;
using ::testing::AnyOf;
using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::Not;

constexpr std::int64_t kNow = 1'700'000'000;

Token::Time At(std::int64_t unix_seconds) {
  return Token::Time(seconds(unix_seconds));
}

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
// Not in the key set.
const SigningKey& Stranger() {
  static const auto* const key = new SigningKey(SigningKey::Kind::kP256);
  return *key;
}

const JwkSet& Keys() {
  static const auto* const keys =
      new JwkSet(JwkSet::Parse(KeySet({Rsa().Jwk("rsa"), P256().Jwk("ec"),
                                       Ed25519().Jwk("ed")}))
                     .value());
  return *keys;
}

TokenRules Rules() { return {"https://login.example", "revisit", seconds(10)}; }

constexpr char kHeader[] = R"({"alg":"ES256","kid":"ec","typ":"JWT"})";

// The claims of a good token with some of its members, or all, replaced.
std::string Claims(const std::string& more = "",
                   const std::string& issuer = R"("https://login.example")",
                   const std::string& audience = R"("revisit")",
                   const std::string& subject = R"("backend")",
                   const std::string& expires = "1700000100") {
  std::string claims =
      R"({"iss":)" + issuer + R"(,"aud":)" + audience + R"(,"sub":)" + subject;
  if (!expires.empty()) claims += R"(,"exp":)" + expires;
  return claims + more + "}";
}

std::string Good() { return P256().Token(kHeader, Claims()); }

absl::StatusOr<Token> Verify(const std::string& token) {
  return VerifyToken(token, Keys(), Rules());
}

// Everything, time included.
absl::Status Check(const std::string& token, std::int64_t now = kNow) {
  const absl::StatusOr<Token> verified = Verify(token);
  return verified.ok() ? CheckTokenTime(*verified, At(now)) : verified.status();
}

std::string HmacToken(const std::string& header, const std::string& key) {
  const std::string message = Base64Url(header) + "." + Base64Url(Claims());
  std::string mac(EVP_MAX_MD_SIZE, '\0');
  unsigned size = 0;
  HMAC(EVP_sha256(), key.data(), static_cast<int>(key.size()),
       reinterpret_cast<const unsigned char*>(message.data()), message.size(),
       reinterpret_cast<unsigned char*>(mac.data()), &size);
  mac.resize(size);
  return message + "." + Base64Url(mac);
}

TEST(TokenTest, EachAlgorithmIsAcceptedWithItsKey) {
  EXPECT_THAT(Check(Rsa().Token(R"({"alg":"RS256","kid":"rsa"})", Claims())),
              IsOk());
  EXPECT_THAT(Check(P256().Token(R"({"alg":"ES256","kid":"ec"})", Claims())),
              IsOk());
  EXPECT_THAT(Check(Ed25519().Token(R"({"alg":"EdDSA","kid":"ed"})", Claims())),
              IsOk());
}

TEST(TokenTest, TellsWhoAndHowLong) {
  const Token token =
      Verify(P256().Token(
                 kHeader,
                 Claims(R"(,"nbf":1699999000,"groups":["a",1,"b"],"role":"c")",
                        R"("https://login.example")", R"(["x","revisit"])")))
          .value();
  EXPECT_EQ(token.subject, "backend");
  EXPECT_EQ(token.expires, At(1700000110));
  EXPECT_EQ(token.not_before, At(1699998990));
  EXPECT_THAT(token.claims.at("groups"), ElementsAre("a", "b"));
  EXPECT_THAT(token.claims.at("role"), ElementsAre("c"));
  EXPECT_THAT(token.claims.at("sub"), ElementsAre("backend"));
  EXPECT_EQ(token.claims.count("exp"), 0u);
}

TEST(TokenTest, OtherFormsOfAGoodTokenAreAccepted) {
  for (const std::string& token :
       {P256().Token(R"({"alg":"ES256","kid":"ec","typ":"at+jwt"})", Claims()),
        P256().Token(R"({"alg":"ES256","kid":"ec","typ":"jwt","x":1})",
                     Claims()),
        // What a header says of other keys is not looked at.
        P256().Token(R"({"alg":"ES256","kid":"ec","jku":"https://evil.example",
                         "jwk":)" +
                         Stranger().Jwk("ec") + "}",
                     Claims()),
        P256().Token(kHeader, Claims(R"(,"nbf":1699999999.5,"iat":1)")),
        P256().Token(kHeader,
                     Claims("", R"("https://login.example")", R"("revisit")",
                            R"("backend")", "1700000100.75")),
        // Beyond what the clock can hold.
        P256().Token(kHeader,
                     Claims("", R"("https://login.example")", R"("revisit")",
                            R"("backend")", "1e300"))}) {
    EXPECT_THAT(Check(token), IsOk()) << token;
  }
}

TEST(TokenTest, IsValidFromNotBeforeUntilItExpiresWithTheLeeway) {
  const std::string token =
      P256().Token(kHeader, Claims(R"(,"nbf":1700000000)"));
  EXPECT_THAT(Check(token, 1699999989),
              IsError(StatusCode::kUnauthenticated, "TOKEN_NOT_YET_VALID",
                      HasSubstr("nbf")));
  EXPECT_THAT(Check(token, 1699999990), IsOk());
  EXPECT_THAT(Check(token, 1700000109), IsOk());
  EXPECT_THAT(Check(token, 1700000110),
              IsError(StatusCode::kUnauthenticated, "TOKEN_EXPIRED",
                      HasSubstr("expired")));
}

TEST(TokenTest, WhatIsNotAGoodTokenIsRefused) {
  const std::string good = Good();
  const std::size_t first = good.find('.');
  const std::size_t second = good.rfind('.');
  const std::string header = good.substr(0, first);
  const std::string payload = good.substr(first + 1, second - first - 1);
  const std::string signature = good.substr(second + 1);
  const std::string pem = Rsa().PublicPem();
  const auto signed_header = [](const std::string& text) {
    return P256().Token(text, Claims());
  };
  const auto signed_claims = [](const std::string& text) {
    return P256().Token(kHeader, text);
  };
  const std::string iss = R"("https://login.example")";
  const std::string aud = R"("revisit")";
  const std::string sub = R"("backend")";
  std::string zeros(64, '\0');

  const struct {
    const char* name;
    std::string token;
    const char* message;
  } kCases[] = {
      // Form.
      {"empty", "", "form"},
      {"one dot", ".", "form"},
      {"two dots", "..", "form"},
      {"no signature", header + "." + payload, "form"},
      {"empty signature", header + "." + payload + ".", "form"},
      {"four parts", good + ".AAAA", "form"},
      {"five parts, as if encrypted", good + ".AAAA.AAAA", "form"},
      {"nothing of base64", "a b.c d.e f", "header"},
      {"space before", " " + good, "header"},
      {"space after", good + " ", "signature is no base64url"},
      {"newline after", good + "\n", "signature is no base64url"},
      {"padded signature", good + "==", "signature is no base64url"},
      {"padded header", header + "=." + payload + "." + signature, "header"},
      {"base64 with plus and slash", "+/+/." + payload + "." + signature,
       "header"},
      {"cut short", good.substr(0, good.size() - 10), "signature"},
      {"NUL inside",
       header + "." + payload + "." + std::string("\0", 1) + signature,
       "signature is no base64url"},
      {"too long", std::string(9000, 'A') + "." + payload + "." + signature,
       "it has 9"},
      {"huge claims",
       signed_claims(Claims(",\"x\":\"" + std::string(9000, 'a') + "\"")),
       "allowed is 8192"},
      // Header.
      {"header is no JSON", Base64Url("alg") + "." + payload + "." + signature,
       "header"},
      {"header is an array", signed_header("[]"), "header"},
      {"header is not UTF-8", signed_header("{\"alg\":\"\xff\"}"), "header"},
      {"algorithm twice",
       signed_header(R"({"alg":"none","alg":"ES256","kid":"ec"})"), "header"},
      {"deep header",
       signed_header(R"({"alg":"ES256","kid":"ec","x":)" +
                     std::string(200, '[') + std::string(200, ']') + "}"),
       "header"},
      {"alg none",
       Base64Url(R"({"alg":"none","kid":"ec"})") + "." + payload + "." +
           signature,
       "algorithm"},
      {"alg none without signature",
       Base64Url(R"({"alg":"none","kid":"ec"})") + "." + payload + ".", "form"},
      {"alg None", signed_header(R"({"alg":"None","kid":"ec"})"), "algorithm"},
      {"alg es256", signed_header(R"({"alg":"es256","kid":"ec"})"),
       "algorithm"},
      {"alg missing", signed_header(R"({"kid":"ec"})"), "algorithm"},
      {"alg null", signed_header(R"({"alg":null,"kid":"ec"})"), "algorithm"},
      {"alg list", signed_header(R"({"alg":["ES256"],"kid":"ec"})"),
       "algorithm"},
      {"RS384", signed_header(R"({"alg":"RS384","kid":"rsa"})"), "algorithm"},
      {"PS256", signed_header(R"({"alg":"PS256","kid":"rsa"})"), "algorithm"},
      {"HS256 with the public key",
       HmacToken(R"({"alg":"HS256","kid":"rsa"})", pem), "algorithm"},
      {"said to be RS256, made with the public key as a secret",
       HmacToken(R"({"alg":"RS256","kid":"rsa"})", pem),
       "signature does not hold"},
      {"key missing", signed_header(R"({"alg":"ES256"})"), "key"},
      {"key empty", signed_header(R"({"alg":"ES256","kid":""})"), "key"},
      {"key a number", signed_header(R"({"alg":"ES256","kid":1})"), "key"},
      {"key unknown", signed_header(R"({"alg":"ES256","kid":"ec2"})"),
       "does not have the key"},
      {"key a path", signed_header(R"({"alg":"ES256","kid":"../../dev/null"})"),
       "does not have the key"},
      {"key of another algorithm",
       signed_header(R"({"alg":"ES256","kid":"rsa"})"), "another algorithm"},
      {"critical extension",
       signed_header(
           R"({"alg":"ES256","kid":"ec","crit":["b64"],"b64":false})"),
       "crit"},
      {"type of another thing",
       signed_header(R"({"alg":"ES256","kid":"ec","typ":"dpop+jwt"})"), "type"},
      // Signature.
      {"signed by a stranger", Stranger().Token(kHeader, Claims()),
       "signature does not hold"},
      {"key in the header",
       Stranger().Token(
           R"({"alg":"ES256","kid":"ec","jwk":)" + Stranger().Jwk("ec") + "}",
           Claims()),
       "signature does not hold"},
      {"claims of another",
       header + "." + Base64Url(Claims(R"(,"a":1)")) + "." + signature,
       "signature does not hold"},
      {"signature of zeros", header + "." + payload + "." + Base64Url(zeros),
       "signature does not hold"},
      {"signature too short", header + "." + payload + ".AAAA",
       "signature does not hold"},
      {"signature too long",
       header + "." + payload + "." + Base64Url(std::string(65, 'a')),
       "signature does not hold"},
      // Claims.
      {"claims are no JSON", signed_claims("exp"), "payload"},
      {"claims are a list", signed_claims("[]"), "payload"},
      {"subject twice", signed_claims(Claims(R"(,"sub":"admin")")), "payload"},
      {"deep claims",
       signed_claims(
           Claims(",\"x\":" + std::string(99, '[') + std::string(99, ']'))),
       "payload"},
      {"issuer missing",
       signed_claims(R"({"aud":"revisit","sub":"a","exp":1700000100})"),
       "issuer"},
      {"another issuer", signed_claims(Claims("", R"("https://evil.example")")),
       "issuer"},
      {"issuers in a list",
       signed_claims(Claims("", R"(["https://login.example"])")), "issuer"},
      {"issuer with a slash more",
       signed_claims(Claims("", R"("https://login.example/")")), "issuer"},
      {"audience missing",
       signed_claims(
           R"({"iss":"https://login.example","sub":"a","exp":1700000100})"),
       "audience"},
      {"another audience", signed_claims(Claims("", iss, R"("other")")),
       "audience"},
      {"other audiences",
       signed_claims(Claims("", iss, R"(["other","revisit2"])")), "audience"},
      {"no audience in the list", signed_claims(Claims("", iss, "[]")),
       "audience"},
      {"audience in other case", signed_claims(Claims("", iss, R"("Revisit")")),
       "audience"},
      {"subject missing", signed_claims(Claims("", iss, aud, "null")),
       "subject"},
      {"subject empty", signed_claims(Claims("", iss, aud, R"("")")),
       "subject"},
      {"subject a number", signed_claims(Claims("", iss, aud, "7")), "subject"},
      {"subject too long",
       signed_claims(Claims("", iss, aud, "\"" + std::string(257, 'a') + "\"")),
       "subject"},
      {"expiry missing", signed_claims(Claims("", iss, aud, sub, "")),
       "when it expires"},
      {"expiry a text",
       signed_claims(Claims("", iss, aud, sub, R"("1700000100")")), "exp"},
      {"expiry negative", signed_claims(Claims("", iss, aud, sub, "-1")),
       "exp"},
      {"expiry null", signed_claims(Claims("", iss, aud, sub, "null")), "exp"},
      {"expiry beyond all numbers",
       signed_claims(Claims("", iss, aud, sub, "1e999")), "payload"},
      {"not before a text", signed_claims(Claims(R"(,"nbf":"1")")), "nbf"},
      {"issued at a list", signed_claims(Claims(R"(,"iat":[1])")), "iat"},
  };
  for (const auto& test : kCases) {
    SCOPED_TRACE(test.name);
    EXPECT_THAT(Check(test.token),
                IsError(StatusCode::kUnauthenticated, "CREDENTIALS_INVALID",
                        HasSubstr(test.message)));
  }
  EXPECT_GE(std::size(kCases), 40u);
}

TEST(TokenTest, ExpiryIsToldOnlyToWhoeverHasASignedToken) {
  const std::string expired =
      Claims("", R"("https://login.example")", R"("revisit")", R"("backend")",
             "1600000000");
  EXPECT_THAT(Check(P256().Token(kHeader, expired)),
              IsError(StatusCode::kUnauthenticated, "TOKEN_EXPIRED",
                      HasSubstr("expired")));
  EXPECT_THAT(Check(Stranger().Token(kHeader, expired)),
              IsError(StatusCode::kUnauthenticated, "CREDENTIALS_INVALID",
                      HasSubstr("signature")));
}

TEST(TokenTest, NoChangeOfOneCharacterIsAccepted) {
  const std::string good = Good();
  auto random = SeededRandom();
  for (std::size_t at = 0; at < good.size(); ++at) {
    std::string changed = good;
    changed[at] = static_cast<char>(random() % 256);
    if (changed == good) continue;
    EXPECT_THAT(Check(changed),
                IsError(StatusCode::kUnauthenticated, "CREDENTIALS_INVALID",
                        HasSubstr("not accepted")))
        << "at " << at;
  }
}

TEST(TokenTest, MessagesRepeatNothingOfAnUnverifiedToken) {
  const std::string secret = "hunter2hunter2";
  const absl::Status status =
      Check(Stranger().Token(R"({"alg":"ES256","kid":"hunter2hunter2"})",
                             Claims("", "\"" + secret + "\"")));
  EXPECT_THAT(std::string(status.message()), Not(HasSubstr(secret)));
}

}  // namespace
}  // namespace revisit::server
