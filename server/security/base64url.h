// Base64url as JSON Web Signatures write it.
#ifndef REVISIT_SERVER_SECURITY_BASE64URL_H_
#define REVISIT_SERVER_SECURITY_BASE64URL_H_

#include <optional>
#include <string>

namespace revisit::server {

// The decoded bytes; nullopt unless `text` is the one canonical way to write
// them: the alphabet of RFC 4648 section 5, no padding, no other character,
// unused bits zero.
std::optional<std::string> DecodeBase64Url(const std::string& text);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SECURITY_BASE64URL_H_
