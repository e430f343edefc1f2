// Collects what is wrong with the fields of one request.
#ifndef REVISIT_SERVER_FIELDS_FIELD_VIOLATIONS_H_
#define REVISIT_SERVER_FIELDS_FIELD_VIOLATIONS_H_

#include <cstddef>
#include <functional>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "server/base/status.h"

namespace revisit::server {

// Reasons of violations.
inline constexpr char kInvalidField[] = "INVALID_FIELD";
inline constexpr char kNotFinite[] = "NOT_FINITE";

// Where a field is, such as poses[3].covariance.values[2]. A path is a chain on
// the stack, and its text is made only for a field that is wrong, so that
// naming the fields of a valid request costs nothing. A path must not outlive
// its name or the path that it was made from.
class FieldPath {
 public:
  // The request itself.
  constexpr FieldPath() = default;

  constexpr FieldPath Field(const char* name) const {
    return FieldPath(Parent(), name, kNoIndex);
  }
  // An element of a repeated field.
  constexpr FieldPath At(const char* name, std::size_t index) const {
    return FieldPath(Parent(), name, index);
  }

  std::string ToString() const;

 private:
  static constexpr std::size_t kNoIndex = static_cast<std::size_t>(-1);

  // The request itself is no part of a path: the name of a field directly below
  // it stands alone.
  constexpr const FieldPath* Parent() const {
    return name_ == nullptr ? nullptr : this;
  }

  constexpr FieldPath(const FieldPath* parent, const char* name,
                      std::size_t index)
      : parent_(parent), name_(name), index_(index) {}

  const FieldPath* parent_ = nullptr;
  const char* name_ = nullptr;
  std::size_t index_ = kNoIndex;
};

class Violations {
 public:
  void Add(const char* reason, const FieldPath& path,
           const std::string& description);

  std::size_t count() const { return violations_.size(); }

  // Gives each the name that `name_of` has for its own one. Those that then say
  // the same of one field are one.
  void Rename(const std::function<std::string(const std::string&)>& name_of);

  // OK if there are none; otherwise InvalidFields() with the reason of the
  // first.
  absl::Status ToStatus() const;

 private:
  std::string reason_;
  std::vector<FieldViolation> violations_;
};

// Return whether the value is allowed, and add a violation otherwise.
bool CheckFinite(double value, const FieldPath& path, Violations* violations);
bool CheckRange(double value, double lowest, double highest,
                const FieldPath& path, Violations* violations);

// What a text is for.
enum class TextUse {
  // A name, or a value that is told from others: it looks like what it is.
  // Neither control characters, nor separators of lines, nor what changes the
  // direction of the text, nor spaces and marks without width (U+200B, U+2060
  // to U+206F, U+FEFF). The joiners stay, which some scripts and emoji need.
  kName,
  // For people to read: line feeds and tabs, and what any script needs, but no
  // other control character.
  kNote,
};
// Whether the text is short enough and has no character that its use forbids.
// Texts that are stored already are not judged again. REQUIRES: valid UTF-8, as
// parsed messages have it.
bool CheckText(const std::string& text, std::size_t most_bytes, TextUse use,
               const FieldPath& path, Violations* violations);

// Text that a caller sent, as messages show it: in quotes, and in printable
// ASCII.
std::string Quoted(const std::string& text);

// A single violation as a status.
absl::Status InvalidField(const char* reason, const FieldPath& path,
                          const std::string& description);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_FIELDS_FIELD_VIOLATIONS_H_
