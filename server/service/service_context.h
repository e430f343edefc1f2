// The parts of the server that all handlers of the service share.
#ifndef REVISIT_SERVER_SERVICE_SERVICE_CONTEXT_H_
#define REVISIT_SERVER_SERVICE_SERVICE_CONTEXT_H_

#include <chrono>
#include <cstdint>
#include <optional>
#include <string>

#include "server/settings/limits.h"

namespace revisit::server {

class Admission;
class AuditLog;
class ServiceCounters;
class ConnectionMeters;
class Drain;
class EventFeed;
class Executor;
class ExportedGraphs;
class Fleet;
class Gatekeeper;
class GroupEditor;
class GroupSearches;
class Log;
class Storage;

// All of these outlive the calls.
struct ServiceContext {
  Storage* storage = nullptr;
  // Runs the work that reads the store.
  Executor* executor = nullptr;
  Fleet* fleet = nullptr;
  GroupEditor* groups = nullptr;
  GroupSearches* group_searches = nullptr;
  EventFeed* feed = nullptr;
  Drain* drain = nullptr;
  Gatekeeper* gatekeeper = nullptr;
  const Log* log = nullptr;
  Admission* admission = nullptr;
  ExportedGraphs* exported_graphs = nullptr;
  ServiceCounters* counts = nullptr;
  // Null if none is kept.
  const AuditLog* audit = nullptr;
  // From which on calls are logged as slow; nothing if none is.
  std::optional<std::chrono::steady_clock::duration> slow_call;
  // Directory of the drafts of revisions, and how much of its file system they
  // leave free.
  std::string scratch_directory;
  std::int64_t min_free_bytes = 0;
  ConnectionMeters* meters = nullptr;
  Limits limits;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SERVICE_SERVICE_CONTEXT_H_
