#include "client/cli/commands/verify_command.h"

#include <memory>

#include "absl/strings/str_cat.h"
#include "client/cli/commands/findings_command.h"
#include "client/cli/names.h"

namespace revisit::client {
namespace {

template <typename Message>
void Fill(const VerifiedPair& pair, Message* message) {
  message->set_query_sequence(pair.query_sequence);
  message->set_matched_sequence(pair.matched_sequence);
}

FindingReference Reference(const VerifiedPair& pair) {
  return {
      pair.vehicle,
      {absl::StrCat(pair.query_sequence), absl::StrCat(pair.matched_sequence)}};
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

using RunVerified = absl::Status (*)(const Client&, const VerifiedPair&,
                                     const Console&);

void AddVerified(const Command& program, const CommandHelp& help,
                 RunVerified run) {
  const Command command = program.AddCommand(help);
  const auto pair = std::make_shared<VerifiedPair>();
  command.AddText("VEHICLE", "TEXT", &pair->vehicle, "Id, or name").Required();
  command
      .AddWholeNumber("QUERY_SEQ", kSequences, &pair->query_sequence,
                      "Sequence of the later pose")
      .Required();
  command
      .AddWholeNumber("MATCHED_SEQ", kSequences, &pair->matched_sequence,
                      "Sequence of the earlier pose")
      .Required();
  command.Runs([pair, run](const Connection& server, const Console& console) {
    return run(server.client, *pair, console);
  });
}

}  // namespace

void AddConfirmCommand(const Command& program) {
  AddVerified(
      program,
      {"confirm", "Tells that two poses were found to be one place.",
       "Adds a loop closure. Again: the existing one. A mistaken one is "
       "undone by\nrevisit closures delete.",
       "  revisit confirm shuttle-7 2068 1072"},
      &RunConfirm);
}

void AddRejectCommand(const Command& program) {
  AddVerified(
      program,
      {"reject", "Tells that two poses were found not to be one place.",
       "The candidate is not offered again. Again: the existing rejection. A "
       "mistaken one\nis undone by revisit rejections delete.",
       "  revisit reject shuttle-7 2068 1155"},
      &RunReject);
}

absl::Status RunConfirm(const Client& client, const VerifiedPair& pair,
                        const Console& console) {
  if (absl::Status status = CheckNotRejected(client, Reference(pair));
      !status.ok()) {
    return status;
  }
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
  if (absl::Status status = CheckNotConfirmed(client, Reference(pair));
      !status.ok()) {
    return status;
  }
  v1::RejectCandidateRequest request;
  request.set_parent(VehicleName(pair.vehicle));
  Fill(pair, request.mutable_rejected_candidate());
  const auto response = client.RejectCandidate(request);
  if (!response.ok()) return response.status();
  Print("rejected", response->rejected_candidate().name(), *response, console);
  return absl::OkStatus();
}

}  // namespace revisit::client
