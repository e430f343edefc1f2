#include "server/security/token.h"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <nlohmann/json.hpp>
#include <optional>
#include <utility>

#include "absl/strings/ascii.h"
#include "server/base/status.h"
#include "server/security/base64url.h"
#include "server/security/strict_json.h"

namespace revisit::server {
namespace {

using Json = nlohmann::json;
using std::chrono::seconds;

constexpr std::size_t kMaxSubjectBytes = 256;
// A time of the system's clock, which counts nanoseconds, ends in 2262.
constexpr double kMaxSeconds = 8e9;

absl::Status Invalid(const std::string& what) {
  return Error(absl::StatusCode::kUnauthenticated, "CREDENTIALS_INVALID",
               "the bearer token is not accepted: " + what);
}

// The JSON object in one part of a token; nullopt if there is none.
std::optional<Json> Object(const std::string& encoded) {
  const std::optional<std::string> text = DecodeBase64Url(encoded);
  if (!text) return std::nullopt;
  Json object;
  if (!ParseStrictJson(*text, &object).ok() || !object.is_object()) {
    return std::nullopt;
  }
  return object;
}

// The text of a member; empty if it is no string.
std::string Text(const Json& object, const char* member) {
  const auto found = object.find(member);
  return found != object.end() && found->is_string() ? found->get<std::string>()
                                                     : "";
}

// The time of a claim; nullopt if it is missing or is no number of seconds.
std::optional<Token::Time> TimeOf(const Json& claims, const char* name) {
  const auto found = claims.find(name);
  if (found == claims.end() || !found->is_number()) return std::nullopt;
  const auto value = found->get<double>();
  if (!std::isfinite(value) || value < 0) return std::nullopt;
  return Token::Time(seconds(
      static_cast<std::int64_t>(std::floor(std::min(value, kMaxSeconds)))));
}

std::vector<std::string> Texts(const Json& value) {
  std::vector<std::string> texts;
  if (value.is_string()) {
    texts.push_back(value.get<std::string>());
  } else if (value.is_array()) {
    for (const Json& element : value) {
      if (element.is_string()) texts.push_back(element.get<std::string>());
    }
  }
  return texts;
}

// Splits at the dots; nullopt unless there are three non-empty parts.
std::optional<std::vector<std::string>> Parts(const std::string& text) {
  std::vector<std::string> parts;
  std::size_t start = 0;
  while (true) {
    const std::size_t dot = text.find('.', start);
    parts.push_back(text.substr(start, dot - start));
    if (parts.back().empty() || parts.size() > 3) return std::nullopt;
    if (dot == std::string::npos) break;
    start = dot + 1;
  }
  if (parts.size() != 3) return std::nullopt;
  return parts;
}

absl::Status CheckHeader(const Json& header) {
  const std::string algorithm = Text(header, "alg");
  if (algorithm != "RS256" && algorithm != "ES256" && algorithm != "EdDSA") {
    return Invalid("its algorithm; allowed is RS256, ES256 or EdDSA");
  }
  if (Text(header, "kid").empty()) {
    return Invalid("its header names no key (\"kid\")");
  }
  if (header.contains("crit")) {
    return Invalid("its header has \"crit\", and no extension is known here");
  }
  if (header.contains("typ")) {
    const std::string type = absl::AsciiStrToLower(Text(header, "typ"));
    if (type != "jwt" && type != "at+jwt") {
      return Invalid("its type; allowed is JWT or at+jwt");
    }
  }
  return absl::OkStatus();
}

absl::StatusOr<Token> ReadClaims(const Json& claims, const TokenRules& rules) {
  if (Text(claims, "iss") != rules.issuer) {
    return Invalid("its issuer (\"iss\") is not " + rules.issuer);
  }
  Token token;
  for (const auto& [name, value] : claims.items()) {
    std::vector<std::string> texts = Texts(value);
    if (!texts.empty()) token.claims.emplace(name, std::move(texts));
  }
  const auto audience = token.claims.find("aud");
  if (audience == token.claims.end() ||
      std::find(audience->second.begin(), audience->second.end(),
                rules.audience) == audience->second.end()) {
    return Invalid("its audience (\"aud\") is not " + rules.audience);
  }
  token.subject = Text(claims, "sub");
  if (token.subject.empty() || token.subject.size() > kMaxSubjectBytes) {
    return Invalid("its subject (\"sub\") is not a text of 1 to " +
                   std::to_string(kMaxSubjectBytes) + " bytes");
  }
  for (const char* name : {"exp", "nbf", "iat"}) {
    if (claims.contains(name) && !TimeOf(claims, name)) {
      return Invalid(std::string("its \"") + name +
                     "\" is not a number of seconds since 1970");
    }
  }
  const auto expires = TimeOf(claims, "exp");
  if (!expires) return Invalid("it does not say when it expires (\"exp\")");
  token.expires = *expires + rules.leeway;
  if (const auto not_before = TimeOf(claims, "nbf")) {
    token.not_before = *not_before - rules.leeway;
  }
  return token;
}

}  // namespace

absl::StatusOr<Token> VerifyToken(const std::string& text, const JwkSet& keys,
                                  const TokenRules& rules) {
  if (text.size() > kMaxTokenBytes) {
    return Invalid("it has " + std::to_string(text.size()) +
                   " bytes; allowed is " + std::to_string(kMaxTokenBytes));
  }
  const auto parts = Parts(text);
  if (!parts) return Invalid("it is not of the form header.payload.signature");
  const std::optional<Json> header = Object((*parts)[0]);
  if (!header) return Invalid("its header is no JSON object in base64url");
  if (absl::Status status = CheckHeader(*header); !status.ok()) return status;
  const auto signature = DecodeBase64Url((*parts)[2]);
  if (!signature) return Invalid("its signature is no base64url");
  switch (keys.Verify(Text(*header, "kid"), Text(*header, "alg"),
                      (*parts)[0] + "." + (*parts)[1], *signature)) {
    case JwkSet::Result::kGood:
      break;
    case JwkSet::Result::kUnknownKey:
      return Invalid("the server does not have the key that it names");
    case JwkSet::Result::kWrongAlgorithm:
      return Invalid("the key that it names is for another algorithm");
    case JwkSet::Result::kBadSignature:
      return Invalid("its signature does not hold");
  }
  const std::optional<Json> claims = Object((*parts)[1]);
  if (!claims) return Invalid("its payload is no JSON object in base64url");
  return ReadClaims(*claims, rules);
}

absl::Status CheckTokenTime(const Token& token, Token::Time now) {
  if (now < token.not_before) {
    return Error(absl::StatusCode::kUnauthenticated, "TOKEN_NOT_YET_VALID",
                 "the bearer token's time (\"nbf\") has not come yet");
  }
  if (now >= token.expires) {
    return Error(absl::StatusCode::kUnauthenticated, "TOKEN_EXPIRED",
                 "the bearer token has expired; take a new one");
  }
  return absl::OkStatus();
}

}  // namespace revisit::server
