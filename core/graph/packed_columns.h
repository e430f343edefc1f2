// Columns of 64-bit numbers, each in as few bits as tell its entries apart:
// what most entries of a column share is kept once. Nothing is lost.
//
// Immutable, so thread-safe.
#ifndef REVISIT_CORE_GRAPH_PACKED_COLUMNS_H_
#define REVISIT_CORE_GRAPH_PACKED_COLUMNS_H_

#include <cstddef>
#include <cstdint>
#include <cstring>
#include <vector>

namespace revisit::core {

class PackedColumns {
 public:
  // Of no columns.
  PackedColumns() = default;
  // `values` column after column, `rows` of each.
  // REQUIRES: rows > 0, a whole number of columns.
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

  std::size_t bytes() const { return words_.capacity() * sizeof(words_[0]); }

 private:
  static constexpr std::size_t kHeadWords = 2;

  // A head a column: its least entry; the width of an entry in bits, by how
  // much it is shifted, and the place of the first, in bits from the start. An
  // entry is its distance from the least. Then all entries, and a word to read
  // past the last.
  std::vector<std::uint64_t> words_;
};

// Doubles as numbers that share leading bits where the doubles are of like
// size, whatever their signs.
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

#endif  // REVISIT_CORE_GRAPH_PACKED_COLUMNS_H_
