#include "client/cli/commands/verify_command.h"

#include <memory>

#include "absl/strings/str_cat.h"
#include "client/answers/names.h"
#include "client/cli/commands/printed_change.h"
#include "client/revisit/status.h"

namespace revisit::client {
namespace {

template <typename Message>
void Fill(const VerifiedPair& pair, Message* message) {
  message->set_query_sequence(pair.query_sequence);
  message->set_matched_sequence(pair.matched_sequence);
}

// Adds to a conflict how to undo the finding that is there, which this command
// lists.
absl::Status WithUndo(const absl::Status& status, const VerifiedPair& pair,
                      const std::string& command) {
  if (DetailsOf(status).reason != "POSE_PAIR_CONFLICT") return status;
  return WithHint(status,
                  absl::StrCat("undo that first: revisit ", command, " delete ",
                               pair.vehicle, " ", pair.query_sequence, " ",
                               pair.matched_sequence));
}

void AddPair(const Command& command, VerifiedPair* pair) {
  command.AddText("VEHICLE", "TEXT", &pair->vehicle, "Id, or name").Required();
  command
      .AddWholeNumber("QUERY_SEQ", kSequences, &pair->query_sequence,
                      "Sequence of the later pose")
      .Required();
  command
      .AddWholeNumber("MATCHED_SEQ", kSequences, &pair->matched_sequence,
                      "Sequence of the earlier pose")
      .Required();
  command.AddText("--candidate", "NAME", &pair->candidate,
                  "The stored candidate that this answers, as revisit watch "
                  "and checks name it");
}

}  // namespace

void AddConfirmCommand(const Command& program) {
  const Command command = program.AddCommand(
      {"confirm", "Tells that two poses were found to be one place.",
       "Adds a loop closure. Again: the existing one. A mistaken one is undone "
       "by\nrevisit closures delete. With what the verifier measured, the "
       "answer says how well\nthat agrees with the graph: a small p-value "
       "calls for a second look at the closure,\nthe axes of the measurement, "
       "or the covariances.",
       "  revisit confirm shuttle-7 2068 1072\n"
       "  revisit confirm shuttle-7 2060 1063 --relative 1.2,-0.4,0.03 "
       "--covariance 0.04,0,0,0.04,0,0.0004"});
  const auto pair = std::make_shared<VerifiedPair>();
  const auto measured = std::make_shared<VerifiedMeasurement>();
  AddPair(command, pair.get());
  AddMeasurement(command, "The later pose as seen from the earlier one",
                 measured.get());
  const Check check = [measured] { return CheckMeasurement(*measured); };
  command.AlsoPrints({OutputFormat::kName});
  command.Runs(
      [pair, measured](const Connection& server, const Terminal& terminal) {
        return RunConfirm(server.client, *pair, *measured, terminal);
      },
      check);
}

void AddRejectCommand(const Command& program) {
  const Command command = program.AddCommand(
      {"reject", "Tells that two poses were found not to be one place.",
       "The candidate is not offered again. Again: the existing rejection. A "
       "mistaken one\nis undone by revisit rejections delete.",
       "  revisit reject shuttle-7 2068 1155\n"
       "  revisit reject shuttle-7 2060 1147 --note \"another road\""});
  const auto pair = std::make_shared<VerifiedPair>();
  const auto note = std::make_shared<std::string>();
  AddPair(command, pair.get());
  command.AddText("--note", "TEXT", note.get(),
                  "For people: why it is not one place, for example");
  command.AlsoPrints({OutputFormat::kName});
  command.Runs(
      [pair, note](const Connection& server, const Terminal& terminal) {
        return RunReject(server.client, *pair, *note, terminal);
      });
}

absl::Status RunConfirm(const Client& client, const VerifiedPair& pair,
                        const VerifiedMeasurement& measurement,
                        const Terminal& terminal) {
  v1::AddLoopClosureRequest request;
  request.set_parent(VehicleName(pair.vehicle));
  request.set_candidate(pair.candidate);
  Fill(pair, request.mutable_loop_closure());
  Fill(measurement, request.mutable_loop_closure());
  const auto response = client.AddLoopClosure(request);
  if (!response.ok()) return WithUndo(response.status(), pair, "rejections");
  PrintChange("confirmed", response->loop_closure().name(), *response,
              terminal);
  if (response->has_agreement() && terminal.format == OutputFormat::kText) {
    const v1::MeasurementAgreement& agreement = response->agreement();
    terminal.out << "agreement with the graph: d2 "
                 << Fixed(agreement.squared_mahalanobis_distance(), 2) << " of "
                 << agreement.degrees_of_freedom()
                 << " degrees of freedom, p-value "
                 << Fixed(agreement.p_value(), 4) << '\n';
  }
  return absl::OkStatus();
}

absl::Status RunReject(const Client& client, const VerifiedPair& pair,
                       const std::string& note, const Terminal& terminal) {
  v1::RejectCandidateRequest request;
  request.set_parent(VehicleName(pair.vehicle));
  request.set_candidate(pair.candidate);
  Fill(pair, request.mutable_rejected_candidate());
  request.mutable_rejected_candidate()->set_note(note);
  const auto response = client.RejectCandidate(request);
  if (!response.ok()) return WithUndo(response.status(), pair, "closures");
  PrintChange("rejected", response->rejected_candidate().name(), *response,
              terminal);
  return absl::OkStatus();
}

}  // namespace revisit::client
