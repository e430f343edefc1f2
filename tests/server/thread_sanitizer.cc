// Tells thread sanitizer what it has to know; linked into tests in which
// threads share statuses, and without effect in other builds.

// Statuses count their references in Abseil's library. Where that was built
// without the sanitizer, as Debian's is, the last reference to go seems to race
// with all that went before.
extern "C" const char* __tsan_default_suppressions();
extern "C" const char* __tsan_default_suppressions() {
  return "race:absl::*Status::Unref\n"
         "race:absl::*status_internal::Payload\n";
}
