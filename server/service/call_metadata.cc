#include "server/service/call_metadata.h"

#include <algorithm>
#include <cstddef>
#include <cstdio>
#include <random>

#include "grpc/grpc_security_constants.h"
#include "grpcpp/security/auth_context.h"

namespace revisit::server {
namespace {

constexpr char kAuthorizationKey[] = "authorization";
constexpr char kTraceParentKey[] = "traceparent";
constexpr std::size_t kMaxRequestIdBytes = 128;

std::string NewRequestId() {
  thread_local std::mt19937_64 generator(std::random_device{}());
  char text[17];
  std::snprintf(text, sizeof(text), "%016llx",
                static_cast<unsigned long long>(generator()));
  return text;
}

}  // namespace

std::string RequestIdOf(const grpc::CallbackServerContext& context) {
  const auto& metadata = context.client_metadata();
  const auto entry = metadata.find(kRequestIdKey);
  if (entry != metadata.end()) {
    const std::string id(entry->second.data(), entry->second.size());
    const bool printable = std::all_of(
        id.begin(), id.end(), [](char c) { return c >= ' ' && c <= '~'; });
    if (!id.empty() && id.size() <= kMaxRequestIdBytes && printable) return id;
  }
  return NewRequestId();
}

TraceContext TraceOf(const grpc::CallbackServerContext& context) {
  const auto& metadata = context.client_metadata();
  // Given twice, it is malformed.
  if (metadata.count(kTraceParentKey) != 1) return {};
  const grpc::string_ref header = metadata.find(kTraceParentKey)->second;
  return ParseTraceParent({header.data(), header.size()});
}

Credentials CredentialsOf(const grpc::CallbackServerContext& context) {
  Credentials credentials;
  const auto [first, last] =
      context.client_metadata().equal_range(kAuthorizationKey);
  for (auto entry = first; entry != last; ++entry) {
    credentials.authorizations.emplace_back(entry->second.data(),
                                            entry->second.size());
  }
  const auto authentication = context.auth_context();
  if (authentication == nullptr || !authentication->IsPeerAuthenticated()) {
    return credentials;
  }
  const auto property = [&](const char* name) {
    const auto values = authentication->FindPropertyValues(name);
    return values.empty()
               ? std::string()
               : std::string(values.front().data(), values.front().size());
  };
  credentials.certificate_pem = property(GRPC_X509_PEM_CERT_PROPERTY_NAME);
  credentials.certificate_chain_pem =
      property(GRPC_X509_PEM_CERT_CHAIN_PROPERTY_NAME);
  return credentials;
}

std::string AddressOf(const grpc::CallbackServerContext& context) {
  // Such as ipv4:127.0.0.1:4711.
  const std::string peer = context.peer();
  return peer.substr(0, peer.rfind(':'));
}

}  // namespace revisit::server
