#include "server/admin/http_server.h"

#include <pthread.h>

#include <boost/asio/io_context.hpp>
#include <boost/asio/ip/tcp.hpp>
#include <boost/asio/steady_timer.hpp>
#include <boost/beast/core/flat_buffer.hpp>
#include <boost/beast/core/tcp_stream.hpp>
#include <boost/beast/http.hpp>
#include <boost/system/system_error.hpp>
#include <chrono>
#include <cstdint>
#include <list>
#include <optional>
#include <thread>
#include <utility>

#include "absl/status/status.h"
#include "absl/strings/str_cat.h"
#include "server/base/listen_address.h"

namespace revisit::server {
namespace {

namespace asio = boost::asio;
namespace http = boost::beast::http;
using boost::beast::error_code;
using tcp = asio::ip::tcp;

// Bytes of a request, which has no body.
constexpr std::uint32_t kMaxRequestBytes = 8 << 10;
// How long a connection may take to bring a request, or be idle before it, and
// to take the answer.
constexpr std::chrono::seconds kPatience{10};
// How long accepting rests after it has failed, as for want of descriptors.
constexpr std::chrono::milliseconds kAcceptDelay{100};

std::string TextOf(const tcp::endpoint& endpoint) {
  const std::string host = endpoint.address().to_string();
  return endpoint.address().is_v6()
             ? absl::StrCat("[", host, "]:", endpoint.port())
             : absl::StrCat(host, ":", endpoint.port());
}

class Connection;
using Connections = std::list<std::shared_ptr<Connection>>;

// Reads requests and answers them, one after the other. It is alive as long as
// an operation of it is under way.
class Connection : public std::enable_shared_from_this<Connection> {
 public:
  Connection(tcp::socket socket, const HttpServer::Handler* handler,
             Connections* all)
      : stream_(std::move(socket)), handler_(handler), all_(all) {}

  void Start() {
    place_ = all_->insert(all_->end(), shared_from_this());
    Read();
  }

  // Ends the operation that is under way, and so the connection.
  void Cut() { stream_.close(); }

 private:
  void Read() {
    parser_.emplace();
    parser_->header_limit(kMaxRequestBytes);
    parser_->body_limit(0);
    stream_.expires_after(kPatience);
    http::async_read(
        stream_, buffer_, *parser_,
        [self = shared_from_this()](error_code error, std::size_t) {
          self->OnRead(error);
        });
  }

  void OnRead(error_code error) {
    if (!error) {
      Write(Answer(), parser_->keep_alive());
    } else if (error == http::error::header_limit ||
               error == http::error::buffer_overflow) {
      Write({431, "the request is too long\n"}, false);
    } else if (error.category() ==
                   make_error_code(http::error::bad_method).category() &&
               error != http::error::end_of_stream &&
               error != http::error::partial_message) {
      Write({400, absl::StrCat("malformed request: ", error.message(), "\n")},
            false);
    } else {
      End();
    }
  }

  HttpResponse Answer() const {
    const auto& request = parser_->get();
    if (request.method() != http::verb::get &&
        request.method() != http::verb::head) {
      return {405, "GET and HEAD are answered\n"};
    }
    const std::string target(request.target());
    return (*handler_)(target.substr(0, target.find('?')));
  }

  void Write(HttpResponse answer, bool keep_alive) {
    response_.emplace(static_cast<http::status>(answer.status), 11,
                      std::move(answer.body));
    response_->set(http::field::content_type, answer.content_type);
    response_->set(http::field::cache_control, "no-store");
    if (answer.status == 405) response_->set(http::field::allow, "GET, HEAD");
    response_->keep_alive(keep_alive);
    response_->prepare_payload();
    // HEAD is answered with the header of what GET is answered with.
    if (parser_->get().method() == http::verb::head) response_->body().clear();
    stream_.expires_after(kPatience);
    http::async_write(
        stream_, *response_,
        [self = shared_from_this(), keep_alive](error_code error, std::size_t) {
          if (error || !keep_alive) {
            self->End();
          } else {
            self->Read();
          }
        });
  }

  void End() {
    error_code ignored;
    stream_.socket().shutdown(tcp::socket::shutdown_both, ignored);
    stream_.close();
    all_->erase(place_);
  }

  boost::beast::tcp_stream stream_;
  const HttpServer::Handler* const handler_;
  Connections* const all_;
  Connections::iterator place_;
  boost::beast::flat_buffer buffer_{kMaxRequestBytes};
  std::optional<http::request_parser<http::empty_body>> parser_;
  std::optional<http::response<http::string_body>> response_;
};

}  // namespace

// All but the constructor and the destructor runs on the thread.
class HttpServer::State {
 public:
  explicit State(Handler handler)
      : handler_(std::move(handler)), acceptor_(context_), pause_(context_) {}

  ~State() {
    context_.stop();
    if (thread_.joinable()) thread_.join();
  }

  error_code Open(const ListenAddress& address) {
    error_code error;
    const auto endpoints = tcp::resolver(context_).resolve(
        address.host, address.port, tcp::resolver::passive, error);
    if (error) return error;
    const tcp::endpoint endpoint = endpoints.begin()->endpoint();
    acceptor_.open(endpoint.protocol(), error);
    if (!error) acceptor_.set_option(tcp::acceptor::reuse_address(true), error);
    if (!error) acceptor_.bind(endpoint, error);
    if (!error) {
      acceptor_.listen(asio::socket_base::max_listen_connections, error);
    }
    return error;
  }

  tcp::endpoint local_endpoint() const {
    error_code ignored;
    return acceptor_.local_endpoint(ignored);
  }

  void Start() {
    Accept();
    thread_ = std::thread([this] { context_.run(); });
    pthread_setname_np(thread_.native_handle(), "admin");
  }

 private:
  void Accept() {
    acceptor_.async_accept([this](error_code error, tcp::socket socket) {
      OnAccept(error, std::move(socket));
    });
  }

  void OnAccept(error_code error, tcp::socket socket) {
    if (error) {
      pause_.expires_after(kAcceptDelay);
      pause_.async_wait([this](error_code) { Accept(); });
      return;
    }
    if (connections_.size() >= kMostHttpConnections) {
      const std::shared_ptr<Connection> oldest = connections_.front();
      // Moved back, in case the next one comes before this one has ended.
      connections_.splice(connections_.end(), connections_,
                          connections_.begin());
      oldest->Cut();
    }
    std::make_shared<Connection>(std::move(socket), &handler_, &connections_)
        ->Start();
    Accept();
  }

  const Handler handler_;
  asio::io_context context_{1};
  // Destroyed before the context, which all connections use.
  Connections connections_;
  tcp::acceptor acceptor_;
  asio::steady_timer pause_;
  std::thread thread_;
};

HttpServer::HttpServer(std::string address, std::unique_ptr<State> state)
    : address_(std::move(address)), state_(std::move(state)) {}

HttpServer::~HttpServer() = default;

absl::StatusOr<std::unique_ptr<HttpServer>> HttpServer::Listen(
    const std::string& address, Handler handler) {
  const absl::StatusOr<ListenAddress> parsed = ParseListenAddress(address);
  if (!parsed.ok()) return parsed.status();
  const auto cannot = [&](const error_code& error) {
    return absl::UnavailableError(
        absl::StrCat("cannot listen at ", address, ": ", error.message()));
  };
  std::unique_ptr<State> state;
  try {
    state = std::make_unique<State>(std::move(handler));
  } catch (const boost::system::system_error& error) {
    // There is no descriptor for it.
    return cannot(error.code());
  }
  if (const error_code error = state->Open(*parsed)) return cannot(error);
  std::string chosen = TextOf(state->local_endpoint());
  state->Start();
  return std::unique_ptr<HttpServer>(
      new HttpServer(std::move(chosen), std::move(state)));
}

}  // namespace revisit::server
