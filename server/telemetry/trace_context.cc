#include "server/telemetry/trace_context.h"

#include <algorithm>
#include <cstddef>

namespace revisit::server {
namespace {

// VERSION-TRACE-PARENT-FLAGS
constexpr std::size_t kTraceAt = 3;
constexpr std::size_t kTraceDigits = 32;
constexpr std::size_t kParentAt = kTraceAt + kTraceDigits + 1;
constexpr std::size_t kParentDigits = 16;
constexpr std::size_t kFlagsAt = kParentAt + kParentDigits + 1;
constexpr std::size_t kSize = kFlagsAt + 2;

bool IsHexadecimal(absl::string_view text) {
  return std::all_of(text.begin(), text.end(), [](char c) {
    return (c >= '0' && c <= '9') || (c >= 'a' && c <= 'f');
  });
}

bool IsId(absl::string_view text) {
  return IsHexadecimal(text) &&
         text.find_first_not_of('0') != absl::string_view::npos;
}

}  // namespace

TraceContext ParseTraceParent(absl::string_view header) {
  if (header.size() < kSize || header[kTraceAt - 1] != '-' ||
      header[kParentAt - 1] != '-' || header[kFlagsAt - 1] != '-') {
    return {};
  }
  const absl::string_view version = header.substr(0, 2);
  if (!IsHexadecimal(version) || version == "ff" ||
      !IsHexadecimal(header.substr(kFlagsAt, 2))) {
    return {};
  }
  // Later versions may add fields behind these.
  if (header.size() > kSize && (version == "00" || header[kSize] != '-')) {
    return {};
  }
  const absl::string_view trace = header.substr(kTraceAt, kTraceDigits);
  const absl::string_view parent = header.substr(kParentAt, kParentDigits);
  if (!IsId(trace) || !IsId(parent)) return {};
  return {std::string(trace), std::string(parent)};
}

}  // namespace revisit::server
