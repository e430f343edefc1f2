#include "core/drive/packed_columns.h"

#include <gtest/gtest.h>

#include <cmath>
#include <cstring>
#include <limits>
#include <random>
#include <vector>

#include "tests/random.h"

namespace revisit::core {
namespace {

void ExpectKept(const std::vector<std::uint64_t>& values, std::size_t rows) {
  const PackedColumns packed(values, rows);
  for (std::size_t i = 0; i < values.size(); ++i) {
    ASSERT_EQ(packed.at(i / rows, i % rows), values[i])
        << "column " << i / rows << ", row " << i % rows << " of " << rows;
  }
}

TEST(PackedColumnsTest, EveryEntryIsKept) {
  std::mt19937_64 random = SeededRandom();
  for (int trial = 0; trial < 300; ++trial) {
    const auto rows = static_cast<std::size_t>(UniformInt(random, 1, 200));
    std::vector<std::uint64_t> values;
    for (int column = UniformInt(random, 1, 20); column > 0; --column) {
      // Any width, including 0, shift and least entry.
      const int width = UniformInt(random, 0, 64);
      const int shift = UniformInt(random, 0, 64 - width);
      const std::uint64_t least = random();
      for (std::size_t row = 0; row < rows; ++row) {
        const std::uint64_t entry = width == 0 ? 0 : random() >> (64 - width);
        values.push_back(least + (entry << shift % 64));
      }
    }
    ASSERT_NO_FATAL_FAILURE(ExpectKept(values, rows)) << "trial " << trial;
  }
}

TEST(PackedColumnsTest, TheEndsOfTheRangeAreKept) {
  constexpr std::uint64_t kMost = std::numeric_limits<std::uint64_t>::max();
  ExpectKept({0}, 1);
  ExpectKept({kMost}, 1);
  ExpectKept({kMost, 0, 1, kMost, kMost, kMost, 0, 0, 0}, 3);
}

TEST(PackedColumnsTest, WhatEntriesShareTakesNoRoom) {
  const std::vector<std::uint64_t> same(128, 0x123456789abcdef0);
  std::vector<std::uint64_t> steps;
  for (std::uint64_t i = 0; i < 128; ++i) steps.push_back(1000000 + 4096 * i);
  // A head of two words, and one to read past the last entry.
  EXPECT_EQ(PackedColumns(same, 128).bytes(), 3 * 8u);
  EXPECT_EQ(PackedColumns(steps, 128).bytes(), 3 * 8u + 128 * 7 / 8);
}

TEST(PackedColumnsTest, DoublesComeBackToTheLastBit) {
  std::mt19937_64 random = SeededRandom();
  std::vector<double> values = {0.0,
                                -0.0,
                                1.0,
                                -1.0,
                                std::numeric_limits<double>::denorm_min(),
                                std::numeric_limits<double>::max(),
                                std::numeric_limits<double>::lowest()};
  for (int i = 0; i < 1000; ++i) {
    values.push_back(
        Normal(random, std::pow(10.0, Uniform(random, -300, 300))));
  }
  for (const double value : values) {
    const double back = FromPackable(ToPackable(value));
    EXPECT_EQ(std::memcmp(&back, &value, sizeof(value)), 0) << value;
  }
}

TEST(PackedColumnsTest, DoublesOfLikeSizeAndEitherSignShareTheirLeadingBits) {
  std::mt19937_64 random = SeededRandom();
  std::vector<std::uint64_t> values;
  for (int i = 0; i < 128; ++i) {
    const double size = Uniform(random, 1.0, 2.0);
    values.push_back(ToPackable(i % 2 == 0 ? size : -size));
  }
  // 52 bits of the fraction and one of the sign.
  EXPECT_LE(PackedColumns(values, 128).bytes(), 3 * 8u + 128 * 53 / 8);
}

}  // namespace
}  // namespace revisit::core
