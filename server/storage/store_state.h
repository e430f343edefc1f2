// Which store a file belongs to, and how far it goes.
//
// Every commit has a number and writes it into the database, so the log has it
// too; the mark and the lock hold it as of the last commit they know of. So of
// files that lie beside each other it can be told whether they belong together:
// one that is missing, older than the others, or of another store is seen
// before SQLite puts them together.
#ifndef REVISIT_SERVER_STORAGE_STORE_STATE_H_
#define REVISIT_SERVER_STORAGE_STORE_STATE_H_

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"

namespace revisit::server {

class SqliteDatabase;

using StoreId = std::array<unsigned char, 16>;

struct StoreState {
  // Random, made with the store. A backup keeps it.
  StoreId id{};
  // Number of the commit that wrote this: 1, 2, ...
  std::uint64_t commit = 0;
  // Random, of the server process that made the commit: two stores that went on
  // from copies of one have commits of equal numbers, but never of equal runs.
  std::uint64_t run = 0;
  // That of the commit before; 0 of the first.
  std::uint64_t previous_run = 0;
  // Whether the database alone is the whole store: the last commit of an
  // orderly end, and of a backup.
  bool is_closed = false;
};

inline bool IsSameCommit(const StoreState& a, const StoreState& b) {
  return a.id == b.id && a.commit == b.commit && a.run == b.run;
}

std::uint64_t RandomRun();

// Of a store that is made now.
StoreState FirstState(std::uint64_t run);
// Of the commit after `state`.
StoreState NextState(const StoreState& state, std::uint64_t run,
                     bool is_closed);

// As it stands in a file: 8 bytes that tell what it is, the members in their
// order, integers as 8 bytes little-endian, then XXH3 of what is before. The
// size never changes, so that SQLite writes it in place.
inline constexpr std::size_t kStateBytes = 64;
std::string Encoded(const StoreState& state);
// Nothing if the bytes, kStateBytes of them, are no whole state.
std::optional<StoreState> DecodeState(const unsigned char* bytes);

// The state that a page of a database holds, if it is the one that does: the
// row is alone in its table, so it ends where the page ends.
std::optional<StoreState> StateInPage(const unsigned char* page,
                                      std::size_t page_bytes);

// "commit 12 of store 00ff...".
std::string ToText(const StoreState& state);

// The row of the table `store`, within the transaction of the connection.
// DATA_LOSS (STORE_CORRUPT) if it is not there or not whole.
absl::StatusOr<StoreState> ReadState(SqliteDatabase& database);
absl::Status WriteState(SqliteDatabase& database, const StoreState& state);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_STORE_STATE_H_
