// Who may do what with which vehicles and groups: a file of JSON.
//
//   {
//     "version": 1,
//     "tenants": [
//       {"name": "acme", "vehicle_prefix": "acme-"},
//       {"name": "umbra", "vehicle_prefix": "umbra-",
//        "max_search_steps_per_second": 50000000}
//     ],
//     "grants": [
//       {"token_subject": "acme-backend", "tenant": "acme",
//        "vehicles": ["*"], "verbs": ["read", "write", "admin"]},
//       {"certificate_uri": "spiffe://fleet.example/acme/*", "tenant": "acme",
//        "vehicles": ["acme-{match}"], "verbs": ["read", "write"]}
//     ]
//   }
//
// A vehicle belongs to the tenant whose prefix its id starts with, and so does
// a group. No prefix may be the start of another, so none can belong to two.
//
// A tenant may have a budget of what the searches of its FindCandidates calls
// compare, in steps as --max-search-steps counts them; [1, 1e15] a second. It
// counts on this server alone.
//
// A grant names who it is for by exactly one of
//   token_subject      the token's `sub`
//   token_claim        {"name": ..., "value": ...}: a claim that is this text,
//                      or an array with it
//   certificate_uri    a URI among the certificate's alternative names
//   certificate_dns    a DNS name among them
// Each of these texts may hold one `*`, for one or more characters other than
// `/`. Then it lists vehicles by patterns over the whole id, in which any
// number of `*` stand for any characters, and `{match}` for the text that the
// `*` above matched (nothing is granted unless that is made of lower-case
// letters, digits and hyphens); it may list "groups" by patterns of the same
// form over the ids of groups, where otherwise those of vehicles hold for
// groups too, and an empty list grants none; and it has the verbs that are
// granted: "read", "write", "admin", none of which includes another. Patterns
// never reach beyond the tenant's prefix. The tenant "*" has all vehicles and
// groups; it is for those who run the fleet.
//
// All grants that fit count together. They have to belong to one tenant: an
// identity with grants of two tenants is refused, rather than guessed at.
//
// A new limit of a tenant is a field of a rule here, read and applied in
// policy.cc, handed on in Caller (caller.h) and by service/call.cc, and kept by
// connections/admission.cc.
#ifndef REVISIT_SERVER_SECURITY_POLICY_H_
#define REVISIT_SERVER_SECURITY_POLICY_H_

#include <map>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/security/caller.h"

namespace revisit::server {

// The verified names of a caller.
struct Identity {
  std::string token_subject;
  std::map<std::string, std::vector<std::string>> token_claims;
  std::vector<std::string> certificate_uris;
  std::vector<std::string> certificate_dns_names;
};

// Immutable.
class Policy {
 public:
  // INVALID_ARGUMENT if any part of the text is not as described above, also
  // for unknown and repeated keys. The message names the line, if the text is
  // no JSON, or the field.
  static absl::StatusOr<Policy> Parse(const std::string& text);

  // Sets tenant and grants of the caller. PERMISSION_DENIED (NOT_GRANTED) if
  // the identity has no grants, or those of more than one tenant.
  absl::Status Apply(const Identity& identity, Caller* caller) const;

 private:
  enum class Who {
    kTokenSubject,
    kTokenClaim,
    kCertificateUri,
    kCertificateDns
  };
  struct Rule {
    Who who;
    std::string claim;  // Name of the claim, for kTokenClaim.
    std::string name_pattern;
    std::string tenant;
    // The tenant's budget; see Caller.
    std::optional<double> max_search_steps_per_second;
    // The grant as the file has it, with {match} not yet replaced.
    Grant grant;
  };
  class Reader;

  // The names of the identity with which the rule compares its pattern.
  static std::vector<std::string> NamesFor(const Rule& rule,
                                           const Identity& identity);

  std::vector<Rule> rules_;
  // See Caller.
  std::shared_ptr<const std::vector<std::string>> tenant_prefixes_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SECURITY_POLICY_H_
