// Names of resources and of enum values, as people write and read them.
#ifndef REVISIT_CLIENT_ANSWERS_NAMES_H_
#define REVISIT_CLIENT_ANSWERS_NAMES_H_

#include <map>
#include <string>

#include "google/protobuf/descriptor.h"
#include "google/protobuf/generated_enum_reflection.h"
#include "revisit/v1/candidate.pb.h"

namespace revisit::client {

// "vehicles/ID" for ID, "groups/ID" for ID; a resource name stays as it is.
std::string VehicleName(const std::string& id);
std::string GroupName(const std::string& id);

// The ID at the end of a resource name.
std::string IdOf(const std::string& name);

// The value's name without the prefix that names its type, such as "PLANAR" for
// STATE_SPACE_PLANAR; empty for a value that this program does not know.
std::string NameOf(const google::protobuf::EnumDescriptor* type, int value);
template <typename Enum>
std::string NameOf(Enum value) {
  return NameOf(google::protobuf::GetEnumDescriptor<Enum>(), value);
}

// All values but UNSPECIFIED by the words that flags take for them, such as
// "dead-reckoning" for DEAD_RECKONING.
std::map<std::string, int> WordsOf(
    const google::protobuf::EnumDescriptor* type);

// Why there are no candidates, or why a history was not searched, in words.
std::string Explain(v1::EmptyReason reason);
std::string Explain(v1::UnsearchedReason reason);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_ANSWERS_NAMES_H_
