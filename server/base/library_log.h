// Routes the logs of gRPC and protobuf into the server's log.
#ifndef REVISIT_SERVER_BASE_LIBRARY_LOG_H_
#define REVISIT_SERVER_BASE_LIBRARY_LOG_H_

#include "server/base/logging.h"

namespace revisit::server {

// Sends what gRPC and protobuf log to `log` for as long as it lives. Both
// libraries know one destination per process, so there is one route at a time.
class LibraryLogRoute {
 public:
  explicit LibraryLogRoute(const Log* log);
  ~LibraryLogRoute();

  LibraryLogRoute(const LibraryLogRoute&) = delete;
  LibraryLogRoute& operator=(const LibraryLogRoute&) = delete;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_BASE_LIBRARY_LOG_H_
