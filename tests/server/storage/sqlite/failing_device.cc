#include "tests/server/storage/sqlite/failing_device.h"

#include <condition_variable>
#include <cstdlib>
#include <cstring>
#include <mutex>

#include "sqlite3.h"

namespace revisit::server {
namespace {

constexpr char kName[] = "failing-device";

struct Device {
  std::mutex mutex;
  std::condition_variable changed;
  bool fail_flushes = false;
  bool fail_writes = false;
  int log_flushes = 0;
  bool hold = false;
  bool held = false;
};

Device* device = nullptr;

struct File {
  sqlite3_file base;
  bool is_log;
  // Followed by the file of the layer below.
  sqlite3_file* below() { return reinterpret_cast<sqlite3_file*>(this + 1); }
};

File* Of(sqlite3_file* file) { return reinterpret_cast<File*>(file); }

sqlite3_vfs* Below(sqlite3_vfs* vfs) {
  return static_cast<sqlite3_vfs*>(vfs->pAppData);
}

int Write(sqlite3_file* file, const void* data, int size,
          sqlite3_int64 offset) {
  {
    const std::lock_guard<std::mutex> guard(device->mutex);
    if (device->fail_writes) return SQLITE_FULL;
  }
  sqlite3_file* below = Of(file)->below();
  return below->pMethods->xWrite(below, data, size, offset);
}

int Sync(sqlite3_file* file, int flags) {
  {
    std::unique_lock<std::mutex> lock(device->mutex);
    if (Of(file)->is_log && device->hold) {
      device->held = true;
      device->changed.notify_all();
      device->changed.wait(lock, [] { return !device->hold; });
      device->held = false;
    }
    if (device->fail_flushes) return SQLITE_IOERR_FSYNC;
    if (Of(file)->is_log) ++device->log_flushes;
  }
  sqlite3_file* below = Of(file)->below();
  return below->pMethods->xSync(below, flags);
}

int Close(sqlite3_file* file) {
  sqlite3_file* below = Of(file)->below();
  return below->pMethods->xClose(below);
}
int Read(sqlite3_file* file, void* data, int size, sqlite3_int64 offset) {
  sqlite3_file* below = Of(file)->below();
  return below->pMethods->xRead(below, data, size, offset);
}
int Truncate(sqlite3_file* file, sqlite3_int64 size) {
  sqlite3_file* below = Of(file)->below();
  return below->pMethods->xTruncate(below, size);
}
int FileSize(sqlite3_file* file, sqlite3_int64* size) {
  sqlite3_file* below = Of(file)->below();
  return below->pMethods->xFileSize(below, size);
}
int Lock(sqlite3_file* file, int level) {
  sqlite3_file* below = Of(file)->below();
  return below->pMethods->xLock(below, level);
}
int Unlock(sqlite3_file* file, int level) {
  sqlite3_file* below = Of(file)->below();
  return below->pMethods->xUnlock(below, level);
}
int CheckReservedLock(sqlite3_file* file, int* result) {
  sqlite3_file* below = Of(file)->below();
  return below->pMethods->xCheckReservedLock(below, result);
}
int FileControl(sqlite3_file* file, int operation, void* argument) {
  sqlite3_file* below = Of(file)->below();
  return below->pMethods->xFileControl(below, operation, argument);
}
int SectorSize(sqlite3_file* file) {
  sqlite3_file* below = Of(file)->below();
  return below->pMethods->xSectorSize(below);
}
int DeviceCharacteristics(sqlite3_file* file) {
  sqlite3_file* below = Of(file)->below();
  return below->pMethods->xDeviceCharacteristics(below);
}
int ShmMap(sqlite3_file* file, int page, int size, int extend,
           void volatile** result) {
  sqlite3_file* below = Of(file)->below();
  return below->pMethods->xShmMap(below, page, size, extend, result);
}
int ShmLock(sqlite3_file* file, int offset, int count, int flags) {
  sqlite3_file* below = Of(file)->below();
  return below->pMethods->xShmLock(below, offset, count, flags);
}
void ShmBarrier(sqlite3_file* file) {
  sqlite3_file* below = Of(file)->below();
  below->pMethods->xShmBarrier(below);
}
int ShmUnmap(sqlite3_file* file, int remove) {
  sqlite3_file* below = Of(file)->below();
  return below->pMethods->xShmUnmap(below, remove);
}

const sqlite3_io_methods kMethods = {
    /*iVersion=*/2,
    Close,
    Read,
    Write,
    Truncate,
    Sync,
    FileSize,
    Lock,
    Unlock,
    CheckReservedLock,
    FileControl,
    SectorSize,
    DeviceCharacteristics,
    ShmMap,
    ShmLock,
    ShmBarrier,
    ShmUnmap,
    /*xFetch=*/nullptr,
    /*xUnfetch=*/nullptr,
};

int Open(sqlite3_vfs* vfs, const char* name, sqlite3_file* file, int flags,
         int* out_flags) {
  file->pMethods = nullptr;
  Of(file)->is_log = (flags & SQLITE_OPEN_WAL) != 0;
  const int code =
      Below(vfs)->xOpen(Below(vfs), name, Of(file)->below(), flags, out_flags);
  if (code == SQLITE_OK) file->pMethods = &kMethods;
  return code;
}

sqlite3_vfs layer;

}  // namespace

FailingDevice::FailingDevice() {
  if (device != nullptr) std::abort();
  device = new Device;
  sqlite3_vfs* below = sqlite3_vfs_find(nullptr);
  layer = *below;
  layer.zName = kName;
  layer.szOsFile = static_cast<int>(sizeof(File)) + below->szOsFile;
  layer.pAppData = below;
  layer.xOpen = Open;
  // The other functions find nothing of their own in what they are given, but
  // must be given the layer below.
  layer.xDelete = [](sqlite3_vfs* vfs, const char* name, int sync) {
    return Below(vfs)->xDelete(Below(vfs), name, sync);
  };
  layer.xAccess = [](sqlite3_vfs* vfs, const char* name, int flags, int* out) {
    return Below(vfs)->xAccess(Below(vfs), name, flags, out);
  };
  layer.xFullPathname = [](sqlite3_vfs* vfs, const char* name, int size,
                           char* out) {
    return Below(vfs)->xFullPathname(Below(vfs), name, size, out);
  };
  layer.xRandomness = [](sqlite3_vfs* vfs, int size, char* out) {
    return Below(vfs)->xRandomness(Below(vfs), size, out);
  };
  layer.xSleep = [](sqlite3_vfs* vfs, int microseconds) {
    return Below(vfs)->xSleep(Below(vfs), microseconds);
  };
  sqlite3_vfs_register(&layer, 0);
}

FailingDevice::~FailingDevice() {
  sqlite3_vfs_unregister(&layer);
  delete device;
  device = nullptr;
}

const char* FailingDevice::vfs() { return kName; }

void FailingDevice::FailFlushes(bool fail) {
  const std::lock_guard<std::mutex> guard(device->mutex);
  device->fail_flushes = fail;
}

void FailingDevice::FailWrites(bool fail) {
  const std::lock_guard<std::mutex> guard(device->mutex);
  device->fail_writes = fail;
}

int FailingDevice::log_flushes() const {
  const std::lock_guard<std::mutex> guard(device->mutex);
  return device->log_flushes;
}

void FailingDevice::HoldLogFlush() {
  const std::lock_guard<std::mutex> guard(device->mutex);
  device->hold = true;
}

void FailingDevice::AwaitHeldLogFlush() {
  std::unique_lock<std::mutex> lock(device->mutex);
  device->changed.wait(lock, [] { return device->held; });
}

void FailingDevice::LetLogFlushGo() {
  const std::lock_guard<std::mutex> guard(device->mutex);
  device->hold = false;
  device->changed.notify_all();
}

}  // namespace revisit::server
