#include "server/admin/http_server.h"

#include <arpa/inet.h>
#include <netinet/in.h>
#include <sys/socket.h>
#include <sys/time.h>
#include <unistd.h>

#include <cstdlib>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "gmock/gmock.h"
#include "gtest/gtest.h"

namespace revisit::server {
namespace {

using ::testing::EndsWith;
using ::testing::HasSubstr;
using ::testing::Not;
using ::testing::StartsWith;

// A connection of a client that sends any bytes.
class Client {
 public:
  explicit Client(const std::string& address)
      : descriptor_(socket(AF_INET, SOCK_STREAM, 0)) {
    const timeval limit = {20, 0};
    setsockopt(descriptor_, SOL_SOCKET, SO_RCVTIMEO, &limit, sizeof(limit));
    sockaddr_in to{};
    to.sin_family = AF_INET;
    to.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    to.sin_port = htons(static_cast<std::uint16_t>(
        std::atoi(address.substr(address.rfind(':') + 1).c_str())));
    EXPECT_EQ(
        connect(descriptor_, reinterpret_cast<sockaddr*>(&to), sizeof(to)), 0);
  }
  ~Client() { close(descriptor_); }

  Client(const Client&) = delete;
  Client& operator=(const Client&) = delete;

  void Send(const std::string& bytes) const {
    // The server may have closed the connection.
    (void)send(descriptor_, bytes.data(), bytes.size(), MSG_NOSIGNAL);
  }

  // All that comes until the server closes the connection.
  std::string ReadAll() const { return ReadUntil(""); }

  // What comes up to `end`.
  std::string ReadUntil(const std::string& end) const {
    std::string text;
    char byte;
    while (recv(descriptor_, &byte, 1, 0) == 1) {
      text += byte;
      if (!end.empty() && text.size() >= end.size() &&
          text.compare(text.size() - end.size(), end.size(), end) == 0) {
        break;
      }
    }
    return text;
  }

 private:
  const int descriptor_;
};

std::string Get(const std::string& path) {
  return "GET " + path + " HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n";
}

class HttpServerTest : public testing::Test {
 protected:
  HttpServerTest() {
    auto listening =
        HttpServer::Listen("127.0.0.1:0", [](const std::string& path) {
          return path == "/found" ? HttpResponse{200, "here\n"}
                                  : HttpResponse{404, "not " + path + "\n"};
        });
    EXPECT_TRUE(listening.ok()) << listening.status();
    server_ = *std::move(listening);
  }

  std::string Answer(const std::string& request) const {
    const Client client(server_->address());
    client.Send(request);
    return client.ReadAll();
  }

  std::unique_ptr<HttpServer> server_;
};

TEST_F(HttpServerTest, AnswersAPathWithoutItsQuery) {
  const std::string answer = Answer(Get("/found?a=b"));
  EXPECT_THAT(answer, StartsWith("HTTP/1.1 200 OK\r\n"));
  EXPECT_THAT(answer, HasSubstr("\r\nContent-Length: 5\r\n"));
  EXPECT_THAT(answer, EndsWith("\r\n\r\nhere\n"));
  EXPECT_THAT(Answer(Get("/lost")), StartsWith("HTTP/1.1 404 "));
}

TEST_F(HttpServerTest, AnswersHeadWithTheHeaderOfGet) {
  const std::string answer =
      Answer("HEAD /found HTTP/1.1\r\nConnection: close\r\n\r\n");
  EXPECT_THAT(answer, StartsWith("HTTP/1.1 200 OK\r\n"));
  EXPECT_THAT(answer, HasSubstr("\r\nContent-Length: 5\r\n"));
  EXPECT_THAT(answer, EndsWith("\r\n\r\n"));
}

TEST_F(HttpServerTest, AnswersOneRequestAfterTheOtherOnOneConnection) {
  const Client client(server_->address());
  for (int i = 0; i < 3; ++i) {
    client.Send("GET /found HTTP/1.1\r\nHost: x\r\n\r\n");
    EXPECT_THAT(client.ReadUntil("here\n"), StartsWith("HTTP/1.1 200 "));
  }
}

TEST_F(HttpServerTest, RefusesOtherMethods) {
  const std::string answer =
      Answer("DELETE /found HTTP/1.1\r\nConnection: close\r\n\r\n");
  EXPECT_THAT(answer, StartsWith("HTTP/1.1 405 "));
  EXPECT_THAT(answer, HasSubstr("\r\nAllow: GET, HEAD\r\n"));
}

TEST_F(HttpServerTest, RefusesWhatIsNoRequest) {
  for (const std::string& request :
       {std::string("PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"),
        std::string("\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03", 11) +
            std::string(64, '\0'),
        std::string("GET\r\n\r\n"), std::string("GET / HTTP/9.9\r\n\r\n"),
        std::string("GET / HTTP/1.1\r\nA\0B: c\r\n\r\n", 25),
        std::string("POST / HTTP/1.1\r\nContent-Length: x\r\n\r\n"),
        std::string("GET / HTTP/1.1\r\nContent-Length: 5\r\n\r\nabcde")}) {
    EXPECT_THAT(Answer(request), StartsWith("HTTP/1.1 400 ")) << request;
  }
  EXPECT_THAT(Answer(Get("/found")), StartsWith("HTTP/1.1 200 "));
}

TEST_F(HttpServerTest, RefusesARequestThatIsTooLong) {
  EXPECT_THAT(Answer(Get("/" + std::string(10'000, 'a'))),
              StartsWith("HTTP/1.1 431 "));
}

TEST_F(HttpServerTest, ConnectionsThatSendNothingHoldUpNobody) {
  std::vector<std::unique_ptr<Client>> silent;
  for (std::size_t i = 0; i < 3 * kMostHttpConnections; ++i) {
    silent.push_back(std::make_unique<Client>(server_->address()));
    if (i % 2 == 1) silent.back()->Send("GET /fou");
  }
  EXPECT_THAT(Answer(Get("/found")), EndsWith("here\n"));
  // The first made room for the last.
  EXPECT_EQ(silent.front()->ReadAll(), "");
  silent.back()->Send("nd HTTP/1.1\r\nConnection: close\r\n\r\n");
  EXPECT_THAT(silent.back()->ReadAll(), EndsWith("here\n"));
}

TEST_F(HttpServerTest, EndsWhileConnectionsAreOpen) {
  const Client idle(server_->address());
  const Client halfway(server_->address());
  halfway.Send("GET /found");
  const Client served(server_->address());
  served.Send("GET /found HTTP/1.1\r\n\r\n");
  EXPECT_THAT(served.ReadUntil("here\n"), StartsWith("HTTP/1.1 200 "));
  server_.reset();
  EXPECT_EQ(idle.ReadAll(), "");
}

TEST(HttpServerAddressTest, TellsMalformedAddressesFromThoseInUse) {
  const auto handler = [](const std::string&) { return HttpResponse(); };
  for (const char* address :
       {"", "9464", ":9464", "127.0.0.1", "127.0.0.1:", "127.0.0.1:x",
        "127.0.0.1:65536", "127.0.0.1:-1", "127.0.0.1:000001"}) {
    const auto server = HttpServer::Listen(address, handler);
    EXPECT_EQ(server.status().code(), absl::StatusCode::kInvalidArgument)
        << address;
    EXPECT_THAT(std::string(server.status().message()), HasSubstr(address));
  }
  const auto first = HttpServer::Listen("127.0.0.1:0", handler);
  ASSERT_TRUE(first.ok()) << first.status();
  EXPECT_THAT((*first)->address(), Not(EndsWith(":0")));
  const auto second = HttpServer::Listen((*first)->address(), handler);
  EXPECT_EQ(second.status().code(), absl::StatusCode::kUnavailable);
  EXPECT_THAT(std::string(second.status().message()),
              HasSubstr("Address already in use"));
  EXPECT_EQ(
      HttpServer::Listen("no.such.host.invalid:0", handler).status().code(),
      absl::StatusCode::kUnavailable);
}

}  // namespace
}  // namespace revisit::server
