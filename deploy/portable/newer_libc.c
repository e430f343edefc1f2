// What the libraries and programs call of C libraries newer than 2.31, for machines whose
// own is older. Each answers as glibc does where it cannot do better.
#define _GNU_SOURCE
#include <dlfcn.h>
#include <malloc.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <unistd.h>

// glibc 2.32. False promises nothing: libstdc++ then counts references atomically.
char __libc_single_threaded = 0;

// glibc 2.36, which aborts too where the kernel has no randomness to give.
void arc4random_buf(void* buffer, size_t size) {
  unsigned char* bytes = buffer;
  while (size > 0) {
    // The most that getentropy() gives at a time.
    const size_t count = size < 256 ? size : 256;
    if (getentropy(bytes, count) != 0) abort();
    bytes += count;
    size -= count;
  }
}

uint32_t arc4random(void) {
  uint32_t number;
  arc4random_buf(&number, sizeof number);
  return number;
}

// glibc 2.33: asked where the machine has it. The older mallinfo() counts in 32 bits, so
// there the counts of a server with more than 4 GiB are too low.
struct mallinfo2 mallinfo2(void) {
  struct mallinfo2 (*newer)(void) =
      (struct mallinfo2(*)(void))dlsym(RTLD_NEXT, "mallinfo2");
  if (newer != 0) return newer();
#pragma GCC diagnostic ignored "-Wdeprecated-declarations"
  const struct mallinfo older = mallinfo();
  const struct mallinfo2 widened = {
      .arena = (unsigned)older.arena,       .ordblks = (unsigned)older.ordblks,
      .smblks = (unsigned)older.smblks,     .hblks = (unsigned)older.hblks,
      .hblkhd = (unsigned)older.hblkhd,     .usmblks = (unsigned)older.usmblks,
      .fsmblks = (unsigned)older.fsmblks,   .uordblks = (unsigned)older.uordblks,
      .fordblks = (unsigned)older.fordblks, .keepcost = (unsigned)older.keepcost};
  return widened;
}
