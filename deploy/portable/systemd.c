// The two functions of libsystemd that revisitd calls, for programs that run with and
// without systemd: they ask the libsystemd of the machine, and where it has none there is
// no service manager to tell. Debian has no archive of libsystemd.
#include <dlfcn.h>
#include <stdint.h>

// Answers a function of libsystemd, which stays open; null without one.
static void* Find(const char* name) {
  void* library = dlopen("libsystemd.so.0", RTLD_NOW);
  return library == 0 ? 0 : dlsym(library, name);
}

int sd_notify(int unset_environment, const char* state) {
  int (*notify)(int, const char*) =
      (int (*)(int, const char*))Find("sd_notify");
  return notify == 0 ? 0 : notify(unset_environment, state);
}

int sd_watchdog_enabled(int unset_environment, uint64_t* microseconds) {
  int (*enabled)(int, uint64_t*) =
      (int (*)(int, uint64_t*))Find("sd_watchdog_enabled");
  return enabled == 0 ? 0 : enabled(unset_environment, microseconds);
}
