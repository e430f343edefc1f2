// Reads SQLite's write-ahead log before SQLite does.
//
// SQLite takes the log up to the first frame that fails its checksum, and
// silently ignores the rest: after a crash, that is the end of an unfinished
// write. But one flipped bit in the middle would silently drop every commit
// behind it. So the log is read here too, and beyond such a frame.
//
// The two cases differ in this: each commit is flushed before the next one is
// written, so a crash leaves only one transaction unfinished, the last. If
// frames of this log follow that begin another transaction, the bad frame was
// flushed once and has been damaged since. Frames of an older use of the file
// have other salts. Power may be lost in the middle of a frame: if a frame
// fails its checksum, only those of its bytes are believed that share a sector
// with its salts.
//
// The format is that of https://www.sqlite.org/fileformat2.html#walformat.
#ifndef REVISIT_SERVER_STORAGE_SQLITE_WRITE_AHEAD_LOG_H_
#define REVISIT_SERVER_STORAGE_SQLITE_WRITE_AHEAD_LOG_H_

#include <cstddef>
#include <cstdint>
#include <functional>
#include <set>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/storage/sqlite/store_state.h"

namespace revisit::server {

// A place in the log. The salts distinguish one use of the file from the next:
// the first grows by one each time SQLite starts over at the beginning.
struct LogPosition {
  std::uint32_t salt1 = 0;
  std::uint32_t salt2 = 0;
  std::uint32_t frames = 0;
};

inline bool operator==(const LogPosition& a, const LogPosition& b) {
  return a.salt1 == b.salt1 && a.salt2 == b.salt2 && a.frames == b.frames;
}

struct LogReport {
  // Whether there is a header that SQLite would take; without one it takes
  // nothing of the log.
  bool has_header = false;
  // The end of the last commit that SQLite takes.
  LogPosition end;
  std::uint32_t page_bytes = 0;
  // Number of whole frames for which the file has room, whatever they hold.
  std::uint32_t frames_in_file = 0;
  // Whether something follows `end` that is not the rest of an older use.
  bool has_unfinished_tail = false;
  // States of the store that the commits up to `end` hold, in their order.
  // Empty for a store of format 1 or 2.
  std::vector<StoreState> states;
  // Where flushed frames fail their checksum; empty if none is known to fail.
  std::string damage;
};

// Reads a log. A missing file is an empty log. UNAVAILABLE if the file cannot
// be read.
absl::StatusOr<LogReport> ReadLog(const std::string& path);

// Numbers of the pages that the log holds up to `log.end`.
absl::StatusOr<std::set<std::uint32_t>> PagesIn(const std::string& path,
                                                const LogReport& log);

// A row of a table as it stands in the log, with the columns before its
// payload.
struct LoggedRow {
  enum class Table { kVehicles, kBatches, kPairs };
  Table table;
  std::int64_t vehicle_key = 0;     // Unset for kVehicles.
  std::string id;                   // Unset for kBatches.
  std::int64_t first_sequence = 0;  // Set for kBatches only.
  std::int64_t checksum = 0;
};

// Visits all rows in frames behind `log.end` that look like rows of a store. A
// damaged row may look like another one, or like none.
absl::Status VisitRowsBehind(
    const std::string& path, const LogReport& log,
    const std::function<void(const LoggedRow&)>& visit);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_SQLITE_WRITE_AHEAD_LOG_H_
