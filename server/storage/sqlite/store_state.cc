#include "server/storage/sqlite/store_state.h"

#include <cstring>
#include <random>

#include "server/base/status.h"
#include "server/storage/sqlite/sqlite_database.h"
#include "xxhash.h"

namespace revisit::server {
namespace {

constexpr char kStateMagic[] = "RVSTATE3";
constexpr std::size_t kStateMagicBytes = 8;
constexpr std::size_t kChecksumAt = kStateBytes - 8;

void Put(std::uint64_t value, unsigned char* at) {
  for (std::size_t i = 0; i < 8; ++i) {
    at[i] = static_cast<unsigned char>(value >> (8 * i));
  }
}

std::uint64_t Get(const unsigned char* at) {
  std::uint64_t value = 0;
  for (std::size_t i = 8; i > 0; --i) value = value << 8 | at[i - 1];
  return value;
}

absl::Status NoState() {
  return Error(absl::StatusCode::kDataLoss, "STORE_CORRUPT",
               "the table that says which store this is has no whole row");
}

}  // namespace

std::uint64_t RandomRun() {
  std::random_device device;
  return std::uint64_t{device()} << 32 | device();
}

StoreState FirstState(std::uint64_t run) {
  StoreState state;
  for (std::size_t i = 0; i < state.id.size(); i += 8) {
    Put(RandomRun(), state.id.data() + i);
  }
  state.commit = 1;
  state.run = run;
  state.is_closed = true;
  return state;
}

StoreState NextState(const StoreState& state, std::uint64_t run,
                     bool is_closed) {
  StoreState next = state;
  ++next.commit;
  next.previous_run = state.run;
  next.run = run;
  next.is_closed = is_closed;
  return next;
}

std::string Encoded(const StoreState& state) {
  std::array<unsigned char, kStateBytes> bytes;
  unsigned char* at = bytes.data();
  std::memcpy(at, kStateMagic, kStateMagicBytes);
  at += kStateMagicBytes;
  std::memcpy(at, state.id.data(), state.id.size());
  at += state.id.size();
  for (const std::uint64_t value : {state.commit, state.run, state.previous_run,
                                    std::uint64_t{state.is_closed ? 1u : 0u}}) {
    Put(value, at);
    at += 8;
  }
  Put(XXH3_64bits(bytes.data(), kChecksumAt), at);
  return std::string(reinterpret_cast<const char*>(bytes.data()), bytes.size());
}

std::optional<StoreState> DecodeState(const unsigned char* bytes) {
  if (std::memcmp(bytes, kStateMagic, kStateMagicBytes) != 0 ||
      Get(bytes + kChecksumAt) != XXH3_64bits(bytes, kChecksumAt)) {
    return std::nullopt;
  }
  StoreState state;
  const unsigned char* at = bytes + kStateMagicBytes;
  std::memcpy(state.id.data(), at, state.id.size());
  at += state.id.size();
  state.commit = Get(at);
  state.run = Get(at + 8);
  state.previous_run = Get(at + 16);
  state.is_closed = Get(at + 24) != 0;
  return state;
}

std::optional<StoreState> StateInPage(const unsigned char* page,
                                      std::size_t page_bytes) {
  return DecodeState(page + page_bytes - kStateBytes);
}

std::string ToText(const StoreState& state) {
  constexpr char kDigits[] = "0123456789abcdef";
  std::string id;
  for (const unsigned char byte : state.id) {
    id += kDigits[byte >> 4];
    id += kDigits[byte & 15];
  }
  return "commit " + std::to_string(state.commit) + " of store " + id;
}

absl::StatusOr<StoreState> ReadState(SqliteDatabase& database) {
  SqliteStatement row = database.Prepare("SELECT state FROM store");
  const absl::StatusOr<bool> found = row.Step();
  if (!found.ok()) return found.status();
  if (!*found) return NoState();
  const std::string bytes = row.Bytes(0);
  if (bytes.size() != kStateBytes) return NoState();
  const std::optional<StoreState> state =
      DecodeState(reinterpret_cast<const unsigned char*>(bytes.data()));
  if (!state) return NoState();
  return *state;
}

absl::Status WriteState(SqliteDatabase& database, const StoreState& state) {
  const std::string bytes = Encoded(state);
  return database
      .Prepare("INSERT OR REPLACE INTO store (key, state) VALUES (1, ?1)")
      .BindBlob(1, bytes)
      .Run();
}

}  // namespace revisit::server
