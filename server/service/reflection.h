// The standard reflection service, v1 and v1alpha, with the comments of the
// protos.
//
// gRPC's own, as Debian 12 has it (1.51), keeps a thread for each stream, as
// many as callers open, and knows neither v1 nor comments.
#ifndef REVISIT_SERVER_SERVICE_REFLECTION_H_
#define REVISIT_SERVER_SERVICE_REFLECTION_H_

#include <memory>
#include <string>
#include <vector>

#include "grpcpp/impl/codegen/service_type.h"

namespace revisit::server {

// The services that make up reflection. They must outlive the server with which
// they are registered. `served` are the full names of the other services. All
// who reach the listener may ask; if there are too many streams at a time, the
// oldest is cancelled.
std::vector<std::unique_ptr<grpc::Service>> MakeReflectionServices(
    std::vector<std::string> served);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SERVICE_REFLECTION_H_
