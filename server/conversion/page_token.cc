#include "server/conversion/page_token.h"

#include <xxhash.h>

#include <algorithm>
#include <cstdint>
#include <optional>

#include "absl/strings/escaping.h"
#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/string_view.h"
#include "server/base/sequences.h"
#include "server/conversion/names.h"
#include "server/fields/field_violations.h"

namespace revisit::server {
namespace {

constexpr char kVersion = '1';
constexpr std::size_t kSealBytes = 8;

// Makes a token for another list, or a mistyped one, differ from a valid one.
std::string Seal(const std::string& list, const std::string& key) {
  const std::string sealed = list + '\n' + key;
  std::uint64_t hash = XXH3_64bits(sealed.data(), sealed.size());
  std::string bytes(kSealBytes, '\0');
  for (char& byte : bytes) {
    byte = static_cast<char>(hash & 0xFF);
    hash >>= 8;
  }
  return bytes;
}

absl::Status NotIssued() {
  return InvalidField(
      "INVALID_PAGE_TOKEN", FieldPath().Field("page_token"),
      "it was not issued for this list; take the "
      "`next_page_token` of the page before, or leave it empty");
}

}  // namespace

std::optional<std::string> OpenToken(const std::string& list,
                                     const std::string& token) {
  std::string plain;
  if (absl::WebSafeBase64Unescape(absl::string_view(token.data(), token.size()),
                                  &plain) &&
      plain.size() > 1 + kSealBytes && plain[0] == kVersion) {
    std::string key = plain.substr(1 + kSealBytes);
    if (plain.compare(1, kSealBytes, Seal(list, key)) == 0) return key;
  }
  return std::nullopt;
}

std::string MakePageToken(const std::string& list, const std::string& key) {
  const std::string plain = kVersion + Seal(list, key) + key;
  std::string token;
  absl::WebSafeBase64Escape(absl::string_view(plain.data(), plain.size()),
                            &token);
  return token;
}

std::string MakePageToken(const std::string& list, std::uint64_t sequence) {
  return MakePageToken(list, absl::StrCat(sequence));
}

absl::StatusOr<std::string> ParsePageToken(const std::string& list,
                                           const std::string& token) {
  if (token.empty()) return std::string();
  const std::optional<std::string> key = OpenToken(list, token);
  if (!key || !CheckId(*key, FieldPath()).ok()) return NotIssued();
  return *key;
}

absl::StatusOr<std::uint64_t> ParseSequenceToken(const std::string& list,
                                                 const std::string& token) {
  if (token.empty()) return std::uint64_t{0};
  const std::optional<std::string> key = OpenToken(list, token);
  std::uint64_t sequence = 0;
  if (!key || !absl::SimpleAtoi(absl::string_view(key->data(), key->size()),
                                &sequence)) {
    return NotIssued();
  }
  // A number that is written in another way was not issued either.
  if (sequence < 1 || sequence > kMaxSequence ||
      absl::StrCat(sequence) != *key) {
    return NotIssued();
  }
  return sequence;
}

std::string MakePageToken(const std::string& list, const VehiclePlace& place) {
  return MakePageToken(list,
                       absl::StrCat(place.vehicle_id, "/", place.sequence));
}

absl::StatusOr<VehiclePlace> ParsePlaceToken(const std::string& list,
                                             const std::string& token) {
  if (token.empty()) return VehiclePlace();
  const std::optional<std::string> key = OpenToken(list, token);
  if (!key) return NotIssued();
  const std::size_t slash = key->find('/');
  VehiclePlace place;
  place.vehicle_id = key->substr(0, slash);
  if (slash == std::string::npos ||
      !CheckId(place.vehicle_id, FieldPath()).ok() ||
      !absl::SimpleAtoi(
          absl::string_view(key->data() + slash + 1, key->size() - slash - 1),
          &place.sequence)) {
    return NotIssued();
  }
  return place;
}

absl::StatusOr<int> PageSize(int asked, int usual, int most) {
  if (asked < 0) {
    return InvalidField(
        kInvalidField, FieldPath().Field("page_size"),
        absl::StrCat("got ", asked, "; allowed is 0, which means ", usual,
                     ", or more"));
  }
  return asked == 0 ? usual : std::min(asked, most);
}

}  // namespace revisit::server
