#include "core/drive/packed_columns.h"

#include <algorithm>
#include <cassert>

namespace revisit::core {

PackedColumns::PackedColumns(const std::vector<std::uint64_t>& values,
                             std::size_t rows) {
  assert(rows > 0 && values.size() % rows == 0);
  const std::size_t columns = values.size() / rows;
  std::vector<std::uint64_t> heads;
  heads.reserve(kHeadWords * columns);
  std::uint64_t bit = 64 * kHeadWords * columns;
  for (std::size_t c = 0; c < columns; ++c) {
    const std::uint64_t* const column = values.data() + c * rows;
    const std::uint64_t least = *std::min_element(column, column + rows);
    std::uint64_t distances = 0;
    for (std::size_t r = 0; r < rows; ++r) distances |= column[r] - least;
    std::uint64_t shift = 0;
    std::uint64_t width = 0;
    if (distances != 0) {
      shift = static_cast<std::uint64_t>(__builtin_ctzll(distances));
      width =
          64 - shift - static_cast<std::uint64_t>(__builtin_clzll(distances));
    }
    heads.push_back(least);
    // at() reads a word even for entries without bits: the first always exists.
    heads.push_back(width | shift << 8 | (width == 0 ? 0 : bit) << 16);
    bit += width * rows;
  }
  words_.resize((bit + 63) / 64 + 1);
  std::copy(heads.begin(), heads.end(), words_.begin());
  for (std::size_t c = 0; c < columns; ++c) {
    const std::uint64_t* const head = heads.data() + kHeadWords * c;
    const std::uint64_t width = head[1] & 0xff;
    const std::uint64_t shift = head[1] >> 8 & 0xff;
    std::uint64_t at = head[1] >> 16;
    for (std::size_t r = 0; r < rows; ++r, at += width) {
      const std::uint64_t entry = (values[c * rows + r] - head[0]) >> shift;
      words_[at / 64] |= entry << at % 64;
      if (at % 64 + width > 64) words_[at / 64 + 1] |= entry >> (64 - at % 64);
    }
  }
}

void PackedColumns::Save(ByteWriter* writer) const {
  writer->PutCounted(words_.data(), words_.size());
}

bool PackedColumns::Load(std::size_t columns, std::size_t rows,
                         ByteReader* reader) {
  // Entries of 64 bits each, the heads, and the word behind them.
  const std::size_t most = columns * (rows + kHeadWords) + 1;
  words_.clear();
  if (!reader->GetCounted(most, &words_) ||
      words_.size() < kHeadWords * columns + 1) {
    return false;
  }
  for (std::size_t c = 0; c < columns; ++c) {
    const std::uint64_t head = words_[kHeadWords * c + 1];
    const std::uint64_t width = head & 0xff;
    const std::uint64_t shift = head >> 8 & 0xff;
    const std::uint64_t last = (head >> 16) + (rows - 1) * width;
    if (width > 64 || shift > 63 || width + shift > 64 ||
        last / 64 + 1 >= words_.size()) {
      return false;
    }
  }
  return true;
}

}  // namespace revisit::core
