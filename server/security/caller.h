// Who calls, and what they may do.
#ifndef REVISIT_SERVER_SECURITY_CALLER_H_
#define REVISIT_SERVER_SECURITY_CALLER_H_

#include <chrono>
#include <cstdint>
#include <memory>
#include <optional>
#include <string>
#include <vector>

namespace revisit::server {

enum class Verb : std::uint8_t { kRead = 1, kWrite = 2, kAdmin = 4 };

// "read", "write", "admin".
const char* VerbName(Verb verb);

// Resources that ids name and callers may see or not. An id of the one says
// nothing of the other.
enum class Resource { kVehicle, kGroup };

// Some vehicles and groups of one tenant, and what may be done with them.
struct Grant {
  // The tenant's prefix: no id without it belongs to this grant.
  std::string vehicle_prefix;
  // Patterns of whole ids, of which an id has to match one. `*` stands for any
  // run of characters, even an empty one.
  std::vector<std::string> vehicle_patterns;
  // Bits of Verb.
  std::uint8_t verbs = 0;
  std::vector<std::string> group_patterns = {};

  bool Allows(Verb verb) const {
    return (verbs & static_cast<std::uint8_t>(verb)) != 0;
  }
  const std::vector<std::string>& PatternsOf(Resource resource) const {
    return resource == Resource::kVehicle ? vehicle_patterns : group_patterns;
  }
  bool Covers(const std::string& id,
              Resource resource = Resource::kVehicle) const;
};

// Immutable once made, so that threads may share it.
struct Caller {
  // For logs and decisions: "token:" or "certificate:" and a name, in UTF-8,
  // and no longer than one of kMaxCertificateNameBytes. Empty if the server
  // does not ask who calls.
  std::string identity;
  // All grants are of this tenant; "*" means all of them. Empty if the server
  // does not ask who calls.
  std::string tenant;
  // The tenant's budget of steps of searches, above 0; nothing if it has none.
  std::optional<double> max_search_steps_per_second;
  // From this time on the credentials are invalid.
  std::chrono::system_clock::time_point expires =
      std::chrono::system_clock::time_point::max();
  // Nullopt grants everything on all vehicles and groups.
  std::optional<std::vector<Grant>> grants;
  // The prefixes of all tenants there are; null if the server does not ask who
  // calls.
  std::shared_ptr<const std::vector<std::string>> tenant_prefixes;

  // Whether the caller may do anything with the vehicle or group. To a caller
  // who may not see one, every answer is as if it did not exist.
  bool MaySee(const std::string& id,
              Resource resource = Resource::kVehicle) const;
  bool May(Verb verb, const std::string& id,
           Resource resource = Resource::kVehicle) const;

  // Whether two ids, of vehicles or groups, belong to the same tenant, or both
  // to none.
  bool AreOfOneTenant(const std::string& id, const std::string& other) const;

  // Prefixes of ids, in order, none a prefix of another. Every id for which the
  // verb is granted starts with one of them.
  std::vector<std::string> PrefixesOf(
      Verb verb, Resource resource = Resource::kVehicle) const;
};

// Whether `text` as a whole matches `pattern`, in time proportional to the
// product of their lengths.
bool MatchesGlob(const std::string& pattern, const std::string& text);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SECURITY_CALLER_H_
