#include "client/answers/names.h"

#include "absl/strings/ascii.h"

namespace revisit::client {
namespace {

using google::protobuf::EnumDescriptor;

// The prefix of the values of an enum, such as "STATE_SPACE_" for StateSpace.
std::string PrefixOf(const EnumDescriptor& type) {
  std::string prefix;
  for (const char c : type.name()) {
    if (absl::ascii_isupper(c) && !prefix.empty()) prefix += '_';
    prefix += absl::ascii_toupper(c);
  }
  return prefix + '_';
}

}  // namespace

std::string VehicleName(const std::string& id) {
  constexpr char kPrefix[] = "vehicles/";
  return id.rfind(kPrefix, 0) == 0 ? id : kPrefix + id;
}

std::string NameOf(const EnumDescriptor* type, int value) {
  const auto* known = type->FindValueByNumber(value);
  if (known == nullptr) return "";
  const std::string prefix = PrefixOf(*type);
  const std::string& name = known->name();
  return name.rfind(prefix, 0) == 0 ? name.substr(prefix.size()) : name;
}

std::map<std::string, int> WordsOf(const EnumDescriptor* type) {
  std::map<std::string, int> words;
  for (int i = 0; i < type->value_count(); ++i) {
    const int value = type->value(i)->number();
    if (value == 0) continue;
    std::string word = NameOf(type, value);
    for (char& c : word) c = c == '_' ? '-' : absl::ascii_tolower(c);
    words[word] = value;
  }
  return words;
}

std::string Explain(v1::EmptyReason reason) {
  switch (reason) {
    case v1::EMPTY_REASON_PATH_TOO_SHORT:
      return "the path up to the query is shorter than the sequence";
    case v1::EMPTY_REASON_NO_HISTORY:
      return "there is no history before the sequence";
    case v1::EMPTY_REASON_ALL_SUPPRESSED:
      return "all history is too near the query along the path";
    case v1::EMPTY_REASON_NO_ALIGNMENT:
      return "the sequence aligns with no path of the history";
    case v1::EMPTY_REASON_NO_PROBABLE_PLACE:
      return "no place of the history is probable";
    case v1::EMPTY_REASON_LIMIT_EXCEEDED:
      return "the search would compare more than the server allows";
    default:
      return "the server gave no reason";
  }
}

}  // namespace revisit::client
