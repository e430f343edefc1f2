// The tasks that revisitd does with a store besides serving it: backup, verify,
// compact, migrate and import.
#ifndef REVISIT_SERVER_STORAGE_ENGINES_STORE_TASKS_H_
#define REVISIT_SERVER_STORAGE_ENGINES_STORE_TASKS_H_

#include "server/base/exit_code.h"
#include "server/settings/settings.h"

namespace revisit::server {

// Runs a task, prints findings to standard output and failures to standard
// error. Each task is a process of its own: it needs no server, only the right
// to read the files, or the database. Backup and verify read beside a server
// and change nothing; compact writes, and needs the store for itself; migrate
// changes tables that servers may be using, so that they can go on.
ExitCode RunStoreTask(const ServerSettings& settings, const StoreTask& task);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_ENGINES_STORE_TASKS_H_
