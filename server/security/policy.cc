#include "server/security/policy.h"

#include <algorithm>
#include <cstddef>
#include <initializer_list>
#include <memory>
#include <nlohmann/json.hpp>
#include <optional>
#include <set>
#include <utility>

#include "absl/strings/str_cat.h"
#include "server/base/status.h"
#include "server/security/strict_json.h"

namespace revisit::server {
namespace {

using Json = nlohmann::json;

constexpr char kAllTenants[] = "*";
constexpr char kMatch[] = "{match}";
constexpr std::size_t kMatchBytes = sizeof(kMatch) - 1;
// Longest pattern: no id is longer, so no longer pattern could match one.
constexpr std::size_t kMaxPatternBytes = 200;

bool IsIdCharacter(char c) {
  return (c >= 'a' && c <= 'z') || (c >= '0' && c <= '9') || c == '-';
}

bool IsOfIdCharacters(const std::string& text) {
  return std::all_of(text.begin(), text.end(), IsIdCharacter);
}

absl::Status CheckObject(const Json& value, const std::string& where,
                         std::initializer_list<const char*> keys) {
  if (!value.is_object()) return ProblemAt(where, "not an object");
  for (const auto& [key, member] : value.items()) {
    const bool known = std::find(keys.begin(), keys.end(), key) != keys.end();
    if (!known) return ProblemAt(where, "unknown key \"" + key + "\"");
  }
  return absl::OkStatus();
}

absl::StatusOr<std::string> Text(const Json& object, const char* key,
                                 const std::string& where) {
  const auto found = object.find(key);
  if (found == object.end()) {
    return ProblemAt(where, std::string("\"") + key + "\" is missing");
  }
  if (!found->is_string()) return ProblemAt(where + "." + key, "not a text");
  return found->get<std::string>();
}

// The texts of an array, each with its place for messages.
absl::StatusOr<std::vector<std::pair<std::string, std::string>>> Texts(
    const Json& object, const char* key, const std::string& where,
    bool may_be_empty = false) {
  const std::string path = where + "." + key;
  const auto found = object.find(key);
  if (found == object.end()) {
    return ProblemAt(where, std::string("\"") + key + "\" is missing");
  }
  if (!found->is_array() || (found->empty() && !may_be_empty)) {
    return ProblemAt(path, may_be_empty ? "not an array of texts"
                                        : "not an array of one text or more");
  }
  std::vector<std::pair<std::string, std::string>> texts;
  for (const Json& element : *found) {
    const std::string at = absl::StrCat(path, "[", texts.size(), "]");
    if (!element.is_string()) return ProblemAt(at, "not a text");
    texts.emplace_back(element.get<std::string>(), at);
  }
  return texts;
}

// A budget of more is none.
constexpr double kMostSearchSteps = 1e15;

struct Tenant {
  std::string vehicle_prefix;
  std::optional<double> max_search_steps_per_second;
};

// Tenants by their names.
using Tenants = std::map<std::string, Tenant>;

absl::StatusOr<std::optional<double>> ReadSearchSteps(
    const Json& tenant, const std::string& where) {
  constexpr char kKey[] = "max_search_steps_per_second";
  const auto found = tenant.find(kKey);
  if (found == tenant.end()) return std::optional<double>();
  const double steps = found->is_number() ? found->get<double>() : 0.0;
  if (!(steps >= 1.0 && steps <= kMostSearchSteps)) {
    return ProblemAt(where + "." + kKey, "got " + found->dump() +
                                             "; allowed is a number in "
                                             "[1, 1e15]");
  }
  return std::optional<double>(steps);
}

absl::StatusOr<Tenants> ReadTenants(const Json& list) {
  if (!list.is_array()) return ProblemAt("tenants", "not an array");
  Tenants tenants;
  for (std::size_t i = 0; i < list.size(); ++i) {
    const std::string where = absl::StrCat("tenants[", i, "]");
    if (absl::Status status = CheckObject(
            list[i], where,
            {"name", "vehicle_prefix", "max_search_steps_per_second"});
        !status.ok()) {
      return status;
    }
    const auto name = Text(list[i], "name", where);
    if (!name.ok()) return name.status();
    const auto prefix = Text(list[i], "vehicle_prefix", where);
    if (!prefix.ok()) return prefix.status();
    if (name->empty() || name->size() > 63 || !IsOfIdCharacters(*name)) {
      return ProblemAt(where + ".name",
                       "got \"" + *name +
                           "\"; allowed are 1 to 63 lower-case letters, digits "
                           "and hyphens");
    }
    if (prefix->size() > 62 || !IsOfIdCharacters(*prefix) ||
        prefix->rfind('-', 0) == 0) {
      return ProblemAt(where + ".vehicle_prefix",
                       "got \"" + *prefix + "\", which no id starts with");
    }
    auto search_steps = ReadSearchSteps(list[i], where);
    if (!search_steps.ok()) return search_steps.status();
    for (const auto& [other, known] : tenants) {
      const std::string& other_prefix = known.vehicle_prefix;
      const std::size_t common = std::min(prefix->size(), other_prefix.size());
      if (prefix->compare(0, common, other_prefix, 0, common) == 0) {
        return ProblemAt(where + ".vehicle_prefix",
                         "got \"" + *prefix + "\", and that of " + other +
                             " is \"" + other_prefix +
                             "\": vehicles would belong to both");
      }
    }
    if (!tenants.emplace(*name, Tenant{*prefix, *search_steps}).second) {
      return ProblemAt(where + ".name", "\"" + *name + "\" stands twice");
    }
  }
  return tenants;
}

absl::StatusOr<std::uint8_t> ReadVerbs(const Json& object,
                                       const std::string& where) {
  const auto texts = Texts(object, "verbs", where);
  if (!texts.ok()) return texts.status();
  std::uint8_t verbs = 0;
  for (const auto& [text, at] : *texts) {
    std::uint8_t bit = 0;
    for (const Verb verb : {Verb::kRead, Verb::kWrite, Verb::kAdmin}) {
      if (text == VerbName(verb)) bit = static_cast<std::uint8_t>(verb);
    }
    if (bit == 0) {
      return ProblemAt(
          at, "got \"" + text + "\"; allowed is read, write and admin");
    }
    verbs = static_cast<std::uint8_t>(verbs | bit);
  }
  return verbs;
}

absl::StatusOr<std::vector<std::string>> ReadPatterns(
    const Json& object, const char* key, bool may_be_empty, bool has_match,
    const std::string& where) {
  const auto texts = Texts(object, key, where, may_be_empty);
  if (!texts.ok()) return texts.status();
  std::vector<std::string> patterns;
  for (const auto& [text, at] : *texts) {
    std::string rest = text;
    const std::size_t match = rest.find(kMatch);
    if (match != std::string::npos) {
      if (!has_match) {
        return ProblemAt(at,
                         "{match} stands for nothing: who the grant is for "
                         "is named without a `*`");
      }
      rest.erase(match, kMatchBytes);
    }
    rest.erase(std::remove(rest.begin(), rest.end(), '*'), rest.end());
    if (text.empty() || text.size() > kMaxPatternBytes ||
        !IsOfIdCharacters(rest)) {
      return ProblemAt(at, "got \"" + text +
                               "\"; a pattern is made of lower-case letters, "
                               "digits, hyphens, `*` and at most one {match}");
    }
    patterns.push_back(text);
  }
  return patterns;
}

// The text that the `*` of the pattern matched, empty if the pattern has none;
// nullopt if the name does not match.
std::optional<std::string> MatchName(const std::string& pattern,
                                     const std::string& name) {
  const std::size_t star = pattern.find('*');
  if (star == std::string::npos) {
    return name == pattern ? std::optional<std::string>("") : std::nullopt;
  }
  const std::size_t after = pattern.size() - star - 1;
  if (name.size() < pattern.size() || name.compare(0, star, pattern, 0, star) ||
      name.compare(name.size() - after, after, pattern, star + 1, after)) {
    return std::nullopt;
  }
  std::string matched = name.substr(star, name.size() - star - after);
  if (matched.find('/') != std::string::npos) return std::nullopt;
  return matched;
}

// The patterns with {match} replaced. Patterns that would get characters which
// no id has are left out.
std::vector<std::string> Filled(const std::vector<std::string>& patterns,
                                const std::string& matched) {
  std::vector<std::string> filled;
  for (std::string pattern : patterns) {
    const std::size_t at = pattern.find(kMatch);
    if (at != std::string::npos) {
      // This also keeps callers from bringing a `*` of their own.
      if (!IsOfIdCharacters(matched)) continue;
      pattern.replace(at, kMatchBytes, matched);
    }
    filled.push_back(std::move(pattern));
  }
  return filled;
}

absl::Status NotGranted(const std::string& what) {
  return Error(absl::StatusCode::kPermissionDenied, "NOT_GRANTED", what);
}

}  // namespace

// Reads the grants of a policy. `where` is their place in the file.
class Policy::Reader {
 public:
  static absl::StatusOr<Rule> ReadGrant(const Json& entry,
                                        const std::string& where,
                                        const Tenants& tenants) {
    if (absl::Status status = CheckObject(
            entry, where,
            {"token_subject", "token_claim", "certificate_uri",
             "certificate_dns", "tenant", "vehicles", "groups", "verbs"});
        !status.ok()) {
      return status;
    }
    Rule rule;
    if (absl::Status status = ReadNames(entry, where, &rule); !status.ok()) {
      return status;
    }
    const auto tenant = Text(entry, "tenant", where);
    if (!tenant.ok()) return tenant.status();
    rule.tenant = *tenant;
    if (*tenant != kAllTenants) {
      const auto found = tenants.find(*tenant);
      if (found == tenants.end()) {
        return ProblemAt(
            absl::StrCat(where, ".tenant"),
            absl::StrCat("got \"", *tenant, "\", which is not among tenants"));
      }
      rule.grant.vehicle_prefix = found->second.vehicle_prefix;
      rule.max_search_steps_per_second =
          found->second.max_search_steps_per_second;
    }
    const bool has_match = rule.name_pattern.find('*') != std::string::npos;
    auto patterns = ReadPatterns(entry, "vehicles", false, has_match, where);
    if (!patterns.ok()) return patterns.status();
    rule.grant.vehicle_patterns = *std::move(patterns);
    rule.grant.group_patterns = rule.grant.vehicle_patterns;
    if (entry.contains("groups")) {
      auto groups = ReadPatterns(entry, "groups", true, has_match, where);
      if (!groups.ok()) return groups.status();
      rule.grant.group_patterns = *std::move(groups);
    }
    const auto verbs = ReadVerbs(entry, where);
    if (!verbs.ok()) return verbs.status();
    rule.grant.verbs = *verbs;
    return rule;
  }

 private:
  // Reads who the grant is for.
  static absl::Status ReadNames(const Json& entry, const std::string& where,
                                Rule* rule) {
    constexpr std::pair<const char*, Who> kNames[] = {
        {"token_subject", Who::kTokenSubject},
        {"token_claim", Who::kTokenClaim},
        {"certificate_uri", Who::kCertificateUri},
        {"certificate_dns", Who::kCertificateDns}};
    int named = 0;
    for (const auto& [key, who] : kNames) {
      if (!entry.contains(key)) continue;
      ++named;
      rule->who = who;
      const absl::Status status =
          who == Who::kTokenClaim
              ? ReadClaim(entry[key], absl::StrCat(where, ".", key), rule)
              : ReadNamePattern(entry, key, where, rule);
      if (!status.ok()) return status;
    }
    if (named == 1) return absl::OkStatus();
    return ProblemAt(where,
                     absl::StrCat("names who it is for ", named,
                                  " times; exactly one of token_subject, "
                                  "token_claim, certificate_uri and "
                                  "certificate_dns is needed"));
  }

  static absl::Status ReadClaim(const Json& claim, const std::string& where,
                                Rule* rule) {
    if (absl::Status status = CheckObject(claim, where, {"name", "value"});
        !status.ok()) {
      return status;
    }
    const auto name = Text(claim, "name", where);
    if (!name.ok()) return name.status();
    rule->claim = *name;
    return ReadNamePattern(claim, "value", where, rule);
  }

  static absl::Status ReadNamePattern(const Json& object, const char* key,
                                      const std::string& where, Rule* rule) {
    const auto pattern = Text(object, key, where);
    if (!pattern.ok()) return pattern.status();
    if (pattern->empty() ||
        std::count(pattern->begin(), pattern->end(), '*') > 1) {
      return ProblemAt(
          absl::StrCat(where, ".", key),
          absl::StrCat("got \"", *pattern,
                       "\"; allowed is a text with at most one `*`"));
    }
    rule->name_pattern = *pattern;
    return absl::OkStatus();
  }
};

absl::StatusOr<Policy> Policy::Parse(const std::string& text) {
  Json root;
  if (absl::Status status = ParseStrictJson(text, &root); !status.ok()) {
    return status;
  }
  if (absl::Status status =
          CheckObject(root, "policy", {"version", "tenants", "grants"});
      !status.ok()) {
    return status;
  }
  for (const char* key : {"version", "tenants", "grants"}) {
    if (!root.contains(key)) {
      return ProblemAt("policy", std::string("\"") + key + "\" is missing");
    }
  }
  if (root["version"] != 1) {
    return ProblemAt("version", "got " + root["version"].dump() +
                                    "; this server knows version 1");
  }
  const auto tenants = ReadTenants(root["tenants"]);
  if (!tenants.ok()) return tenants.status();
  const Json& list = root["grants"];
  if (!list.is_array()) return ProblemAt("grants", "not an array");

  Policy policy;
  auto prefixes = std::make_shared<std::vector<std::string>>();
  for (const auto& [name, tenant] : *tenants) {
    prefixes->push_back(tenant.vehicle_prefix);
  }
  policy.tenant_prefixes_ = std::move(prefixes);
  for (std::size_t i = 0; i < list.size(); ++i) {
    absl::StatusOr<Rule> rule =
        Reader::ReadGrant(list[i], absl::StrCat("grants[", i, "]"), *tenants);
    if (!rule.ok()) return rule.status();
    policy.rules_.push_back(*std::move(rule));
  }
  return policy;
}

std::vector<std::string> Policy::NamesFor(const Rule& rule,
                                          const Identity& identity) {
  switch (rule.who) {
    case Who::kTokenSubject:
      if (identity.token_subject.empty()) return {};
      return {identity.token_subject};
    case Who::kTokenClaim: {
      const auto claim = identity.token_claims.find(rule.claim);
      if (claim == identity.token_claims.end()) return {};
      return claim->second;
    }
    case Who::kCertificateUri:
      return identity.certificate_uris;
    case Who::kCertificateDns:
      return identity.certificate_dns_names;
  }
  return {};
}

absl::Status Policy::Apply(const Identity& identity, Caller* caller) const {
  std::set<std::string> tenants;
  std::vector<Grant> grants;
  std::optional<double> steps;
  for (const Rule& rule : rules_) {
    for (const std::string& name : NamesFor(rule, identity)) {
      const auto matched = MatchName(rule.name_pattern, name);
      if (!matched) continue;
      Grant grant = rule.grant;
      grant.vehicle_patterns = Filled(rule.grant.vehicle_patterns, *matched);
      grant.group_patterns = Filled(rule.grant.group_patterns, *matched);
      if (grant.vehicle_patterns.empty() && grant.group_patterns.empty()) {
        continue;
      }
      tenants.insert(rule.tenant);
      steps = rule.max_search_steps_per_second;
      grants.push_back(std::move(grant));
    }
  }
  if (grants.empty()) {
    return NotGranted("the server's policy grants the caller nothing");
  }
  if (tenants.size() > 1) {
    return NotGranted(
        "the server's policy has grants of more than one tenant for the "
        "caller; which one is meant cannot be told");
  }
  caller->tenant = *tenants.begin();
  caller->max_search_steps_per_second = steps;
  caller->grants = std::move(grants);
  caller->tenant_prefixes = tenant_prefixes_;
  return absl::OkStatus();
}

}  // namespace revisit::server
