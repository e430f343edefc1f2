// A small HTTP server: it answers GET and HEAD, in plaintext, on one thread.
//
// All its connections are read and written without blocking, so one that is
// slow holds up none of the others, and there are never more than
// kMostHttpConnections: a new one takes the place of the oldest.
#ifndef REVISIT_SERVER_ADMIN_HTTP_SERVER_H_
#define REVISIT_SERVER_ADMIN_HTTP_SERVER_H_

#include <cstddef>
#include <functional>
#include <memory>
#include <string>

#include "absl/status/statusor.h"

namespace revisit::server {

inline constexpr std::size_t kMostHttpConnections = 64;

struct HttpResponse {
  int status = 200;
  std::string body;
  std::string content_type = "text/plain; charset=utf-8";
};

class HttpServer {
 public:
  // Answers a path, which comes without its query. Called on the server's
  // thread, one call at a time.
  using Handler = std::function<HttpResponse(const std::string& path)>;

  // Serves from then on. `address` is HOST:PORT or [V6]:PORT; port 0 takes a
  // free one. INVALID_ARGUMENT if it is malformed, UNAVAILABLE with the reason
  // if it cannot be listened on.
  static absl::StatusOr<std::unique_ptr<HttpServer>> Listen(
      const std::string& address, Handler handler);
  // Closes all connections; the handler is not called any more.
  ~HttpServer();

  HttpServer(const HttpServer&) = delete;
  HttpServer& operator=(const HttpServer&) = delete;

  // The address with the port that was chosen.
  const std::string& address() const { return address_; }

 private:
  class State;
  HttpServer(std::string address, std::unique_ptr<State> state);

  const std::string address_;
  const std::unique_ptr<State> state_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_ADMIN_HTTP_SERVER_H_
