// What the handlers of the service share.
#ifndef REVISIT_SERVER_SERVICE_CONTEXT_H_
#define REVISIT_SERVER_SERVICE_CONTEXT_H_

#include "server/limits.h"

namespace revisit::server {

class Admission;
class ConnectionMeters;
class Drain;
class Executor;
class Fleet;
class Gatekeeper;
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
  ConnectionMeters* meters = nullptr;
  Limits limits;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SERVICE_CONTEXT_H_
