// What the handlers of the service share.
#ifndef REVISIT_SERVER_SERVICE_SERVICE_CONTEXT_H_
#define REVISIT_SERVER_SERVICE_SERVICE_CONTEXT_H_

#include <cstdint>
#include <string>

#include "server/settings/limits.h"

namespace revisit::server {

class Admission;
class ConnectionMeters;
class Drain;
class Executor;
class Fleet;
class Gatekeeper;
class GraphSnapshots;
class Log;
class Storage;

// All outlive the calls.
struct ServiceContext {
  Storage* storage = nullptr;
  // Where what reads the store runs.
  Executor* executor = nullptr;
  Fleet* fleet = nullptr;
  Drain* drain = nullptr;
  Gatekeeper* gatekeeper = nullptr;
  const Log* log = nullptr;
  Admission* admission = nullptr;
  GraphSnapshots* snapshots = nullptr;
  // Where a revision in the making lies, and how much of that file system it
  // leaves free.
  std::string scratch_directory;
  std::int64_t min_free_bytes = 0;
  ConnectionMeters* meters = nullptr;
  Limits limits;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SERVICE_SERVICE_CONTEXT_H_
