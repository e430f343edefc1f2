// Parses JSON that no two readers can understand differently.
#ifndef REVISIT_SERVER_SECURITY_STRICT_JSON_H_
#define REVISIT_SERVER_SECURITY_STRICT_JSON_H_

#include <nlohmann/json_fwd.hpp>
#include <string>

#include "absl/status/status.h"
#include "absl/strings/str_cat.h"

namespace revisit::server {

// INVALID_ARGUMENT if `text` is not JSON in UTF-8, has a key twice in one
// object, or is nested deeper than 16. The message says where, and repeats
// parts of the text: do not pass it on if the text is a secret.
absl::Status ParseStrictJson(const std::string& text, nlohmann::json* value);

// INVALID_ARGUMENT that says where in a document something is wrong.
inline absl::Status ProblemAt(const std::string& where,
                              const std::string& what) {
  return absl::InvalidArgumentError(absl::StrCat(where, ": ", what));
}

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SECURITY_STRICT_JSON_H_
