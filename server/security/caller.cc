#include "server/security/caller.h"

#include <algorithm>
#include <cstddef>

namespace revisit::server {
namespace {

bool StartsWith(const std::string& text, const std::string& prefix) {
  return text.compare(0, prefix.size(), prefix) == 0;
}

}  // namespace

const char* VerbName(Verb verb) {
  switch (verb) {
    case Verb::kRead:
      return "read";
    case Verb::kWrite:
      return "write";
    case Verb::kAdmin:
      return "admin";
  }
  return "";
}

bool MatchesGlob(const std::string& pattern, const std::string& text) {
  std::size_t p = 0;
  std::size_t t = 0;
  // The last star, and how far into the text it reaches.
  std::size_t star = std::string::npos;
  std::size_t reached = 0;
  while (t < text.size()) {
    if (p < pattern.size() && pattern[p] == '*') {
      star = p++;
      reached = t;
    } else if (p < pattern.size() && pattern[p] == text[t]) {
      ++p;
      ++t;
    } else if (star != std::string::npos) {
      p = star + 1;
      t = ++reached;
    } else {
      return false;
    }
  }
  while (p < pattern.size() && pattern[p] == '*') ++p;
  return p == pattern.size();
}

bool Grant::Covers(const std::string& id, Resource resource) const {
  const std::vector<std::string>& patterns = PatternsOf(resource);
  return StartsWith(id, vehicle_prefix) &&
         std::any_of(patterns.begin(), patterns.end(),
                     [&](const std::string& pattern) {
                       return MatchesGlob(pattern, id);
                     });
}

bool Caller::MaySee(const std::string& id, Resource resource) const {
  if (!grants) return true;
  return std::any_of(grants->begin(), grants->end(), [&](const Grant& grant) {
    return grant.Covers(id, resource);
  });
}

bool Caller::May(Verb verb, const std::string& id, Resource resource) const {
  if (!grants) return true;
  return std::any_of(grants->begin(), grants->end(), [&](const Grant& grant) {
    return grant.Allows(verb) && grant.Covers(id, resource);
  });
}

bool Caller::AreOfOneTenant(const std::string& id,
                            const std::string& other) const {
  return tenant_prefixes == nullptr ||
         std::all_of(tenant_prefixes->begin(), tenant_prefixes->end(),
                     [&](const std::string& prefix) {
                       return StartsWith(id, prefix) ==
                              StartsWith(other, prefix);
                     });
}

std::vector<std::string> Caller::PrefixesOf(Verb verb,
                                            Resource resource) const {
  if (!grants) return {""};
  std::vector<std::string> prefixes;
  for (const Grant& grant : *grants) {
    if (!grant.Allows(verb)) continue;
    for (const std::string& pattern : grant.PatternsOf(resource)) {
      const std::string literal = pattern.substr(0, pattern.find('*'));
      if (StartsWith(literal, grant.vehicle_prefix)) {
        prefixes.push_back(literal);
      } else if (StartsWith(grant.vehicle_prefix, literal)) {
        prefixes.push_back(grant.vehicle_prefix);
      }
    }
  }
  std::sort(prefixes.begin(), prefixes.end());
  // In this order, a prefix stands right before what it covers.
  std::vector<std::string> kept;
  for (const std::string& prefix : prefixes) {
    if (kept.empty() || !StartsWith(prefix, kept.back())) {
      kept.push_back(prefix);
    }
  }
  return kept;
}

}  // namespace revisit::server
