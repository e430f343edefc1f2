// A layer between SQLite and the operating system whose device fails on demand.
#ifndef REVISIT_TESTS_SERVER_STORAGE_SQLITE_FAILING_DEVICE_H_
#define REVISIT_TESTS_SERVER_STORAGE_SQLITE_FAILING_DEVICE_H_

namespace revisit::server {

// Counts and breaks what happens to all files opened through it. One at a time,
// and it must outlive its files. Thread-safe.
class FailingDevice {
 public:
  FailingDevice();
  ~FailingDevice();

  FailingDevice(const FailingDevice&) = delete;
  FailingDevice& operator=(const FailingDevice&) = delete;

  // Name to give to SQLite.
  static const char* vfs();

  // From now on flushes fail, as on a broken device.
  void FailFlushes(bool fail);
  // From now on writes fail, as on a full one.
  void FailWrites(bool fail);
  // Flushes of the log that succeeded.
  int log_flushes() const;
  // From now on the next flush of a log waits until it is let go.
  void HoldLogFlush();
  void AwaitHeldLogFlush();
  void LetLogFlushGo();
};

}  // namespace revisit::server

#endif  // REVISIT_TESTS_SERVER_STORAGE_SQLITE_FAILING_DEVICE_H_
