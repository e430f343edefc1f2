// A store in a database that servers share: the engine of storage/postgres.
#ifndef REVISIT_SERVER_STORAGE_ENGINES_POSTGRES_ENGINE_H_
#define REVISIT_SERVER_STORAGE_ENGINES_POSTGRES_ENGINE_H_

#include "server/storage/engines/engine.h"

namespace revisit::server {

const StorageEngine& PostgresEngine();

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_ENGINES_POSTGRES_ENGINE_H_
