#include "client/cli/commands/verify_command.h"

#include <memory>

#include "absl/strings/str_cat.h"
#include "client/answers/names.h"
#include "client/revisit/printable_text.h"
#include "client/revisit/status.h"

namespace revisit::client {
namespace {

template <typename Message>
void Fill(const VerifiedPair& pair, Message* message) {
  message->set_query_sequence(pair.query_sequence);
  message->set_matched_sequence(pair.matched_sequence);
}

void Fill(const VerifiedMeasurement& measured, v1::LoopClosure* closure) {
  closure->set_note(measured.note);
  if (measured.score) closure->set_score(*measured.score);
  if (measured.relative.empty()) return;
  v1::LoopClosureMeasurement* const m = closure->mutable_measurement();
  m->set_x_meters(measured.relative[0]);
  m->set_y_meters(measured.relative[1]);
  if (measured.relative.size() == 4) m->set_z_meters(measured.relative[2]);
  m->set_heading_radians(measured.relative.back());
  v1::Covariance* const covariance = m->mutable_covariance();
  const std::size_t count = measured.covariance.size();
  covariance->set_form(count == 6    ? v1::COVARIANCE_FORM_PLANAR_6
                       : count == 10 ? v1::COVARIANCE_FORM_SPATIAL_10
                                     : v1::COVARIANCE_FORM_ROS_36);
  covariance->mutable_values()->Assign(measured.covariance.begin(),
                                       measured.covariance.end());
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

template <typename Response>
void Print(const char* done, const std::string& name, const Response& response,
           const Terminal& terminal) {
  if (terminal.json()) {
    terminal.out << ToJson(response, true) << '\n';
  } else if (terminal.names()) {
    terminal.out << Printable(name) << '\n';
  } else {
    terminal.out << done << " " << Printable(name) << ", revision "
                 << response.revision() << '\n';
  }
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
  const Flag relative = command.AddNumbers(
      "--relative", "X,Y[,Z],HEADING", &measured->relative,
      "The later pose as seen from the earlier one: metres ahead, to the left "
      "(and up), and radians counter-clockwise");
  const Flag covariance = command.AddNumbers(
      "--covariance", "NUMBERS", &measured->covariance,
      "Covariance of its errors, in the same axes: the upper triangle by rows "
      "over x, y, "
      "heading (6) or x, y, z, heading (10), or the 36 of ROS");
  relative.Needs(covariance);
  covariance.Needs(relative);
  command.AddText("--note", "TEXT", &measured->note,
                  "For people: what found it, for example");
  command.AddNumber(
      "--score", "NUMBER",
      [measured](double score) { measured->score = score; },
      "How sure the verifier is, on a scale of its own");
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

std::string CheckMeasurement(const VerifiedMeasurement& measurement) {
  const std::size_t numbers = measurement.relative.size();
  const std::size_t variances = measurement.covariance.size();
  if (numbers == 0 && variances == 0) return "";
  if (numbers != 3 && numbers != 4) {
    return absl::StrCat(
        "--relative: expected X,Y,HEADING or X,Y,Z,HEADING, "
        "got ",
        numbers, " numbers");
  }
  if (variances != 6 && variances != 10 && variances != 36) {
    return absl::StrCat("--covariance: expected 6, 10 or 36 numbers, got ",
                        variances);
  }
  return "";
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
  Print("confirmed", response->loop_closure().name(), *response, terminal);
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
  Print("rejected", response->rejected_candidate().name(), *response, terminal);
  return absl::OkStatus();
}

}  // namespace revisit::client
