#include "server/conversion/names.h"

#include <algorithm>
#include <limits>

#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "server/sessions/vehicle_uid.h"

namespace revisit::server {
namespace {

constexpr char kInvalidName[] = "INVALID_RESOURCE_NAME";
constexpr char kVehicles[] = "vehicles/";
constexpr char kGroups[] = "groups/";
constexpr char kMembers[] = "/members/";
constexpr char kChecks[] = "/checks/";
constexpr char kCandidates[] = "/candidates/";

// Reads a number from 1 on that is written as it would be here.
bool ReadNumber(const std::string& text, std::uint64_t* number) {
  return absl::SimpleAtoi(absl::string_view(text.data(), text.size()),
                          number) &&
         *number >= 1 && absl::StrCat(*number) == text;
}

std::string CollectionOf(PairKind kind) {
  return absl::StrCat("/", WordsOf(kind).collection, "/");
}

// The id in a name that is `collection` and an id; `form` is that of the name.
absl::StatusOr<std::string> ParseTopName(const std::string& collection,
                                         const char* form,
                                         const std::string& name,
                                         const FieldPath& path) {
  if (name.compare(0, collection.size(), collection) != 0) {
    return InvalidField(
        kInvalidName, path,
        absl::StrCat("got ", Quoted(name), "; the form is ", form));
  }
  const std::string id = name.substr(collection.size());
  if (absl::Status status = CheckId(id, path); !status.ok()) return status;
  return id;
}

// The ids in a name of a group, `collection` and an id.
absl::StatusOr<NameInGroup> ParseNameInGroup(const std::string& collection,
                                             const std::string& form,
                                             const std::string& name,
                                             const FieldPath& path) {
  const std::size_t at = name.rfind(collection);
  if (at == std::string::npos) {
    return InvalidField(
        kInvalidName, path,
        absl::StrCat("got ", Quoted(name), "; the form is ", form));
  }
  absl::StatusOr<std::string> group = ParseGroupName(name.substr(0, at), path);
  if (!group.ok()) return group.status();
  NameInGroup parsed{*std::move(group), name.substr(at + collection.size())};
  if (absl::Status status = CheckId(parsed.id, path); !status.ok()) {
    return status;
  }
  return parsed;
}

}  // namespace

std::string VehicleName(const std::string& vehicle_id) {
  return kVehicles + vehicle_id;
}

std::string PosePairResourceName(PairKind kind, const std::string& vehicle_id,
                                 const std::string& id) {
  return absl::StrCat(VehicleName(vehicle_id), CollectionOf(kind), id);
}

std::string DeletedPairResourceName(const std::string& vehicle_id,
                                    std::uint64_t number) {
  return absl::StrCat(VehicleName(vehicle_id), "/deletedPosePairs/", number);
}

std::string RecordingName(const std::string& vehicle_id,
                          std::uint64_t first_sequence) {
  return absl::StrCat(VehicleName(vehicle_id), "/recordings/", first_sequence);
}

std::string CheckName(const std::string& vehicle_id, std::uint64_t sequence) {
  return absl::StrCat(VehicleName(vehicle_id), kChecks, sequence);
}

std::string CheckCandidateName(const std::string& vehicle_id,
                               std::uint64_t sequence, std::uint32_t number) {
  return absl::StrCat(CheckName(vehicle_id, sequence), kCandidates, number);
}

std::string GroupName(const std::string& group_id) {
  return kGroups + group_id;
}

std::string MemberName(const std::string& group_id,
                       const std::string& vehicle_id) {
  return absl::StrCat(GroupName(group_id), kMembers, vehicle_id);
}

std::string GroupLinkName(PairKind kind, const std::string& group_id,
                          const std::string& id) {
  return absl::StrCat(GroupName(group_id), CollectionOf(kind), id);
}

absl::Status CheckId(const std::string& id, const FieldPath& path) {
  const auto alphanumeric = [](char c) {
    return (c >= 'a' && c <= 'z') || (c >= '0' && c <= '9');
  };
  const bool matches = !id.empty() && id.size() <= 63 &&
                       alphanumeric(id.front()) && alphanumeric(id.back()) &&
                       std::all_of(id.begin(), id.end(), [&](char c) {
                         return alphanumeric(c) || c == '-';
                       });
  if (matches) return absl::OkStatus();
  return InvalidField(
      kInvalidName, path,
      absl::StrCat("got ", Quoted(id),
                   "; an id is 1 to 63 lower-case letters, digits and "
                   "hyphens, with no hyphen at either end"));
}

absl::Status CheckUid(const std::string& uid, const FieldPath& path) {
  if (uid.empty() || IsUuid(uid)) return absl::OkStatus();
  return InvalidField(
      kInvalidField, path,
      absl::StrCat("got ", Quoted(uid),
                   "; a uid is 8-4-4-4-12 hexadecimal digits in lower case, as "
                   "Vehicle.uid has it"));
}

absl::StatusOr<std::string> ParseVehicleName(const std::string& name,
                                             const FieldPath& path) {
  return ParseTopName(kVehicles, "vehicles/{vehicle}", name, path);
}

absl::StatusOr<std::string> ParseGroupName(const std::string& name,
                                           const FieldPath& path) {
  return ParseTopName(kGroups, "groups/{group}", name, path);
}

absl::StatusOr<NameInGroup> ParseMemberName(const std::string& name,
                                            const FieldPath& path) {
  return ParseNameInGroup(kMembers, "groups/{group}/members/{vehicle}", name,
                          path);
}

absl::StatusOr<NameInGroup> ParseGroupLinkName(PairKind kind,
                                               const std::string& name,
                                               const FieldPath& path) {
  const std::string collection = CollectionOf(kind);
  return ParseNameInGroup(
      collection,
      absl::StrCat("groups/{group}", collection, "{", WordsOf(kind).field, "}"),
      name, path);
}

absl::StatusOr<PosePairName> ParsePosePairName(PairKind kind,
                                               const std::string& name,
                                               const FieldPath& path) {
  const std::string collection = CollectionOf(kind);
  const std::size_t at = name.rfind(collection);
  if (at == std::string::npos) {
    return InvalidField(
        kInvalidName, path,
        absl::StrCat("got ", Quoted(name), "; the form is vehicles/{vehicle}",
                     collection, "{", WordsOf(kind).field, "}"));
  }
  absl::StatusOr<std::string> vehicle =
      ParseVehicleName(name.substr(0, at), path);
  if (!vehicle.ok()) return vehicle.status();
  PosePairName parsed{*vehicle, name.substr(at + collection.size())};
  if (absl::Status status = CheckId(parsed.id, path); !status.ok()) {
    return status;
  }
  return parsed;
}

absl::StatusOr<ParsedCheckName> ParseCheckName(const std::string& name,
                                               const FieldPath& path) {
  const std::size_t at = name.rfind(kChecks);
  ParsedCheckName parsed;
  if (at == std::string::npos ||
      !ReadNumber(name.substr(at + sizeof(kChecks) - 1), &parsed.sequence)) {
    return InvalidField(kInvalidName, path,
                        absl::StrCat("got ", Quoted(name),
                                     "; the form is "
                                     "vehicles/{vehicle}/checks/{sequence}"));
  }
  absl::StatusOr<std::string> vehicle =
      ParseVehicleName(name.substr(0, at), path);
  if (!vehicle.ok()) return vehicle.status();
  parsed.vehicle_id = *std::move(vehicle);
  return parsed;
}

absl::StatusOr<ParsedCheckName> ParseCheckCandidateName(const std::string& name,
                                                        const FieldPath& path) {
  const std::size_t at = name.rfind(kCandidates);
  std::uint64_t number = 0;
  if (at == std::string::npos ||
      !ReadNumber(name.substr(at + sizeof(kCandidates) - 1), &number) ||
      number > std::numeric_limits<std::uint32_t>::max()) {
    return InvalidField(
        kInvalidName, path,
        absl::StrCat("got ", Quoted(name),
                     "; the form is vehicles/{vehicle}/checks/{sequence}/"
                     "candidates/{number}"));
  }
  absl::StatusOr<ParsedCheckName> parsed =
      ParseCheckName(name.substr(0, at), path);
  if (parsed.ok()) parsed->number = static_cast<std::uint32_t>(number);
  return parsed;
}

}  // namespace revisit::server
