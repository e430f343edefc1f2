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
#include <dlfcn.h>
#include <fcntl.h>
#include <signal.h>
#include <unistd.h>

#include <atomic>
#include <cerrno>
#include <cstddef>
#include <cstdio>
#include <cstdlib>
#include <cstring>

namespace {

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
  const int result = Next<int(int)>(name)(file);
  if (watched && number == ThePlan().kill_sync) kill(getpid(), SIGKILL);
  return result;
}

bool WriteFails(int file) {
  if (ThePlan().fail_write == 0 || !IsWatched(file)) return false;
  if (!Fails(++writes, ThePlan().fail_write)) return false;
  errno = ENOSPC;
  return true;
}

}  // namespace

extern "C" {

int fsync(int file) { return Sync("fsync", file); }
int fdatasync(int file) { return Sync("fdatasync", file); }

ssize_t pwrite(int file, const void* data, size_t size, off_t offset) {
  if (WriteFails(file)) return -1;
  return Next<ssize_t(int, const void*, size_t, off_t)>("pwrite")(file, data,
                                                                  size, offset);
}

ssize_t pwrite64(int file, const void* data, size_t size, off64_t offset) {
  if (WriteFails(file)) return -1;
  return Next<ssize_t(int, const void*, size_t, off64_t)>("pwrite64")(
      file, data, size, offset);
}

}  // extern "C"
