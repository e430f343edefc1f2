// The state that says to which store a file belongs, and up to which commit.
//
// Every commit has a number and writes it into the database, so the log has it
// too; the mark and the lock hold the number of the last commit they know of.
// So a file that is missing, older than the others, or of another store is
// found before SQLite combines the files.
#ifndef REVISIT_SERVER_STORAGE_SQLITE_STORE_STATE_H_
#define REVISIT_SERVER_STORAGE_SQLITE_STORE_STATE_H_

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
  // Random identity, made with the store. A backup keeps it.
  StoreId id{};
  // Number of the commit that wrote this: 1, 2, ...
  std::uint64_t commit = 0;
  // Random number of the server process that made the commit: two stores that
  // continue copies of one have commits of equal numbers, but never of equal
  // runs.
  std::uint64_t run = 0;
  // Run of the commit before; 0 for the first commit.
  std::uint64_t previous_run = 0;
  // Whether the database alone is the whole store, as after the last commit of
  // an orderly end, or in a backup.
  bool is_closed = false;
};

inline bool IsSameCommit(const StoreState& a, const StoreState& b) {
  return a.id == b.id && a.commit == b.commit && a.run == b.run;
}

std::uint64_t RandomRun();

// The state of a new store.
StoreState FirstState(std::uint64_t run);
// The state of the commit after `state`.
StoreState NextState(const StoreState& state, std::uint64_t run,
                     bool is_closed);

// Size of a state in a file: 8 bytes that identify it, the members in their
// order, integers as 8 bytes little-endian, then XXH3 of the bytes before. The
// size never changes, so that SQLite writes a state in place.
inline constexpr std::size_t kStateBytes = 64;
std::string Encoded(const StoreState& state);
// Nullopt if the kStateBytes bytes are no whole state.
std::optional<StoreState> DecodeState(const unsigned char* bytes);

// The state in a page of a database, if that page holds it: the row is alone in
// its table, so it ends where the page ends.
std::optional<StoreState> StateInPage(const unsigned char* page,
                                      std::size_t page_bytes);

// Text such as "commit 12 of store 00ff...".
std::string ToText(const StoreState& state);

// Reads the row of the table `store`, within the transaction of the connection.
// DATA_LOSS (STORE_CORRUPT) if it is missing or not whole.
absl::StatusOr<StoreState> ReadState(SqliteDatabase& database);
absl::Status WriteState(SqliteDatabase& database, const StoreState& state);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_SQLITE_STORE_STATE_H_
