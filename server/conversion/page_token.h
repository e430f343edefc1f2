// Page tokens: where the next page starts, sealed to the list they were issued
// for.
//
// The seal tells mistakes. It is no secret, so that a token is good at any
// server and after any restart; one that a caller makes, or changes, is worth
// no more than a page that the caller may have anyway, or is refused: nothing
// is believed of it but that it has the form of a key.
#ifndef REVISIT_SERVER_CONVERSION_PAGE_TOKEN_H_
#define REVISIT_SERVER_CONVERSION_PAGE_TOKEN_H_

#include <cstdint>
#include <string>

#include "absl/status/statusor.h"

namespace revisit::server {

// `list` names the method and what it lists, such as "ListPoses vehicles/a";
// `key` is the last element of the page. Opaque, but not secret: it says
// nothing that its receiver has not seen.
std::string MakePageToken(const std::string& list, const std::string& key);

// The key, which must be an id; empty for an empty token. INVALID_ARGUMENT
// (INVALID_PAGE_TOKEN) if the token was not made for this list.
absl::StatusOr<std::string> ParsePageToken(const std::string& list,
                                           const std::string& token);
// The same where keys are sequences of poses; 0 for an empty token.
std::string MakePageToken(const std::string& list, std::uint64_t sequence);
absl::StatusOr<std::uint64_t> ParseSequenceToken(const std::string& list,
                                                 const std::string& token);

// What a page size that was asked for comes to. INVALID_ARGUMENT if negative.
absl::StatusOr<int> PageSize(int asked, int usual, int most);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_CONVERSION_PAGE_TOKEN_H_
