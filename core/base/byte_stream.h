// Numbers as bytes and back, in the order and the bytes of this machine: who
// reads what another kind of machine wrote finds another format version.
//
// A reader never reads beyond its bytes: a call that would answers false and
// leaves its output unspecified.
#ifndef REVISIT_CORE_BASE_BYTE_STREAM_H_
#define REVISIT_CORE_BASE_BYTE_STREAM_H_

#include <cstddef>
#include <cstdint>
#include <cstring>
#include <optional>
#include <string>
#include <type_traits>
#include <utility>
#include <vector>

#include "absl/strings/string_view.h"

namespace revisit::core {

class ByteWriter {
 public:
  template <typename T>
  void Put(const T& value) {
    PutArray(&value, 1);
  }
  template <typename T>
  void PutArray(const T* values, std::size_t count) {
    static_assert(std::is_trivially_copyable_v<T>);
    bytes_.append(reinterpret_cast<const char*>(values), count * sizeof(T));
  }
  // Their number, then the values.
  template <typename T>
  void PutCounted(const T* values, std::size_t count) {
    Put(static_cast<std::uint64_t>(count));
    PutArray(values, count);
  }
  template <typename T>
  void PutOptional(const std::optional<T>& value) {
    Put(static_cast<std::uint8_t>(value.has_value() ? 1 : 0));
    if (value) Put(*value);
  }

  void Reserve(std::size_t bytes) { bytes_.reserve(bytes); }
  std::string Take() { return std::move(bytes_); }

 private:
  std::string bytes_;
};

class ByteReader {
 public:
  explicit ByteReader(absl::string_view bytes) : bytes_(bytes) {}

  template <typename T>
  bool Get(T* value) {
    return GetArray(value, 1);
  }
  template <typename T>
  bool GetArray(T* values, std::size_t count) {
    static_assert(std::is_trivially_copyable_v<T>);
    if (count > bytes_.size() / sizeof(T)) return false;
    if (count > 0) std::memcpy(values, bytes_.data(), count * sizeof(T));
    bytes_.remove_prefix(count * sizeof(T));
    return true;
  }
  // Appends what PutCounted() wrote, at most `most` values.
  template <typename T>
  bool GetCounted(std::size_t most, std::vector<T>* values) {
    std::uint64_t count = 0;
    if (!Get(&count) || count > most || count > bytes_.size() / sizeof(T)) {
      return false;
    }
    const std::size_t before = values->size();
    values->resize(before + static_cast<std::size_t>(count));
    return GetArray(values->data() + before, static_cast<std::size_t>(count));
  }
  template <typename T>
  bool GetOptional(std::optional<T>* value) {
    std::uint8_t has_value = 0;
    if (!Get(&has_value) || has_value > 1) return false;
    value->reset();
    if (has_value == 0) return true;
    T read;
    if (!Get(&read)) return false;
    *value = read;
    return true;
  }

  absl::string_view rest() const { return bytes_; }

 private:
  absl::string_view bytes_;
};

// Whether no value is infinite or NaN.
inline bool AreFinite(const double* values, std::size_t count) {
  // Adding one to an exponent of ones alone reaches the sign. Without a branch,
  // so that compilers use vectors.
  constexpr std::uint64_t kExponent = 0x7ff0000000000000;
  constexpr std::uint64_t kOne = 0x0010000000000000;
  std::uint64_t found = 0;
  for (std::size_t i = 0; i < count; ++i) {
    std::uint64_t bits;
    std::memcpy(&bits, values + i, sizeof(bits));
    found |= (bits & kExponent) + kOne;
  }
  return found >> 63 == 0;
}

}  // namespace revisit::core

#endif  // REVISIT_CORE_BASE_BYTE_STREAM_H_
