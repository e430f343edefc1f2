// Page tokens: where the next page starts, sealed to the list they were issued
// for.
#ifndef REVISIT_SERVER_PAGE_TOKEN_H_
#define REVISIT_SERVER_PAGE_TOKEN_H_

#include <string>

#include "absl/status/statusor.h"

namespace revisit::server {

// `list` names the method and what it lists, such as "ListPoses vehicles/a";
// `key` is the last element of the page. Opaque, but not secret: it says
// nothing that its receiver has not seen.
std::string MakePageToken(const std::string& list, const std::string& key);

// The key; empty for an empty token. INVALID_ARGUMENT (INVALID_PAGE_TOKEN) if
// the token was not made for this list.
absl::StatusOr<std::string> ParsePageToken(const std::string& list,
                                           const std::string& token);

// What a page size that was asked for comes to. INVALID_ARGUMENT if negative.
absl::StatusOr<int> PageSize(int asked, int usual, int most);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_PAGE_TOKEN_H_
