#include "client/answers/review_text.h"

#include <cstddef>
#include <cstdint>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "client/answers/candidate_text.h"
#include "client/answers/deviation_text.h"
#include "client/answers/names.h"
#include "client/revisit/candidate_watch.h"
#include "client/revisit/printable_text.h"
#include "client/terminal/terminal.h"
#include "nlohmann/json.hpp"

namespace revisit::client {
namespace {

using nlohmann::ordered_json;

// "probability 0.9123, ACCEPTED, -12.0 to +8.0 m along the path, of revision
// 7".
std::string Judgement(const v1::Candidate& found, std::uint64_t revision) {
  std::string text;
  if (found.has_probability()) {
    absl::StrAppend(&text, "probability ", Fixed(found.probability(), 4), ", ");
  }
  absl::StrAppend(&text, NameOf(found.verdict()));
  if (found.has_place_interval()) {
    absl::StrAppend(&text, ", ", IntervalText(found.place_interval()),
                    " m along the path");
  }
  return absl::StrCat(text, ", of revision ", revision);
}

// "1.20 +- 0.400 m" for each axis of which there is a standard deviation.
std::string DifferenceText(const v1::PoseDifference& difference) {
  const auto deviations = DeviationTexts(difference.covariance());
  const struct {
    const char* name;
    double value;
    int digits;
    const char* unit;
  } axes[] = {{"x", difference.x_meters(), 2, "m"},
              {"y", difference.y_meters(), 2, "m"},
              {"z", difference.z_meters(), 2, "m"},
              {"heading", difference.heading_radians(), 4, "rad"}};
  std::string text;
  for (std::size_t i = 0; i < deviations.size(); ++i) {
    if (deviations[i] == "-") continue;
    absl::StrAppend(&text, text.empty() ? "" : ", ", axes[i].name, " ",
                    Fixed(axes[i].value, axes[i].digits), " +- ", deviations[i],
                    " ", axes[i].unit);
  }
  return text.empty() ? "without an uncertainty" : text;
}

std::string MatchText(const v1::Candidate& found) {
  std::string text = PlaceText(found.matched());
  if (found.direction() == v1::DIRECTION_OPPOSITE) {
    absl::StrAppend(&text, ", opposite direction");
  }
  if (found.frame_state() != v1::FRAME_STATE_UNSPECIFIED &&
      found.frame_state() != v1::FRAME_STATE_SAME) {
    absl::StrAppend(&text, ", recording ", RecordingOfMatch(found), " (",
                    NameOf(found.frame_state()), ")");
  }
  return text;
}

std::vector<std::pair<std::string, std::string>> FieldsOf(
    const v1::Check& check, const v1::CheckCandidate& candidate) {
  std::vector<std::pair<std::string, std::string>> fields;
  const v1::Candidate* const found = EvidenceOf(check, candidate);
  if (found != nullptr) {
    fields.emplace_back("  query", PlaceText(found->query()));
    fields.emplace_back("  match", MatchText(*found));
  }
  fields.emplace_back("  value", ValueText(candidate) + " m2");
  const v1::Candidate* const told = FirstEvidenceOf(check, candidate);
  fields.emplace_back("  told then",
                      told == nullptr
                          ? "nothing: a later search found it"
                          : Judgement(*told, check.candidates().revision()));
  if (check.has_latest()) {
    fields.emplace_back("  found now",
                        candidate.latest_rank() == 0 || found == nullptr
                            ? absl::StrCat("nothing of it, of revision ",
                                           check.latest().revision())
                            : Judgement(*found, check.latest().revision()));
  }
  if (found != nullptr) {
    fields.emplace_back("  difference",
                        found->has_difference()
                            ? DifferenceText(found->difference())
                            : "not known: nothing ties the two recordings");
  }
  return fields;
}

}  // namespace

void PrintForReview(const v1::Check& check, const v1::CheckCandidate& candidate,
                    std::ostream& out) {
  out << Printable(candidate.name()) << '\n';
  PrintFields(FieldsOf(check, candidate), out);
  if (check.stale()) out << "  " << kStaleText << '\n';
  if (candidate.cause() == v1::CANDIDATE_CAUSE_CONTRADICTION) {
    out << "  contradicted: the loop closure that confirmed it says something "
           "else than others that agree; c upholds it, r deletes it\n";
  }
}

ordered_json ForReview(const v1::Check& check,
                       const v1::CheckCandidate& candidate) {
  const auto json_of = [](const google::protobuf::Message& message) {
    return ordered_json::parse(ToJson(message, false), nullptr, false);
  };
  ordered_json shown;
  shown["candidate"] = json_of(candidate);
  if (const v1::Candidate* const found = EvidenceOf(check, candidate)) {
    shown["evidence"] = json_of(*found);
  }
  if (const v1::Candidate* const told = FirstEvidenceOf(check, candidate)) {
    shown["told"] = json_of(*told);
  }
  shown["stale"] = check.stale();
  return shown;
}

}  // namespace revisit::client
