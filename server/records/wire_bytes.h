// Fields of messages as bytes, in the wire format of protobuf, for those who
// write them without a message. Fields that are 0, to the bit, and those that
// are empty are left out, as protobuf does.
#ifndef REVISIT_SERVER_RECORDS_WIRE_BYTES_H_
#define REVISIT_SERVER_RECORDS_WIRE_BYTES_H_

#include <cstddef>
#include <cstdint>
#include <cstring>

#include "absl/types/span.h"
#include "google/protobuf/io/coded_stream.h"

namespace revisit::server {

// ---- Tags

enum class WireType : std::uint32_t { kVarint = 0, kFixed64 = 1, kBytes = 2 };

constexpr std::uint32_t Tag(int field, WireType type) {
  return static_cast<std::uint32_t>(field) << 3 |
         static_cast<std::uint32_t>(type);
}

// REQUIRES: the field is one of 1 to 2047.
constexpr std::size_t TagSize(int field) { return field < 16 ? 1 : 2; }

// ---- Numbers

inline std::uint64_t BitsOf(double value) {
  std::uint64_t bits;
  static_assert(sizeof(bits) == sizeof(value));
  std::memcpy(&bits, &value, sizeof(bits));
  return bits;
}

// Negative numbers of 32 bits are written as those of 64 bits.
inline std::uint64_t Widened(std::int64_t value) {
  return static_cast<std::uint64_t>(value);
}

// A number of type sint64 as it is written.
inline std::uint64_t ZigZag(std::int64_t value) {
  return static_cast<std::uint64_t>(value) << 1 ^
         static_cast<std::uint64_t>(value >> 63);
}

// ---- Sizes, with tags

using google::protobuf::io::CodedOutputStream;

inline std::size_t VarintSize(int field, std::uint64_t value) {
  return value == 0 ? 0
                    : TagSize(field) + CodedOutputStream::VarintSize64(value);
}

inline std::size_t BytesSize(int field, std::size_t size) {
  return TagSize(field) + CodedOutputStream::VarintSize64(size) + size;
}

inline std::size_t PackedSize(int field, absl::Span<const double> values) {
  return values.empty() ? 0 : BytesSize(field, sizeof(double) * values.size());
}

// ---- Fields; each returns where the next one begins

inline std::uint8_t* WriteVarint(int field, std::uint64_t value,
                                 std::uint8_t* next) {
  if (value == 0) return next;
  next =
      CodedOutputStream::WriteTagToArray(Tag(field, WireType::kVarint), next);
  return CodedOutputStream::WriteVarint64ToArray(value, next);
}

// Also 0.
inline std::uint8_t* WriteDouble(int field, double value, std::uint8_t* next) {
  next =
      CodedOutputStream::WriteTagToArray(Tag(field, WireType::kFixed64), next);
  return CodedOutputStream::WriteLittleEndian64ToArray(BitsOf(value), next);
}

// Writes what comes before the bytes of a message or a text.
inline std::uint8_t* BeginBytes(int field, std::size_t size,
                                std::uint8_t* next) {
  next = CodedOutputStream::WriteTagToArray(Tag(field, WireType::kBytes), next);
  return CodedOutputStream::WriteVarint64ToArray(size, next);
}

inline std::uint8_t* WritePacked(int field, absl::Span<const double> values,
                                 std::uint8_t* next) {
  if (values.empty()) return next;
  next = BeginBytes(field, sizeof(double) * values.size(), next);
  for (const double value : values) {
    next = CodedOutputStream::WriteLittleEndian64ToArray(BitsOf(value), next);
  }
  return next;
}

}  // namespace revisit::server

#endif  // REVISIT_SERVER_RECORDS_WIRE_BYTES_H_
