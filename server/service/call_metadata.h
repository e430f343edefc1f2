// Metadata of a call: what gRPC knows of it beside its messages.
#ifndef REVISIT_SERVER_SERVICE_CALL_METADATA_H_
#define REVISIT_SERVER_SERVICE_CALL_METADATA_H_

#include <string>

#include "grpcpp/server_context.h"
#include "server/security/gatekeeper.h"
#include "server/telemetry/trace_context.h"

namespace revisit::server {

// The key of the request id, which callers may send and are told.
inline constexpr char kRequestIdKey[] = "x-request-id";

// The request id that the caller sent, or a new one.
std::string RequestIdOf(const grpc::CallbackServerContext& context);

TraceContext TraceOf(const grpc::CallbackServerContext& context);

Credentials CredentialsOf(const grpc::CallbackServerContext& context);

// The address of the caller without its port, such as "ipv4:127.0.0.1".
std::string AddressOf(const grpc::CallbackServerContext& context);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SERVICE_CALL_METADATA_H_
