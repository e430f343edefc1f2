// Files around the store's own.
#ifndef REVISIT_SERVER_STORAGE_STORE_FILES_H_
#define REVISIT_SERVER_STORAGE_STORE_FILES_H_

#include <string>

#include "absl/status/status.h"

namespace revisit::server {

// The write-ahead log beside a store.
std::string LogOf(const std::string& store_path);

// Flushes a file, or a directory, to the device. A file that is not there has
// nothing to flush. UNAVAILABLE (STORE_SYNC_FAILED) if the device fails.
absl::Status FlushFile(const std::string& path);

// Flushes a directory and those above it on the same file system, as far as
// they may be read: by their entries a store that was just made is found after
// a power failure. `directory` is absolute. Not every file system can flush a
// directory; only a device that fails is an error.
absl::Status FlushDirectories(const std::string& directory);

// Room set aside, in the file `<store>.reserve`, so that a store can still be
// opened where others have filled the disk: SQLite needs some for the index of
// its log. Makes it if it is not there; without room there is none.
void KeepReserve(const std::string& store_path);
// Gives the room back; answers whether there was any.
bool GiveUpReserve(const std::string& store_path);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_STORE_FILES_H_
