// Facts that a storage (storage.h) tells of itself, for callers.
#ifndef REVISIT_SERVER_STORAGE_STORAGE_FACTS_H_
#define REVISIT_SERVER_STORAGE_STORAGE_FACTS_H_

#include <cstdint>
#include <string>

namespace revisit::server {

// The harm that an acknowledged write survives.
struct Durability {
  enum class Level {
    // A crash of the process, but not the loss of power.
    kNone,
    // Everything but the loss of the machine that keeps the store.
    kLocal,
    // The loss of one machine too.
    kReplicated,
  };
  Level level = Level::kLocal;
  // The settings that decide it, for operators; empty where nothing does.
  std::string details = std::string();
};

// A server that shares a storage with others.
struct StorageUser {
  std::string address;
  // The storage's last word: in PostgreSQL, that of the last beat.
  std::int64_t owned_vehicles = 0;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_STORAGE_FACTS_H_
