#include "client/revisit/printable_text.h"

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <iterator>

namespace revisit::client {
namespace {

struct Range {
  std::uint32_t first;
  std::uint32_t last;
};

// Characters that are escaped, in order.
constexpr Range kEscaped[] = {
    {0x0000, 0x001F},   {0x007F, 0x009F},   {0x00AD, 0x00AD},  {0x034F, 0x034F},
    {0x061C, 0x061C},   {0x115F, 0x1160},   {0x17B4, 0x17B5},  {0x180B, 0x180F},
    {0x200B, 0x200F},   {0x2028, 0x202E},   {0x2060, 0x206F},  {0x3164, 0x3164},
    {0xFE00, 0xFE0F},   {0xFEFF, 0xFEFF},   {0xFFA0, 0xFFA0},  {0xFFF0, 0xFFFB},
    {0x1BCA0, 0x1BCA3}, {0x1D173, 0x1D17A}, {0xE0000, 0xE0FFF}};

bool IsEscaped(std::uint32_t code_point) {
  const Range* const range = std::lower_bound(
      std::begin(kEscaped), std::end(kEscaped), code_point,
      [](const Range& r, std::uint32_t c) { return r.last < c; });
  return range != std::end(kEscaped) && range->first <= code_point;
}

struct Decoded {
  std::uint32_t code_point;
  // 0 if no character of UTF-8 begins here.
  std::size_t bytes;
};

// Decodes the character that begins at `at`. Forms that are longer than needed,
// surrogates and numbers beyond Unicode are no characters: some terminals take
// them for what they would stand for.
Decoded Decode(const std::string& text, std::size_t at) {
  const auto byte = [&text](std::size_t i) -> std::uint32_t {
    return i < text.size() ? static_cast<unsigned char>(text[i]) : 0;
  };
  const std::uint32_t head = byte(at);
  if (head < 0x80) return {head, 1};
  const std::size_t bytes = head >= 0xF0   ? 4
                            : head >= 0xE0 ? 3
                            : head >= 0xC0 ? 2
                                           : 0;
  if (bytes == 0 || head >= 0xF8) return {head, 0};
  std::uint32_t code_point = head & (0x7Fu >> bytes);
  for (std::size_t i = 1; i < bytes; ++i) {
    if ((byte(at + i) & 0xC0u) != 0x80u) return {head, 0};
    code_point = code_point << 6 | (byte(at + i) & 0x3Fu);
  }
  constexpr std::uint32_t kLeast[] = {0, 0, 0x80, 0x800, 0x10000};
  const bool is_surrogate = code_point >= 0xD800 && code_point <= 0xDFFF;
  if (code_point < kLeast[bytes] || code_point > 0x10FFFF || is_surrogate) {
    return {head, 0};
  }
  return {code_point, bytes};
}

std::string Formatted(const char* format, std::uint32_t number) {
  char text[16];
  std::snprintf(text, sizeof(text), format, static_cast<unsigned>(number));
  return text;
}

std::string Shown(const std::string& text, bool many_lines) {
  std::string printable;
  printable.reserve(text.size());
  for (std::size_t i = 0; i < text.size();) {
    const Decoded decoded = Decode(text, i);
    if (decoded.bytes == 0) {
      printable += Formatted("<%02X>", decoded.code_point);
      ++i;
      continue;
    }
    const bool is_break = text[i] == '\n' || text[i] == '\t';
    if (IsEscaped(decoded.code_point) && !(many_lines && is_break)) {
      printable += Formatted("<U+%04X>", decoded.code_point);
    } else {
      printable.append(text, i, decoded.bytes);
    }
    i += decoded.bytes;
  }
  return printable;
}

}  // namespace

std::string Printable(const std::string& text) { return Shown(text, false); }

std::string PrintableLines(const std::string& text) {
  return Shown(text, true);
}

std::string PrintableJson(const std::string& json) {
  std::string printable;
  printable.reserve(json.size());
  for (std::size_t i = 0; i < json.size();) {
    const Decoded decoded = Decode(json, i);
    const std::size_t bytes = std::max<std::size_t>(decoded.bytes, 1);
    const std::uint32_t code_point = decoded.code_point;
    if (json[i] == '\n' || !IsEscaped(code_point)) {
      printable.append(json, i, bytes);
    } else if (code_point < 0x10000) {
      printable += Formatted("\\u%04x", code_point);
    } else {
      printable +=
          Formatted("\\u%04x", 0xD800 + ((code_point - 0x10000) >> 10));
      printable += Formatted("\\u%04x", 0xDC00 + (code_point & 0x3FF));
    }
    i += bytes;
  }
  return printable;
}

}  // namespace revisit::client
