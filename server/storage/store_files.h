// Files around the store's own.
#ifndef REVISIT_SERVER_STORAGE_STORE_FILES_H_
#define REVISIT_SERVER_STORAGE_STORE_FILES_H_

#include <cstdint>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"

namespace revisit::server {

// A store is named by its file or by the directory that holds it.

// The file of the store to serve; its directory is made if it is missing.
// Errors of MakeDirectory().
absl::StatusOr<std::string> StoreFileToServe(const std::string& path);

// The file of a store that is there. The file itself may be missing where
// others of the store are left: those are for whoever examines the store.
// NOT_FOUND if there is none of them.
absl::StatusOr<std::string> ExistingStoreFile(const std::string& path);

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
// Writes a file anew with what it holds, in place, and flushes it. After a
// failed flush the system may show what never reached the device, and call it
// flushed: this makes it true. Others may read the file meanwhile. Errors as
// above.
absl::Status FlushAnew(const std::string& path);

// Makes a directory for its owner alone, and those above it that are missing;
// FlushDirectories() keeps them. UNAVAILABLE (STORE_UNAVAILABLE).
absl::Status MakeDirectory(const std::string& path);

// Makes an empty file for its owner alone, if there is none; SQLite gives its
// own files beside it the same rights. The status says why that failed.
absl::Status MakePrivateFile(const std::string& path);

// The files of a store beside its database that are there.
std::vector<std::string> FilesBeside(const std::string& store_path);

// Room set aside, in the file `<store>.reserve`, so that a store can still be
// opened, and vehicles be deleted, where others have filled the disk: SQLite
// needs some for its log and the index of it. Makes it if it is not there;
// without room there is none.
void KeepReserve(const std::string& store_path);
// Gives the room back; answers whether there was any.
bool GiveUpReserve(const std::string& store_path);

// Notices that files that are open were removed or replaced: what is written to
// them then will not be found by anybody.
class FileWatch {
 public:
  // The database and the files beside it that are there now.
  explicit FileWatch(const std::string& store_path);

  // OK, or UNAVAILABLE (STORE_UNAVAILABLE) naming the file.
  absl::Status Check() const;

 private:
  struct File {
    std::string path;
    std::uint64_t device;
    std::uint64_t inode;
  };
  std::vector<File> files_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_STORE_FILES_H_
