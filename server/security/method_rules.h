// The verb that each method of the service requires of its caller.
#ifndef REVISIT_SERVER_SECURITY_METHOD_RULES_H_
#define REVISIT_SERVER_SECURITY_METHOD_RULES_H_

#include <optional>
#include <string>

#include "absl/types/span.h"
#include "server/security/caller.h"

namespace revisit::server {

struct MethodRule {
  const char* method;
  // Nullopt if every known caller may call it. Such a method takes no room
  // among the calls at a time, so that an operator gets an answer from a server
  // that is full.
  std::optional<Verb> verb;
  // Whether the method names a vehicle or a group that does not exist yet, so
  // that "not found" would make no sense.
  bool creates = false;
  // Whether the call lasts, and so counts as a stream, not as a unary call.
  bool streams = false;
};

// The rule of a method; null for a method without one. Such a method requires
// kAdmin, counts as a call that neither streams nor creates, and takes no room:
// no limit of calls at a time holds for it. So every method of the service
// needs a rule (method_rules_test.cc compares the two lists).
const MethodRule* FindMethodRule(const std::string& method);

// Whether the calls of a method are about what is stored, rather than about the
// server itself. `rule` as FindMethodRule() finds it.
inline bool NeedsStore(const MethodRule* rule) {
  return rule != nullptr && rule->verb.has_value();
}

// All rules, among which FindMethodRule() finds.
absl::Span<const MethodRule> MethodRules();

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SECURITY_METHOD_RULES_H_
