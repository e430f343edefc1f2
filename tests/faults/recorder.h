// Records what a process does to the files below a directory; part of the shim
// (shim.cc).
#ifndef REVISIT_TESTS_FAULTS_RECORDER_H_
#define REVISIT_TESTS_FAULTS_RECORDER_H_

#include <sys/types.h>

#include <cstddef>
#include <string>

#include "recording.h"

namespace revisit::faults {

// One call on a watched file or name. From construction to destruction no other
// process or thread changes a watched file, and who holds the lock of the
// recording (flock) may kill the process without an event being lost. Does
// nothing where nothing is recorded, or the file is not watched.
class Recording {
 public:
  explicit Recording(int file);
  explicit Recording(const char* path);
  ~Recording();

  Recording(const Recording&) = delete;
  Recording& operator=(const Recording&) = delete;

  bool is_active() const { return active_; }
  // Whether the path was there when the recording of the call began.
  bool was_there() const { return was_there_; }

  // Each after the call has succeeded.
  void Wrote(int file, const void* data, ssize_t written, off64_t offset);
  void SizeBecame(int file);
  void Opened(int file, int flags);
  void MadeDirectory();
  void Linked(const char* other_path);
  void Unlinked();
  void RenamedTo(const char* other_path);
  void Mapped(int file, void* memory, std::size_t size, off64_t offset);

 private:
  void Begin(std::string path);

  bool active_ = false;
  bool was_there_ = false;
  unsigned long inode_ = 0;
  std::string path_;
};

// A flush, which others need not wait for.
void RecordSyncBegin(int file);
void RecordSyncEnd(int file);
// Memory that is mapped no more.
void ForgetMapped(void* memory);

}  // namespace revisit::faults

#endif  // REVISIT_TESTS_FAULTS_RECORDER_H_
