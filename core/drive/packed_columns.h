// Columns of 64-bit numbers, compressed without loss: bits that all entries of
// a column share are kept once, so an entry takes only as many bits as tell the
// column's entries apart.
//
// Immutable once made or loaded, so thread-safe.
#ifndef REVISIT_CORE_DRIVE_PACKED_COLUMNS_H_
#define REVISIT_CORE_DRIVE_PACKED_COLUMNS_H_

#include <cstddef>
#include <cstdint>
#include <cstring>
#include <vector>

#include "core/base/byte_stream.h"

namespace revisit::core {

class PackedColumns {
 public:
  // No columns.
  PackedColumns() = default;
  // `values` are the columns one after the other, with `rows` entries each.
  // REQUIRES: rows > 0 divides the number of values.
  PackedColumns(const std::vector<std::uint64_t>& values, std::size_t rows);

  // O(1), without a branch. REQUIRES: both in range.
  std::uint64_t at(std::size_t column, std::size_t row) const {
    const std::uint64_t* const head = words_.data() + kHeadWords * column;
    const std::uint64_t width = head[1] & 0xff;
    const std::uint64_t shift = head[1] >> 8 & 0xff;
    const std::uint64_t bit = (head[1] >> 16) + row * width;
    const std::uint64_t* const word = words_.data() + bit / 64;
    const std::uint64_t offset = bit % 64;
    const std::uint64_t bits = word[0] >> offset | word[1] << 1
                                                           << (63 - offset);
    const std::uint64_t mask =
        width == 0 ? 0 : ~std::uint64_t{0} >> (64 - width);
    return head[0] + ((bits & mask) << shift);
  }

  // Calls take(row, entry) for the first `rows` entries of a column in order,
  // which is faster than at() for each. REQUIRES: both in range.
  template <typename Take>
  void Visit(std::size_t column, std::size_t rows, const Take& take) const {
    const std::uint64_t* const head = words_.data() + kHeadWords * column;
    if ((head[1] & 0xff) == 0) {
      for (std::size_t row = 0; row < rows; ++row) take(row, head[0]);
      return;
    }
    for (std::size_t row = 0; row < rows; ++row) take(row, at(column, row));
  }

  std::size_t bytes() const { return words_.capacity() * sizeof(words_[0]); }

  void Save(ByteWriter* writer) const;
  // Becomes what was saved. False, and unspecified, unless these are so many
  // columns of so many rows: then at() stays within them, whatever the entries.
  bool Load(std::size_t columns, std::size_t rows, ByteReader* reader);

 private:
  static constexpr std::size_t kHeadWords = 2;

  // First a head per column: its least entry, then one word with the width of
  // an entry in bits, the number of bits by which it is shifted, and the
  // position of the first entry, in bits from the start. An entry is kept as
  // its distance from the least. Then all entries, and one more word, since
  // at() reads past the last.
  std::vector<std::uint64_t> words_;
};

// Converts doubles to numbers that share leading bits where the doubles are of
// similar magnitude, whatever their signs.
inline std::uint64_t ToPackable(double value) {
  std::uint64_t bits;
  std::memcpy(&bits, &value, sizeof(bits));
  return bits << 1 | bits >> 63;
}
inline double FromPackable(std::uint64_t packable) {
  const std::uint64_t bits = packable >> 1 | packable << 63;
  double value;
  std::memcpy(&value, &bits, sizeof(value));
  return value;
}

}  // namespace revisit::core

#endif  // REVISIT_CORE_DRIVE_PACKED_COLUMNS_H_
