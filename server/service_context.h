// What the handlers of the service share.
#ifndef REVISIT_SERVER_SERVICE_CONTEXT_H_
#define REVISIT_SERVER_SERVICE_CONTEXT_H_

#include <cstdint>

namespace revisit::server {

class Drain;
class Executor;
class Fleet;
class Gatekeeper;
class Log;
class Storage;

// See ServerSettings.
struct ServiceLimits {
  std::int64_t max_message_bytes = 0;
  int max_batch_poses = 0;
  int max_batches_in_flight = 0;
  std::int64_t max_bytes_in_flight = 0;
  std::int64_t max_revision_bytes = 0;
};

// All outlive the calls.
struct ServiceContext {
  Storage* storage = nullptr;
  // Where what reads the store runs.
  Executor* executor = nullptr;
  Fleet* fleet = nullptr;
  Drain* drain = nullptr;
  Gatekeeper* gatekeeper = nullptr;
  const Log* log = nullptr;
  ServiceLimits limits;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SERVICE_CONTEXT_H_
