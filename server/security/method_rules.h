// What each call of the service takes of its caller.
#ifndef REVISIT_SERVER_SECURITY_METHOD_RULES_H_
#define REVISIT_SERVER_SECURITY_METHOD_RULES_H_

#include <optional>
#include <string>

#include "server/security/caller.h"

namespace revisit::server {

struct MethodRule {
  const char* method;
  // Nothing: whoever is let in at all.
  std::optional<Verb> verb;
  // Names a vehicle that is not there yet: "not found" would say nothing.
  bool creates = false;
  // Lasts: counts as a stream, not as a unary call.
  bool streams = false;
};

// Null for a method that nobody has thought of: it takes kAdmin.
const MethodRule* FindMethodRule(const std::string& method);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SECURITY_METHOD_RULES_H_
