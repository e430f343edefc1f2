#include "client/formats/byte_source.h"

#include <zlib.h>
#include <zstd.h>

#include <string>

#include "client/formats/reader.h"
#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "tests/client/formats/reading.h"

namespace revisit::client {
namespace {

using ::testing::HasSubstr;

std::string Gzip(const std::string& text) {
  // 16 more than the window asks zlib for a gzip header (zlib.h, deflateInit2).
  constexpr int kGzipWindowBits = MAX_WBITS + 16;
  constexpr int kMemoryLevel = 8;
  z_stream stream = {};
  deflateInit2(&stream, Z_DEFAULT_COMPRESSION, Z_DEFLATED, kGzipWindowBits,
               kMemoryLevel, Z_DEFAULT_STRATEGY);
  std::string input = text;
  std::string bytes(deflateBound(&stream, input.size()), '\0');
  stream.next_in = reinterpret_cast<Bytef*>(input.data());
  stream.avail_in = static_cast<uInt>(input.size());
  stream.next_out = reinterpret_cast<Bytef*>(bytes.data());
  stream.avail_out = static_cast<uInt>(bytes.size());
  EXPECT_EQ(deflate(&stream, Z_FINISH), Z_STREAM_END);
  bytes.resize(stream.total_out);
  deflateEnd(&stream);
  return bytes;
}

std::string Zstandard(const std::string& text) {
  std::string bytes(ZSTD_compressBound(text.size()), '\0');
  bytes.resize(
      ZSTD_compress(bytes.data(), bytes.size(), text.data(), text.size(), 3));
  return bytes;
}

// Much more than the buffers.
std::string LongDrive() {
  std::string text = "t_s,est_x,est_y,est_yaw\n";
  for (int i = 0; i < 20'000; ++i) {
    text += std::to_string(i) + "," + std::to_string(i) + ",0,0\n";
  }
  return text;
}

TEST(ByteSourceTest, CompressedTextReadsAsTheTextItself) {
  const std::string text = LongDrive();
  const auto plain = ReadText(text);
  ASSERT_TRUE(plain.ok()) << plain.status();
  ASSERT_EQ(plain->size(), 20'000u);
  for (const std::string& bytes : {Gzip(text), Zstandard(text)}) {
    ASSERT_LT(bytes.size(), text.size() / 2);
    const auto read = ReadText(bytes);
    ASSERT_TRUE(read.ok()) << read.status();
    ASSERT_EQ(read->size(), plain->size());
    EXPECT_EQ(read->back().estimate.x, 19'999.0);
  }
}

TEST(ByteSourceTest, PartsThatFollowEachOtherAreOneText) {
  const std::string first = "t_s,est_x,est_y,est_yaw\n1,2,3,0\n";
  const std::string second = "2,3,3,0\n";
  for (const std::string& bytes :
       {Gzip(first) + Gzip(second), Zstandard(first) + Zstandard(second)}) {
    const auto read = ReadText(bytes);
    ASSERT_TRUE(read.ok()) << read.status();
    EXPECT_EQ(read->size(), 2u);
  }
}

TEST(ByteSourceTest, DamagedAndCutOffFilesAreLostData) {
  const std::string text = LongDrive();
  for (std::string bytes : {Gzip(text), Zstandard(text)}) {
    const auto cut = ReadText(bytes.substr(0, bytes.size() / 2));
    EXPECT_EQ(cut.status().code(), absl::StatusCode::kDataLoss);
    EXPECT_THAT(MessageOf(cut), HasSubstr("the compressed file is cut off"));
    for (std::size_t i = 30; i < 60; ++i) bytes[i] = '\x7f';
    EXPECT_EQ(ReadText(bytes).status().code(), absl::StatusCode::kDataLoss);
  }
}

}  // namespace
}  // namespace revisit::client
