// The verb that each method of the service requires of its caller.
#ifndef REVISIT_SERVER_SECURITY_METHOD_RULES_H_
#define REVISIT_SERVER_SECURITY_METHOD_RULES_H_

#include <optional>
#include <string>

#include "server/security/caller.h"

namespace revisit::server {

struct MethodRule {
  const char* method;
  // Nullopt if every known caller may call it.
  std::optional<Verb> verb;
  // Whether the method names a vehicle that does not exist yet, so that "not
  // found" would make no sense.
  bool creates = false;
  // Whether the call lasts, and so counts as a stream, not as a unary call.
  bool streams = false;
};

// The rule of a method. Null for a method without one, which then requires
// kAdmin.
const MethodRule* FindMethodRule(const std::string& method);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SECURITY_METHOD_RULES_H_
