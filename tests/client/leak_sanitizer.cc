// Tells leak sanitizer what it has to know; linked into `revisit` in builds
// with sanitizers only.

// gRPC opens and closes connections on threads of its own. A command that has
// come to its end does not wait for them, so what a handshake or the look-up of
// a name holds at that moment is freed by the end of the process alone.
extern "C" const char* __lsan_default_suppressions();
extern "C" const char* __lsan_default_suppressions() {
  return "leak:libcares.so\n"
         "leak:libcrypto.so\n"
         "leak:libssl.so\n";
}
