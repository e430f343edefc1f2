#include "server/sessions/vehicle_uid.h"

#include <sys/random.h>

#include <array>
#include <cstddef>
#include <cstdlib>

#include "xxhash.h"

namespace revisit::server {
namespace {

using Bytes = std::array<unsigned char, 16>;

std::string ToUuid(Bytes bytes, unsigned version) {
  bytes[6] = static_cast<unsigned char>((bytes[6] & 0x0fU) | version << 4U);
  bytes[8] = static_cast<unsigned char>((bytes[8] & 0x3fU) | 0x80U);
  constexpr char kDigits[] = "0123456789abcdef";
  std::string text;
  for (std::size_t i = 0; i < bytes.size(); ++i) {
    if (i == 4 || i == 6 || i == 8 || i == 10) text += '-';
    text += kDigits[bytes[i] >> 4U];
    text += kDigits[bytes[i] & 0x0fU];
  }
  return text;
}

}  // namespace

std::string NewUuid() {
  Bytes bytes;
  // Reading so few bytes cannot fail once the system has its entropy, and the
  // call blocks until then.
  if (getentropy(bytes.data(), bytes.size()) != 0) std::abort();
  return ToUuid(bytes, 4);
}

std::string DerivedVehicleUid(VehicleKey key, const std::string& id,
                              std::int64_t create_time_ns) {
  const std::string text =
      std::to_string(key) + " " + id + " " + std::to_string(create_time_ns);
  XXH128_canonical_t hash;
  XXH128_canonicalFromHash(&hash, XXH3_128bits(text.data(), text.size()));
  Bytes bytes;
  for (std::size_t i = 0; i < bytes.size(); ++i) bytes[i] = hash.digest[i];
  return ToUuid(bytes, 8);
}

bool IsUuid(const std::string& text) {
  if (text.size() != 36) return false;
  for (std::size_t i = 0; i < text.size(); ++i) {
    const bool hyphen = i == 8 || i == 13 || i == 18 || i == 23;
    const char c = text[i];
    const bool digit = (c >= '0' && c <= '9') || (c >= 'a' && c <= 'f');
    if (hyphen ? c != '-' : !digit) return false;
  }
  return true;
}

}  // namespace revisit::server
