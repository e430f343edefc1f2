#include "server/base/line_writer.h"

#include <fcntl.h>
#include <signal.h>
#include <unistd.h>

#include <chrono>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <sstream>
#include <string>
#include <thread>
#include <vector>

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "tests/server/waiting.h"

namespace revisit::server {
namespace {

using ::testing::ElementsAre;

// Bytes that an unread pipe holds.
constexpr int kPipeBytes = 65536;

class Pipe {
 public:
  Pipe() {
    signal(SIGPIPE, SIG_IGN);
    EXPECT_EQ(pipe2(ends_, O_CLOEXEC), 0);
    EXPECT_EQ(fcntl(ends_[1], F_SETPIPE_SZ, kPipeBytes), kPipeBytes);
  }
  ~Pipe() {
    CloseReader();
    CloseWriter();
  }

  int writer() const { return ends_[1]; }

  void CloseReader() { Close(&ends_[0]); }
  void CloseWriter() { Close(&ends_[1]); }

  // The next line, without its end. Waits for it.
  std::string ReadLine() {
    std::size_t end;
    while ((end = unread_.find('\n')) == std::string::npos) {
      char buffer[4096];
      const ssize_t size = read(ends_[0], buffer, sizeof(buffer));
      if (size <= 0) return unread_;
      unread_.append(buffer, static_cast<std::size_t>(size));
    }
    const std::string line = unread_.substr(0, end);
    unread_.erase(0, end + 1);
    return line;
  }

  // Everything until the writing end is closed.
  std::string ReadAll() {
    std::string text;
    char buffer[4096];
    for (;;) {
      const ssize_t size = read(ends_[0], buffer, sizeof(buffer));
      if (size <= 0) return text;
      text.append(buffer, static_cast<std::size_t>(size));
    }
  }

 private:
  static void Close(int* end) {
    if (*end >= 0) close(*end);
    *end = -1;
  }

  int ends_[2] = {-1, -1};
  // Read from the pipe, and not yet given out.
  std::string unread_;
};

std::string GapText(std::int64_t dropped) {
  return "dropped " + std::to_string(dropped) + "\n";
}

std::vector<std::string> Lines(const std::string& text) {
  std::vector<std::string> lines;
  std::istringstream stream(text);
  for (std::string line; std::getline(stream, line);) lines.push_back(line);
  return lines;
}

LineWriter::Options SmallQueue() {
  LineWriter::Options options;
  options.max_queued_bytes = 10'000;
  // Whoever reads here may be slow, but reads.
  options.farewell = std::chrono::seconds(60);
  return options;
}

TEST(LineWriterTest, WritesAllThatIsQueuedBeforeItIsDestroyed) {
  Pipe pipe;
  {
    LineWriter writer(pipe.writer(), SmallQueue(), GapText);
    writer.Write("one\n");
    writer.Write("two\n");
  }
  pipe.CloseWriter();
  EXPECT_THAT(Lines(pipe.ReadAll()), ElementsAre("one", "two"));
}

TEST(LineWriterTest, NeverWaitsForAReaderThatStopped) {
  Pipe pipe;
  LineWriter::Options options = SmallQueue();
  options.farewell = std::chrono::milliseconds(100);
  {
    LineWriter writer(pipe.writer(), options, GapText);
    // Far more than pipe and queue hold; it would wait for ever otherwise.
    for (int i = 0; i < 10'000; ++i) writer.Write("a line of the log\n");
    EXPECT_GT(writer.dropped(), 0);
  }
  // Nor does its end.
}

TEST(LineWriterTest, CountsWhatItDropsWhereItIsMissing) {
  Pipe pipe;
  // Several times what pipe and queue hold.
  constexpr std::int64_t kCount = 100'000;
  LineWriter writer(pipe.writer(), SmallQueue(), GapText);
  for (std::int64_t i = 0; i < kCount; ++i) {
    writer.Write(std::to_string(i) + "\n");
  }
  // Also if nothing more is written, the gap is told as soon as somebody reads.
  // There may be several gaps, if the queue was full before the pipe was.
  std::int64_t next = 0;
  std::int64_t gaps = 0;
  std::int64_t dropped = 0;
  while (next < kCount) {
    const std::string line = pipe.ReadLine();
    if (line.rfind("dropped ", 0) == 0) {
      dropped += std::stoll(line.substr(8));
      next += std::stoll(line.substr(8));
      ++gaps;
    } else {
      ASSERT_EQ(line, std::to_string(next));
      ++next;
    }
  }
  EXPECT_EQ(next, kCount);
  EXPECT_GT(gaps, 0);
  EXPECT_EQ(writer.dropped(), dropped);
  writer.Write("after\n");
  EXPECT_EQ(pipe.ReadLine(), "after");
}

TEST(LineWriterTest, LinesOfManyThreadsStayWhole) {
  Pipe pipe;
  std::string text;
  std::thread reader([&] { text = pipe.ReadAll(); });
  {
    LineWriter::Options options = SmallQueue();
    options.max_queued_bytes = std::size_t{1} << 20;
    LineWriter writer(pipe.writer(), options, GapText);
    std::vector<std::thread> threads;
    for (int t = 0; t < 4; ++t) {
      threads.emplace_back([&writer] {
        for (int i = 0; i < 250; ++i) {
          writer.Write(std::string(300, 'a') + "\n");
        }
      });
    }
    for (std::thread& thread : threads) thread.join();
  }
  pipe.CloseWriter();
  reader.join();
  const std::vector<std::string> lines = Lines(text);
  ASSERT_EQ(lines.size(), 1000u);
  for (const std::string& line : lines) EXPECT_EQ(line, std::string(300, 'a'));
}

// Writes to a descriptor that takes nothing, which then becomes a pipe that
// does: the lines that it did not take are counted, and those after them come.
void ExpectLosesLinesOnly(int descriptor) {
  constexpr std::int64_t kLost = 10'000;
  Pipe pipe;
  LineWriter writer(descriptor, SmallQueue(), GapText);
  for (std::int64_t i = 0; i < kLost; ++i) {
    writer.Write("a line of the log\n");
  }
  // No line is counted as long as it may still be written.
  ASSERT_TRUE(Eventually([&] { return writer.dropped() >= kLost; }));
  EXPECT_EQ(writer.dropped(), kLost);
  ASSERT_GE(dup3(pipe.writer(), descriptor, O_CLOEXEC), 0);
  writer.Write("after\n");
  EXPECT_EQ(pipe.ReadLine(), "after");
  EXPECT_EQ(pipe.ReadLine(), "dropped 10000");
  EXPECT_EQ(writer.dropped(), kLost);
}

TEST(LineWriterTest, OutlivesAReaderThatWentAway) {
  Pipe pipe;
  pipe.CloseReader();
  ExpectLosesLinesOnly(pipe.writer());
}

// A device without room, such as a full disk: the lines are lost, the writer is
// not.
TEST(LineWriterTest, DeviceWithoutRoomLosesLinesOnly) {
  const int full = open("/dev/full", O_WRONLY | O_CLOEXEC);
  ASSERT_GE(full, 0);
  ExpectLosesLinesOnly(full);
  close(full);
}

TEST(WriteWithinTest, GivesUpOnAReaderThatStopped) {
  Pipe pipe;
  EXPECT_TRUE(WriteWithin(pipe.writer(), std::string(1000, 'a'),
                          std::chrono::seconds(60)));
  EXPECT_FALSE(WriteWithin(pipe.writer(), std::string(100'000, 'a'),
                           std::chrono::milliseconds(100)));
}

}  // namespace
}  // namespace revisit::server
