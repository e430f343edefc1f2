#include "client/cli/commands/health_command.h"

#include <chrono>
#include <future>
#include <memory>
#include <string>
#include <utility>

#include "absl/strings/str_cat.h"
#include "client/revisit/status_from_grpc.h"
#include "google/protobuf/wrappers.pb.h"
#include "grpcpp/channel.h"
#include "grpcpp/client_context.h"
#include "grpcpp/generic/generic_stub.h"
#include "grpcpp/impl/codegen/proto_utils.h"
#include "nlohmann/json.hpp"

namespace revisit::client {
namespace {

// grpc.health.v1.HealthCheckRequest has a text as its field 1, and
// HealthCheckResponse an enum: to the wire they are these. gRPC keeps its own
// messages of health to itself.
using Request = google::protobuf::StringValue;
using Response = google::protobuf::Int32Value;

constexpr int kServing = 1;

struct HealthOptions {
  std::string service;
  double timeout_seconds = 5.0;
};

absl::Status RunHealth(const Connection& server, const HealthOptions& options,
                       const Terminal& terminal) {
  grpc::ClientContext context;
  context.set_deadline(
      std::chrono::system_clock::now() +
      std::chrono::duration_cast<std::chrono::milliseconds>(
          std::chrono::duration<double>(options.timeout_seconds)));
  Request request;
  request.set_value(options.service);
  Response response;
  std::promise<grpc::Status> answered;
  std::shared_ptr<grpc::ChannelInterface> channel = server.channel;
  grpc::TemplatedGenericStub<Request, Response>(std::move(channel))
      .UnaryCall(&context, "/grpc.health.v1.Health/Check", grpc::StubOptions(),
                 &request, &response, [&answered](const grpc::Status& status) {
                   answered.set_value(status);
                 });
  const grpc::Status status = answered.get_future().get();
  if (!status.ok()) return FromGrpc(status);
  if (response.value() != kServing) {
    return absl::UnavailableError(absl::StrCat(
        server.options.address, " answers that ",
        options.service.empty() ? "it" : options.service, " is not serving"));
  }
  if (terminal.json()) {
    terminal.out << nlohmann::json({{"status", "SERVING"}}).dump() << '\n';
  } else {
    terminal.out << "SERVING\n";
  }
  return absl::OkStatus();
}

}  // namespace

void AddHealthCommand(const Command& program) {
  const Command command = program.AddCommand(
      {"health", "Asks whether the server is serving, as a probe does.",
       "Calls the standard health service, which needs no token, and exits "
       "with 0 only if the\nanswer is SERVING.",
       "  revisit health\n"
       "  revisit health --service revisit.v1.PoseGraphService/write"});
  const auto options = std::make_shared<HealthOptions>();
  command.AddText("--service", "NAME", &options->service,
                  "What is asked for: revisit.v1.PoseGraphService, or "
                  "revisit.v1.PoseGraphService/write, which is not serving "
                  "while the store takes no writes; without it, the server as "
                  "a whole");
  command.AddNumber("--timeout", "S", &options->timeout_seconds,
                    "Seconds to wait for the answer (5)");
  command.Runs(
      [options](const Connection& server, const Terminal& terminal) {
        return RunHealth(server, *options, terminal);
      },
      [options]() -> std::string {
        return options->timeout_seconds > 0.0 ? ""
                                              : "--timeout: must be positive";
      });
}

}  // namespace revisit::client
