#include "server/storage/engines/engine.h"
#include "server/storage/engines/postgres_engine.h"
#include "server/storage/engines/sqlite_engine.h"

namespace revisit::server {
namespace {

using GetEngine = const StorageEngine& (*)();

// The first that a store's name fits has it: any name is that of a file.
constexpr GetEngine kEngines[] = {PostgresEngine, SqliteEngine};

}  // namespace

const StorageEngine& EngineOf(const std::string& store) {
  for (const GetEngine engine : kEngines) {
    if (engine().Names(store)) return engine();
  }
  return SqliteEngine();
}

}  // namespace revisit::server
