// What revisitd does with a store besides serving it: backup, verify and
// compact.
#ifndef REVISIT_SERVER_STORE_TASKS_H_
#define REVISIT_SERVER_STORE_TASKS_H_

#include "server/exit_code.h"
#include "server/settings/settings.h"

namespace revisit::server {

// Prints what it found to standard output and what failed to standard error.
// All are processes of their own, so that whoever may read the files may do it,
// nobody else, and also if no server runs. Backup and verify read beside a
// server and change nothing; compact writes, and wants the store for itself.
ExitCode RunStoreTask(const ServerSettings& settings, const StoreTask& task);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORE_TASKS_H_
