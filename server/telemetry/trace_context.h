// The trace that a caller says its call belongs to (W3C Trace Context,
// https://www.w3.org/TR/trace-context/).
#ifndef REVISIT_SERVER_TELEMETRY_TRACE_CONTEXT_H_
#define REVISIT_SERVER_TELEMETRY_TRACE_CONTEXT_H_

#include <string>

#include "absl/strings/string_view.h"

namespace revisit::server {

struct TraceContext {
  // 32 and 16 digits, lower-case hexadecimal, not all zero; both empty if the
  // call belongs to no trace.
  std::string trace_id;
  // The caller's span, the parent of this call.
  std::string parent_id;
};

// Reads a value of the header `traceparent`; empty ids for one that is
// malformed, which the standard has a server ignore.
TraceContext ParseTraceParent(absl::string_view header);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_TELEMETRY_TRACE_CONTEXT_H_
