// The files of a store: where they are, how they are made and flushed.
#ifndef REVISIT_SERVER_STORAGE_SQLITE_STORE_FILES_H_
#define REVISIT_SERVER_STORAGE_SQLITE_STORE_FILES_H_

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

// The file of an existing store. The file itself may be missing if others of
// the store are left: the examination of the store judges those. NOT_FOUND if
// there is none of them.
absl::StatusOr<std::string> ExistingStoreFile(const std::string& path);

// The write-ahead log beside a store.
std::string LogOf(const std::string& store_path);

// Size of a file; 0 if it cannot be told.
std::int64_t BytesOf(const std::string& path);

// Flushes a file, or a directory, to the device. OK if there is no such file.
// UNAVAILABLE (STORE_SYNC_FAILED) if the device fails.
absl::Status FlushFile(const std::string& path);

// Flushes a directory and those above it on the same file system, as far as
// they may be read: through their entries a new store is found after a power
// failure. `directory` is absolute. Not every file system can flush a
// directory; only a device that fails is an error.
absl::Status FlushDirectories(const std::string& directory);

// Writes a file anew with its own contents, in place, and flushes it. After a
// failed flush the system may show contents that never reached the device, and
// call them flushed: this makes it true. Others may read the file meanwhile.
// Errors are those of FlushFile().
absl::Status FlushAnew(const std::string& path);

// Makes a directory for its owner alone, and those above it that are missing.
// FlushDirectories() makes them survive a power failure. UNAVAILABLE
// (STORE_UNAVAILABLE) if it cannot be made.
absl::Status MakeDirectory(const std::string& path);

// Makes an empty file for its owner alone, if there is none; SQLite gives its
// own files beside it the same rights. The status says why that failed.
absl::Status MakePrivateFile(const std::string& path);

// The files of a store beside its database, as far as they exist.
std::vector<std::string> FilesBeside(const std::string& store_path);

// Sets room aside in the file `<store>.reserve`, so that a store can still be
// opened, and vehicles can be deleted, when other programs have filled the
// disk: SQLite needs some room for its log and the index of it. Makes no file
// if there is one already, or no room.
void KeepReserve(const std::string& store_path);
// Gives the room back; returns whether there was any.
bool GiveUpReserve(const std::string& store_path);

// Notices that open files were removed or replaced: nobody would find what is
// written to them afterwards.
class FileWatch {
 public:
  // Watches the database and those files beside it that exist now.
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

#endif  // REVISIT_SERVER_STORAGE_SQLITE_STORE_FILES_H_
