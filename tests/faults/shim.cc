// Preloaded into revisitd by the fault matrix: the calls by which a store gets
// to the device, failing when they are told to. Only files whose path holds
// REVISIT_TEST_FILE (default "revisit.sqlite") are looked at, and counted
// from 1.
//
//   REVISIT_TEST_FAIL_SYNC=N    the Nth flush fails with EIO
//   REVISIT_TEST_FAIL_WRITE=N   the Nth write fails with ENOSPC
//   REVISIT_TEST_STICKY=1       and so do all that follow
//   REVISIT_TEST_KILL_SYNC=N    the process is killed right after the Nth flush
//                               has succeeded: committed, not acknowledged
//   REVISIT_TEST_SLOW_SYNC=US   every flush takes so many microseconds longer
//   REVISIT_TEST_COUNT=FILE     gets a byte for each call that was failed
//
// And into any program that is to be recorded: all that it does to files below
// a directory, in their order, whatever they are called (recording.h). What it
// does by calls that are not here is missed; power.py checks that nothing is.
//
//   REVISIT_TEST_RECORD=FILE        the recording; processes add to it
//   REVISIT_TEST_RECORD_BELOW=DIR   the directory
#include <dlfcn.h>
#include <fcntl.h>
#include <signal.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

#include <atomic>
#include <cerrno>
#include <cstdarg>
#include <cstddef>
#include <cstdio>
#include <cstdlib>
#include <cstring>

#include "recorder.h"

namespace {

using revisit::faults::Recording;

long Number(const char* name) {
  const char* const text = getenv(name);
  return text == nullptr ? 0 : atol(text);
}

struct Plan {
  const char* file = getenv("REVISIT_TEST_FILE");
  const char* count = getenv("REVISIT_TEST_COUNT");
  long fail_sync = Number("REVISIT_TEST_FAIL_SYNC");
  long fail_write = Number("REVISIT_TEST_FAIL_WRITE");
  long kill_sync = Number("REVISIT_TEST_KILL_SYNC");
  long slow_sync = Number("REVISIT_TEST_SLOW_SYNC");
  bool sticky = Number("REVISIT_TEST_STICKY") != 0;
};

const Plan& ThePlan() {
  static const Plan plan;
  return plan;
}

std::atomic<long> syncs{0};
std::atomic<long> writes{0};

bool IsWatched(int file) {
  char link[64];
  char path[4096];
  std::snprintf(link, sizeof(link), "/proc/self/fd/%d", file);
  const ssize_t size = readlink(link, path, sizeof(path) - 1);
  if (size <= 0) return false;
  path[size] = '\0';
  const char* const part = ThePlan().file;
  return std::strstr(path, part == nullptr ? "revisit.sqlite" : part) !=
         nullptr;
}

bool Fails(long number, long nth) {
  if (nth == 0 || number < nth || (number > nth && !ThePlan().sticky)) {
    return false;
  }
  if (ThePlan().count != nullptr) {
    const int file =
        open(ThePlan().count, O_WRONLY | O_CREAT | O_APPEND | O_CLOEXEC, 0644);
    const ssize_t written = write(file, "x", 1);
    static_cast<void>(written);
    close(file);
  }
  return true;
}

template <typename Function>
Function* Next(const char* name) {
  return reinterpret_cast<Function*>(dlsym(RTLD_NEXT, name));
}

int Sync(const char* name, int file) {
  const bool watched = IsWatched(file);
  const long number = watched ? ++syncs : 0;
  if (watched && Fails(number, ThePlan().fail_sync)) {
    errno = EIO;
    return -1;
  }
  if (watched && ThePlan().slow_sync > 0) {
    usleep(static_cast<useconds_t>(ThePlan().slow_sync));
  }
  revisit::faults::RecordSyncBegin(file);
  const int result = Next<int(int)>(name)(file);
  if (result == 0) revisit::faults::RecordSyncEnd(file);
  if (watched && number == ThePlan().kill_sync) kill(getpid(), SIGKILL);
  return result;
}

bool WriteFails(int file) {
  if (ThePlan().fail_write == 0 || !IsWatched(file)) return false;
  if (!Fails(++writes, ThePlan().fail_write)) return false;
  errno = ENOSPC;
  return true;
}

template <typename Offset>
ssize_t WriteAt(const char* name, int file, const void* data, size_t size,
                Offset offset) {
  if (WriteFails(file)) return -1;
  Recording recording(file);
  const ssize_t written = Next<ssize_t(int, const void*, size_t, Offset)>(name)(
      file, data, size, offset);
  recording.Wrote(file, data, written, offset);
  return written;
}

template <typename Offset>
int Truncate(const char* name, int file, Offset size) {
  Recording recording(file);
  const int result = Next<int(int, Offset)>(name)(file, size);
  if (result == 0) recording.SizeBecame(file);
  return result;
}

template <typename Offset>
int Allocate(const char* name, int file, Offset offset, Offset size) {
  Recording recording(file);
  const int result = Next<int(int, Offset, Offset)>(name)(file, offset, size);
  if (result == 0) recording.SizeBecame(file);
  return result;
}

int Open(const char* name, const char* path, int flags, mode_t mode) {
  const auto next = Next<int(const char*, int, ...)>(name);
  if ((flags & (O_CREAT | O_TRUNC)) == 0) return next(path, flags, mode);
  Recording recording(path);
  const int file = next(path, flags, mode);
  if (file >= 0) recording.Opened(file, flags);
  return file;
}

int Unlink(const char* name, const char* path) {
  Recording recording(path);
  const int result = Next<int(const char*)>(name)(path);
  if (result == 0) recording.Unlinked();
  return result;
}

template <typename Offset>
void* Map(const char* name, void* at, size_t size, int protection, int flags,
          int file, Offset offset) {
  const auto next = Next<void*(void*, size_t, int, int, int, Offset)>(name);
  if (file < 0 || (flags & MAP_SHARED) == 0 || (protection & PROT_WRITE) == 0) {
    return next(at, size, protection, flags, file, offset);
  }
  Recording recording(file);
  void* const memory = next(at, size, protection, flags, file, offset);
  if (memory != MAP_FAILED) recording.Mapped(file, memory, size, offset);
  return memory;
}

}  // namespace

extern "C" {

int fsync(int file) { return Sync("fsync", file); }
int fdatasync(int file) { return Sync("fdatasync", file); }

ssize_t pwrite(int file, const void* data, size_t size, off_t offset) {
  return WriteAt("pwrite", file, data, size, offset);
}

ssize_t pwrite64(int file, const void* data, size_t size, off64_t offset) {
  return WriteAt("pwrite64", file, data, size, offset);
}

ssize_t write(int file, const void* data, size_t size) {
  Recording recording(file);
  const ssize_t written =
      Next<ssize_t(int, const void*, size_t)>("write")(file, data, size);
  if (recording.is_active()) {
    recording.Wrote(file, data, written, lseek(file, 0, SEEK_CUR) - written);
  }
  return written;
}

int ftruncate(int file, off_t size) noexcept {
  return Truncate("ftruncate", file, size);
}

int ftruncate64(int file, off64_t size) noexcept {
  return Truncate("ftruncate64", file, size);
}

int posix_fallocate(int file, off_t offset, off_t size) {
  return Allocate("posix_fallocate", file, offset, size);
}

int posix_fallocate64(int file, off64_t offset, off64_t size) {
  return Allocate("posix_fallocate64", file, offset, size);
}

int open(const char* path, int flags, ...) {
  va_list rest;
  va_start(rest, flags);
  const mode_t mode = va_arg(rest, mode_t);
  va_end(rest);
  return Open("open", path, flags, mode);
}

int open64(const char* path, int flags, ...) {
  va_list rest;
  va_start(rest, flags);
  const mode_t mode = va_arg(rest, mode_t);
  va_end(rest);
  return Open("open64", path, flags, mode);
}

// The C library's own opens the file by a call that nobody can stand before.
int mkstemp(char* pattern) {
  static std::atomic<unsigned> next{static_cast<unsigned>(getpid())};
  constexpr unsigned kNames = 1000000;
  char* const suffix = pattern + strlen(pattern) - strlen("XXXXXX");
  for (unsigned tries = 0; tries < kNames; ++tries) {
    snprintf(suffix, strlen("XXXXXX") + 1, "%06u", next++ % kNames);
    const int file = open64(pattern, O_RDWR | O_CREAT | O_EXCL, 0600);
    if (file >= 0 || errno != EEXIST) return file;
  }
  return -1;
}
int mkstemp64(char* pattern) { return mkstemp(pattern); }

int mkdir(const char* path, mode_t mode) noexcept {
  Recording recording(path);
  const int result = Next<int(const char*, mode_t)>("mkdir")(path, mode);
  if (result == 0) recording.MadeDirectory();
  return result;
}

int unlink(const char* path) noexcept { return Unlink("unlink", path); }
int rmdir(const char* path) noexcept { return Unlink("rmdir", path); }
int remove(const char* path) noexcept { return Unlink("remove", path); }

int link(const char* path, const char* other) noexcept {
  Recording recording(path);
  const int result = Next<int(const char*, const char*)>("link")(path, other);
  if (result == 0) recording.Linked(other);
  return result;
}

int rename(const char* path, const char* other) noexcept {
  Recording recording(path);
  const int result = Next<int(const char*, const char*)>("rename")(path, other);
  if (result == 0) recording.RenamedTo(other);
  return result;
}

void* mmap(void* at, size_t size, int protection, int flags, int file,
           off_t offset) noexcept {
  return Map("mmap", at, size, protection, flags, file, offset);
}

void* mmap64(void* at, size_t size, int protection, int flags, int file,
             off64_t offset) noexcept {
  return Map("mmap64", at, size, protection, flags, file, offset);
}

int munmap(void* memory, size_t size) noexcept {
  revisit::faults::ForgetMapped(memory);
  return Next<int(void*, size_t)>("munmap")(memory, size);
}

}  // extern "C"
