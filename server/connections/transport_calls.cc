#include "server/connections/transport_calls.h"

#include <algorithm>
#include <cstdlib>
#include <iterator>
#include <memory>
#include <nlohmann/json.hpp>

#include "grpc/grpc.h"
#include "grpc/support/alloc.h"
#include "server/connections/connection_meter.h"

namespace revisit::server {
namespace {

using Json = nlohmann::json;

// Parses and frees a rendering of gRPC. It has the JSON form of channelz.proto:
// members that are 0 or empty are left out, numbers of 64 bits are strings.
Json Take(char* rendered) {
  const std::unique_ptr<char, void (*)(void*)> text(rendered, gpr_free);
  if (text == nullptr) return Json::object();
  Json json = Json::parse(text.get(), nullptr, /*allow_exceptions=*/false);
  return json.is_object() ? std::move(json) : Json::object();
}

const Json& Member(const Json& json, const char* name) {
  static const Json* const kNothing = new Json();
  if (!json.is_object()) return *kNothing;
  const auto found = json.find(name);
  return found == json.end() ? *kNothing : *found;
}

std::int64_t Number(const Json& json, const char* name) {
  const Json& member = Member(json, name);
  if (!member.is_string()) return 0;
  return std::strtoll(member.get_ref<const std::string&>().c_str(), nullptr,
                      10);
}

// Description of a socket; empty if the socket is closed.
Json ReadSocket(std::int64_t socket) {
  return Take(grpc_channelz_get_socket(static_cast<intptr_t>(socket)));
}

}  // namespace

std::optional<CallCounts> TransportCalls::Count(const std::string& remote) {
  auto found = sockets_.find(remote);
  if (found == sockets_.end()) {
    LearnNew();
    found = sockets_.find(remote);
    if (found == sockets_.end()) return std::nullopt;
  }
  const Json socket = ReadSocket(found->second);
  if (socket.empty()) {
    // Another connection may come from the same port.
    sockets_.erase(found);
    return std::nullopt;
  }
  const Json& data = Member(Member(socket, "socket"), "data");
  const std::int64_t over =
      Number(data, "streamsSucceeded") + Number(data, "streamsFailed");
  const std::int64_t held = Number(data, "streamsStarted") - over;
  return CallCounts{static_cast<std::uint64_t>(std::max<std::int64_t>(held, 0)),
                    static_cast<std::uint64_t>(over)};
}

void TransportCalls::LearnNew() {
  const Json servers = Take(grpc_channelz_get_servers(0));
  std::int64_t next = next_socket_;
  for (const Json& server : Member(servers, "server")) {
    const std::int64_t id = Number(Member(server, "ref"), "serverId");
    bool more = true;
    for (std::int64_t from = next_socket_; more;) {
      const Json page = Take(grpc_channelz_get_server_sockets(
          static_cast<intptr_t>(id), static_cast<intptr_t>(from), 0));
      const Json& refs = Member(page, "socketRef");
      for (const Json& ref : refs) {
        const std::int64_t socket = Number(ref, "socketId");
        from = std::max(from, socket + 1);
        // A name such as "chttp2 ipv4:127.0.0.1:4711".
        const Json& name = Member(ref, "name");
        if (!name.is_string()) continue;
        const std::string& text = name.get_ref<const std::string&>();
        const std::size_t peer = text.find(' ');
        if (peer == std::string::npos) continue;
        sockets_[ConnectionMeters::RemoteOf(text.substr(peer + 1))] = socket;
      }
      next = std::max(next, from);
      more = !refs.empty() && Member(page, "end") != true;
    }
  }
  next_socket_ = next;
  if (sockets_.size() > most_) ForgetClosed();
}

void TransportCalls::ForgetClosed() {
  for (auto it = sockets_.begin(); it != sockets_.end();) {
    it = ReadSocket(it->second).empty() ? sockets_.erase(it) : std::next(it);
  }
  most_ = std::max<std::size_t>(1024, 2 * sockets_.size());
}

}  // namespace revisit::server
