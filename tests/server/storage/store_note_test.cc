#include "server/storage/store_note.h"

#include <chrono>
#include <filesystem>
#include <fstream>
#include <optional>
#include <string>

#include "gtest/gtest.h"
#include "tests/server/temporary_directory.h"

namespace revisit::server {
namespace {

using std::chrono::seconds;
using std::chrono::system_clock;

std::string Shown(const std::optional<StoreNote>& note) {
  if (!note) return "none";
  const auto since = note->time.time_since_epoch();
  return note->word + " " +
         std::to_string(std::chrono::duration_cast<seconds>(since).count());
}

TEST(StoreNoteTest, IsReadAsItWasWrittenLast) {
  const TemporaryDirectory directory;
  const std::string path = ExitNoteOf(directory.File("store"));
  EXPECT_EQ(Shown(ReadNote(path)), "none");
  ASSERT_TRUE(WriteNote(
      path, {kStoreFailed, system_clock::time_point(seconds(1'800'000'000))}));
  EXPECT_EQ(Shown(ReadNote(path)), "store_failed 1800000000");
  const auto bytes = std::filesystem::file_size(path);
  // A shorter one leaves nothing of the one before, and takes no more room.
  ASSERT_TRUE(
      WriteNote(path, {kRunning, system_clock::time_point(seconds(7))}));
  EXPECT_EQ(Shown(ReadNote(path)), "running 7");
  EXPECT_EQ(std::filesystem::file_size(path), bytes);
}

TEST(StoreNoteTest, WhatIsNoNoteIsNone) {
  const TemporaryDirectory directory;
  const std::string path = directory.File("note");
  for (const char* text : {"", "stopped", "stopped soon", "7 stopped",
                           "Stopped 7", "a_word_that_is_too_long 7"}) {
    std::ofstream(path) << text;
    EXPECT_EQ(Shown(ReadNote(path)), "none") << text;
  }
}

TEST(StoreNoteTest, ThereIsNoneWhereItCannotBeWritten) {
  EXPECT_FALSE(WriteNote("/no/such/directory/note",
                         {kStopped, system_clock::time_point()}));
  EXPECT_EQ(Shown(ReadNote("/no/such/directory/note")), "none");
}

}  // namespace
}  // namespace revisit::server
