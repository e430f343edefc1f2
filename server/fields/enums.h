// Tables that say what the values of an enum of messages mean in the server's
// own types.
#ifndef REVISIT_SERVER_FIELDS_ENUMS_H_
#define REVISIT_SERVER_FIELDS_ENUMS_H_

#include <cstddef>

#include "absl/strings/str_cat.h"
#include "server/fields/field_violations.h"

namespace revisit::server {

// One value of an enum. ToProto() answers the first row of a table for a value
// that has none.
template <typename Proto, typename Own>
struct EnumRow {
  Proto proto;
  Own own;
};

template <typename Proto, typename Own, std::size_t N>
Proto ToProto(const EnumRow<Proto, Own> (&rows)[N], Own value) {
  for (const auto& row : rows) {
    if (row.own == value) return row.proto;
  }
  return rows[0].proto;
}

// Adds a violation of an enum's field that has a number without a meaning.
inline void AddUnknownValue(int number, const FieldPath& path,
                            Violations* violations) {
  violations->Add(
      kInvalidField, path,
      absl::StrCat("got ", number, ", which is no value of this enum"));
}

// Leaves the value alone if the field is unspecified.
template <typename Proto, typename Own, std::size_t N>
void DecodeEnum(const EnumRow<Proto, Own> (&rows)[N], int field,
                const FieldPath& path, Own* value, Violations* violations) {
  if (field == 0) return;
  for (const auto& row : rows) {
    if (static_cast<int>(row.proto) == field) {
      *value = row.own;
      return;
    }
  }
  AddUnknownValue(field, path, violations);
}

}  // namespace revisit::server

#endif  // REVISIT_SERVER_FIELDS_ENUMS_H_
