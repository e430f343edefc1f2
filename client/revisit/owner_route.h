// Internal to the client library: how a call finds the server that has its
// vehicle, where several servers stand behind a proxy.
#ifndef REVISIT_CLIENT_REVISIT_OWNER_ROUTE_H_
#define REVISIT_CLIENT_REVISIT_OWNER_ROUTE_H_

#include "absl/status/status.h"

namespace grpc {
class ClientContext;
}

namespace revisit::client {

// For the attempt after one that ended with this status: if that was NOT_OWNER,
// the context gets the header x-revisit-owner, whose value is the address of
// the owner in base64, as the stateful sessions of Envoy read it
// (envoy.http.stateful_session.header). The next attempt only: the owner may
// change at any time, and without the header a proxy chooses by the vehicle's
// id.
void RouteToOwner(const absl::Status& last, grpc::ClientContext* context);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_REVISIT_OWNER_ROUTE_H_
