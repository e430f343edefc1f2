#include "server/connections/frame_reader.h"

#include <algorithm>
#include <cstddef>
#include <random>
#include <string>

#include "gtest/gtest.h"
#include "tests/random.h"
#include "tests/server/connections/frames.h"

namespace revisit::server {
namespace {

// "TYPE LENGTH;" of each head, the bytes read in pieces as `piece` says.
template <typename Piece>
std::string Heads(const std::string& bytes, Piece&& piece) {
  FrameReader reader;
  std::string heads;
  for (std::size_t at = 0; at < bytes.size();) {
    std::size_t count = std::min<std::size_t>(piece(), bytes.size() - at);
    const auto* next =
        reinterpret_cast<const unsigned char*>(bytes.data()) + at;
    at += count;
    FrameHead head{};
    while (reader.Next(&next, &count, &head)) {
      heads += std::to_string(static_cast<int>(head.type)) +
               (head.is_answer ? "a " : " ") + std::to_string(head.length) +
               ";";
    }
    EXPECT_EQ(count, 0u);
  }
  return heads;
}

TEST(FrameReaderTest, FindsTheHeadsBehindThePreface) {
  const std::string bytes =
      kPreface + Frame(FrameType::kSettings, 6) +
      Frame(FrameType::kHeaders, 70000) + Frame(FrameType::kContinuation, 0) +
      Frame(FrameType::kPing, 8, kAnswer) + Frame(FrameType::kData, 3);
  EXPECT_EQ(Heads(bytes, [&] { return bytes.size(); }),
            "4 6;1 70000;9 0;6a 8;0 3;");
}

TEST(FrameReaderTest, WhereBytesAreCutMakesNoDifference) {
  std::mt19937_64 random = SeededRandom();
  std::string bytes = kPreface;
  for (int i = 0; i < 200; ++i) {
    bytes += Frame(static_cast<FrameType>(random() % 12), random() % 40);
  }
  const std::string whole = Heads(bytes, [&] { return bytes.size(); });
  EXPECT_EQ(Heads(bytes, [] { return std::size_t{1}; }), whole);
  for (int i = 0; i < 20; ++i) {
    EXPECT_EQ(Heads(bytes, [&] { return std::size_t{1} + random() % 60; }),
              whole);
  }
}

TEST(FrameReaderTest, KnowsHowMuchOfAFrameIsStillToCome) {
  FrameReader reader;
  EXPECT_EQ(reader.left_of_frame(), 24u);
  const std::string bytes = kPreface + Frame(FrameType::kData, 100);
  const auto* next = reinterpret_cast<const unsigned char*>(bytes.data());
  std::size_t count = bytes.size() - 60;
  FrameHead head{};
  EXPECT_TRUE(reader.Next(&next, &count, &head));
  EXPECT_FALSE(reader.Next(&next, &count, &head));
  EXPECT_EQ(reader.left_of_frame(), 60u);
}

}  // namespace
}  // namespace revisit::server
