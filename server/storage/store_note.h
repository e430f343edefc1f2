// Notes in files beside a store: a word, and when it was written. They are for
// the next server and for people, and nothing of the store depends on them.
#ifndef REVISIT_SERVER_STORAGE_STORE_NOTE_H_
#define REVISIT_SERVER_STORAGE_STORE_NOTE_H_

#include <chrono>
#include <optional>
#include <string>

namespace revisit::server {

struct StoreNote {
  // Lower-case letters and underscores, 18 at most.
  std::string word;
  // To the second.
  std::chrono::system_clock::time_point time;
};

// How the server ended that served the store last; kRunning while one does, or
// where it came to an end without a word, as by a kill.
std::string ExitNoteOf(const std::string& store_path);
inline constexpr char kRunning[] = "running";
inline constexpr char kStopped[] = "stopped";
inline constexpr char kStoreFailed[] = "store_failed";

// The last backup that was made of the store, with this word.
std::string BackupNoteOf(const std::string& store_path);
inline constexpr char kBackup[] = "backup";

// Nothing if there is no such file, or if it holds something else.
std::optional<StoreNote> ReadNote(const std::string& path);

// Replaces the note, in the room that it has: a full disk does not keep it from
// being written again. Everybody may read it. Returns whether it was written;
// if not, there is none any more as far as that could be done, rather than an
// old one. It is not flushed: a loss of power may take it.
bool WriteNote(const std::string& path, const StoreNote& note);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_STORE_NOTE_H_
