#include "server/storage/store_note.h"

#include <fcntl.h>
#include <sys/types.h>
#include <unistd.h>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <fstream>

namespace revisit::server {
namespace {

// Every note has this many, so that one takes the place of another: a word, a
// blank, the seconds since the Unix epoch, blanks, the end of the line.
constexpr std::size_t kNoteBytes = 40;
constexpr std::size_t kMostLetters = 18;

bool IsWord(const std::string& text) {
  return !text.empty() && text.size() <= kMostLetters &&
         std::all_of(text.begin(), text.end(),
                     [](char c) { return (c >= 'a' && c <= 'z') || c == '_'; });
}

}  // namespace

std::string ExitNoteOf(const std::string& store_path) {
  return store_path + ".exit";
}

std::string BackupNoteOf(const std::string& store_path) {
  return store_path + ".backup";
}

std::optional<StoreNote> ReadNote(const std::string& path) {
  std::ifstream file(path);
  std::string word;
  std::int64_t seconds = 0;
  if (!(file >> word >> seconds) || !IsWord(word)) return std::nullopt;
  return StoreNote{word, std::chrono::system_clock::time_point(
                             std::chrono::seconds(seconds))};
}

bool WriteNote(const std::string& path, const StoreNote& note) {
  const auto seconds = std::chrono::duration_cast<std::chrono::seconds>(
      note.time.time_since_epoch());
  std::string text = note.word + " " + std::to_string(seconds.count());
  text.resize(kNoteBytes - 1, ' ');
  text += "\n";
  const int file = open(path.c_str(), O_WRONLY | O_CREAT | O_CLOEXEC, 0600);
  const bool is_written =
      file >= 0 && pwrite(file, text.data(), text.size(), 0) ==
                       static_cast<ssize_t>(text.size());
  if (file >= 0) close(file);
  if (!is_written) unlink(path.c_str());
  return is_written;
}

}  // namespace revisit::server
