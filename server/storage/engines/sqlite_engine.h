// A store in a file: the engine of storage/sqlite.
#ifndef REVISIT_SERVER_STORAGE_ENGINES_SQLITE_ENGINE_H_
#define REVISIT_SERVER_STORAGE_ENGINES_SQLITE_ENGINE_H_

#include "server/storage/engines/engine.h"

namespace revisit::server {

const StorageEngine& SqliteEngine();

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_ENGINES_SQLITE_ENGINE_H_
