#include "client/cli/commands/verify_command.h"

#include "client/cli/names.h"

namespace revisit::client {
namespace {

template <typename Message>
void Fill(const VerifiedPair& pair, Message* message) {
  message->set_query_sequence(pair.query_sequence);
  message->set_matched_sequence(pair.matched_sequence);
}

template <typename Response>
void Print(const char* done, const std::string& name, const Response& response,
           const Console& console) {
  if (console.json) {
    console.out << ToJson(response, true) << '\n';
  } else {
    console.out << done << " " << name << ", revision " << response.revision()
                << '\n';
  }
}

}  // namespace

absl::Status RunConfirm(const Client& client, const VerifiedPair& pair,
                        const Console& console) {
  v1::AddLoopClosureRequest request;
  request.set_parent(VehicleName(pair.vehicle));
  Fill(pair, request.mutable_loop_closure());
  const auto response = client.AddLoopClosure(request);
  if (!response.ok()) return response.status();
  Print("confirmed", response->loop_closure().name(), *response, console);
  return absl::OkStatus();
}

absl::Status RunReject(const Client& client, const VerifiedPair& pair,
                       const Console& console) {
  v1::RejectCandidateRequest request;
  request.set_parent(VehicleName(pair.vehicle));
  Fill(pair, request.mutable_rejected_candidate());
  const auto response = client.RejectCandidate(request);
  if (!response.ok()) return response.status();
  Print("rejected", response->rejected_candidate().name(), *response, console);
  return absl::OkStatus();
}

}  // namespace revisit::client
