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

std::string NameWith(const std::string& prefix, const std::string& id) {
  return id.rfind(prefix, 0) == 0 ? id : prefix + id;
}

}  // namespace

std::string VehicleName(const std::string& id) {
  return NameWith("vehicles/", id);
}

std::string GroupName(const std::string& id) { return NameWith("groups/", id); }

std::string IdOf(const std::string& name) {
  return name.substr(name.rfind('/') + 1);
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

std::string Explain(v1::UnsearchedReason reason) {
  switch (reason) {
    case v1::UNSEARCHED_REASON_NOT_READY:
      return "the server has not read its history yet";
    case v1::UNSEARCHED_REASON_DAMAGED:
      return "its history is damaged or cannot be read";
    case v1::UNSEARCHED_REASON_STATE_SPACE:
      return "its state space is another one";
    case v1::UNSEARCHED_REASON_CORRELATION_MODEL:
      return "its correlation model is another one";
    case v1::UNSEARCHED_REASON_NODE_SPACING:
      return "its node spacing differs by more than a factor of two";
    case v1::UNSEARCHED_REASON_ALIGNMENT:
      return "composite alignments are made within one vehicle";
    case v1::UNSEARCHED_REASON_MEMORY:
      return "the server has no memory left for it";
    default:
      return "the server gave no reason";
  }
}

}  // namespace revisit::client
