// Page tokens: where the next page starts, sealed to the list they were issued
// for.
//
// The seal finds mistakes. It is no secret, so that a token is valid at any
// server and after any restart. A token that a caller makes or changes either
// is refused or leads to a page that the caller may have anyway: nothing is
// trusted but that the key in it has the form of a key.
#ifndef REVISIT_SERVER_CONVERSION_PAGE_TOKEN_H_
#define REVISIT_SERVER_CONVERSION_PAGE_TOKEN_H_

#include <cstdint>
#include <optional>
#include <string>
#include <utility>

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
// Tokens of lists whose keys are sequences of poses; an empty token is read as
// 0.
std::string MakePageToken(const std::string& list, std::uint64_t sequence);
absl::StatusOr<std::uint64_t> ParseSequenceToken(const std::string& list,
                                                 const std::string& token);

// The content of a token that was made for this list, whatever its form;
// nothing if it was not made for it.
std::optional<std::string> OpenToken(const std::string& list,
                                     const std::string& token);

// A place in a list of several vehicles' resources.
struct VehiclePlace {
  std::string vehicle_id;
  std::uint64_t sequence = 0;
};
std::string MakePageToken(const std::string& list, const VehiclePlace& place);
// Before all vehicles for an empty token.
absl::StatusOr<VehiclePlace> ParsePlaceToken(const std::string& list,
                                             const std::string& token);

// The page size to use for the one that was asked for: 0 means `usual`, more
// than `most` means `most`. INVALID_ARGUMENT if negative.
absl::StatusOr<int> PageSize(int asked, int usual, int most);

// A page of a list whose keys are ids.
struct AskedPage {
  std::string list;
  // The key behind which it begins; empty for the first page.
  std::string after;
  int size = 0;
};
// The page that a request of the fields `page_size` (100 where it is 0, 1000 at
// most) and `page_token` asks for. Errors: those of PageSize(), then those of
// ParsePageToken().
template <typename Request>
absl::StatusOr<AskedPage> PageOf(std::string list, const Request& request) {
  const absl::StatusOr<int> size = PageSize(request.page_size(), 100, 1000);
  if (!size.ok()) return size.status();
  absl::StatusOr<std::string> after =
      ParsePageToken(list, request.page_token());
  if (!after.ok()) return after.status();
  return AskedPage{std::move(list), *std::move(after), *size};
}

}  // namespace revisit::server

#endif  // REVISIT_SERVER_CONVERSION_PAGE_TOKEN_H_
