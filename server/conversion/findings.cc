#include "server/conversion/findings.h"

#include <cmath>
#include <cstdint>
#include <string>

#include "absl/strings/str_cat.h"
#include "core/base/number_text.h"
#include "google/protobuf/map.h"
#include "server/fields/enums.h"

namespace revisit::server {
namespace {

using absl::StrCat;
using core::NumberText;

constexpr EnumRow<v1::FindingCode, core::FindingCode> kCodes[] = {
    {v1::FINDING_CODE_COVARIANCES_DO_NOT_GROW,
     core::FindingCode::kCovariancesDoNotGrow},
    {v1::FINDING_CODE_COVARIANCES_GROW, core::FindingCode::kCovariancesGrow},
    {v1::FINDING_CODE_ERRORS_CORRELATED, core::FindingCode::kErrorsCorrelated},
    {v1::FINDING_CODE_STAMPS_LEAP, core::FindingCode::kStampsLeap},
    {v1::FINDING_CODE_NEW_FRAME, core::FindingCode::kNewFrame},
    {v1::FINDING_CODE_COVARIANCES_WITHOUT_LEVER,
     core::FindingCode::kCovariancesWithoutLever},
    {v1::FINDING_CODE_COVARIANCES_RESET, core::FindingCode::kCovariancesReset}};

// Poses that are so many times smoother than independent errors make them, or
// more, have errors that depend on each other.
constexpr double kSmooth = 3.0;

constexpr std::int64_t kNanosecondsPerSecond = 1'000'000'000;

// Further digits would be those of chance.
std::string Rough(double value) {
  return value < 10.0 ? StrCat(std::round(10.0 * value) / 10.0)
                      : StrCat(std::round(value));
}

std::string GrowText(const core::Finding& finding) {
  return StrCat("grow over ", std::round(100.0 * finding.growing),
                " of 100 stretches of the path");
}

std::string DoNotGrowText(const core::Finding& finding) {
  const std::string seen = StrCat("the covariances ", GrowText(finding),
                                  ", and those of DEAD_RECKONING over all");
  if (finding.smoother && *finding.smoother < kSmooth) {
    return StrCat(seen,
                  "; the poses stray as fixes do that do not depend on each "
                  "other, so set correlation_model to INDEPENDENT");
  }
  return StrCat(seen,
                "; if the poses are fixes, set correlation_model to "
                "CORRELATED_FIXES; if they are odometry, send covariances that "
                "add up along the path");
}

std::string ErrorsCorrelatedText(const core::Finding& finding) {
  return StrCat(
      "the errors are correlated: the poses stray from a smooth path ",
      Rough(finding.smoother.value_or(1.0)),
      " times less than independent errors of the claimed covariances would; "
      "set correlation_model to CORRELATED_FIXES, or claim what the poses "
      "stray by");
}

std::string SecondsText(std::int64_t nanoseconds) {
  return StrCat(nanoseconds / kNanosecondsPerSecond);
}

std::string DurationText(std::int64_t nanoseconds) {
  constexpr std::int64_t kDay = 24 * 3600 * kNanosecondsPerSecond;
  return nanoseconds < kDay       ? StrCat(SecondsText(nanoseconds), " s")
         : nanoseconds < 2 * kDay ? "1 day"
                                  : StrCat(nanoseconds / kDay, " days");
}

std::string StampsLeapText(const core::StampLeap& leap) {
  return StrCat(
      "the stamps go forward by ", DurationText(leap.nanoseconds),
      " to sequence ", leap.sequence,
      ", by more than retention.max_age; if that is wrong, mend the vehicle's "
      "clock, and if it does not go back, take max_age away: once stamps after "
      "the leap have lasted for some 14 sequence lengths, poses from before it "
      "are too old");
}

// Two digits of a standard deviation, whatever its size.
std::string Deviation(double value) {
  if (!(value > 0.0)) return "0";
  const double unit = std::pow(10.0, std::floor(std::log10(value)) - 1.0);
  return StrCat(std::round(value / unit) * unit);
}

std::string NewFrameText(const core::NewFrame& frame) {
  std::string text =
      StrCat("sequence ", frame.sequence,
             " looks like the start of a new recording, in a frame of its own: "
             "it lies ",
             Rough(frame.meters), " m from the pose before");
  if (frame.nanoseconds && *frame.nanoseconds > 0) {
    absl::StrAppend(&text, ", ", DurationText(*frame.nanoseconds), " later");
  }
  if (frame.claims_fall) {
    absl::StrAppend(&text, ", and claims to be within ",
                    Deviation(frame.after.meters), " m and ",
                    Deviation(frame.after.radians), " rad after ",
                    Deviation(frame.before.meters), " m and ",
                    Deviation(frame.before.radians), " rad");
  } else {
    text +=
        ", where the vehicle began or at the origin, and its covariance has "
        "grown by far less";
  }
  return text +
         "; searches find nothing across two frames: send the first pose of "
         "each recording with recording_start (revisit: --recording), which "
         "says how much is known of where its frame lies, so that searches "
         "look in the recordings before it too; poses that are stored without "
         "one have to be sent again, to a new vehicle";
}

std::string WithoutLeverText() {
  return "the covariances of position and heading with each other are left "
         "out, as from a driver that sends a diagonal, but an error of the "
         "heading swings all that follows; so the heading's variance is "
         "carried along the path, as dead reckoning does, and those of the "
         "position say no more than what each step adds; send covariances "
         "that are propagated, with their cross terms, or leave them out and "
         "let the client model them (revisit: --uncertainty model); if the "
         "poses are fixes, set correlation_model to CORRELATED_FIXES";
}

std::string ResetText(const core::ClaimsReset& reset) {
  return StrCat(
      "the covariance was begun anew at sequence ", reset.sequence,
      ", but the pose went on: it claims to be within ",
      Deviation(reset.after.meters), " m and ", Deviation(reset.after.radians),
      " rad after ", Deviation(reset.before.meters), " m and ",
      Deviation(reset.before.radians),
      " rad; so what was claimed before is carried on; send covariances that "
      "add up along the path, or, if the odometry began anew there, the first "
      "pose of each recording with recording_start (revisit: --recording)");
}

std::string TextOf(const core::Finding& finding) {
  switch (finding.code) {
    case core::FindingCode::kCovariancesDoNotGrow:
      return DoNotGrowText(finding);
    case core::FindingCode::kCovariancesGrow:
      return StrCat("the covariances ", GrowText(finding),
                    ", as those of reckoning do and not those of fixes; set "
                    "correlation_model to DEAD_RECKONING");
    case core::FindingCode::kErrorsCorrelated:
      return ErrorsCorrelatedText(finding);
    case core::FindingCode::kStampsLeap:
      return StampsLeapText(finding.leap.value_or(core::StampLeap()));
    case core::FindingCode::kCovariancesWithoutLever:
      return WithoutLeverText();
    case core::FindingCode::kCovariancesReset:
      return ResetText(finding.reset.value_or(core::ClaimsReset()));
    case core::FindingCode::kNewFrame:
      break;
  }
  return finding.frame ? NewFrameText(*finding.frame) : std::string();
}

using Metadata = google::protobuf::Map<std::string, std::string>;

void EncodeClaims(const core::Deviations& before, const core::Deviations& after,
                  Metadata* metadata) {
  (*metadata)["before_meters"] = NumberText(before.meters);
  (*metadata)["after_meters"] = NumberText(after.meters);
  (*metadata)["before_radians"] = NumberText(before.radians);
  (*metadata)["after_radians"] = NumberText(after.radians);
}

void EncodeNewFrame(const core::NewFrame& frame, Metadata* metadata) {
  (*metadata)["sequence"] = StrCat(frame.sequence);
  (*metadata)["meters"] = NumberText(frame.meters);
  EncodeClaims(frame.before, frame.after, metadata);
  if (frame.nanoseconds) {
    (*metadata)["seconds"] = SecondsText(*frame.nanoseconds);
  }
}

}  // namespace

void EncodeFinding(const core::Finding& finding, v1::Finding* message) {
  message->set_code(ToProto(kCodes, finding.code));
  message->set_message(TextOf(finding));
}

void EncodeFindingWarning(const core::Finding& finding, std::uint64_t sequence,
                          v1::Warning* warning) {
  warning->set_reason(v1::WARNING_REASON_FINDING);
  warning->set_message(TextOf(finding));
  auto& metadata = *warning->mutable_metadata();
  metadata["finding"] = v1::FindingCode_Name(ToProto(kCodes, finding.code));
  metadata["sequence"] =
      StrCat(finding.leap ? finding.leap->sequence : sequence);
  if (finding.leap) {
    metadata["seconds"] = SecondsText(finding.leap->nanoseconds);
  }
  if (finding.frame) EncodeNewFrame(*finding.frame, &metadata);
  if (finding.reset) {
    metadata["sequence"] = StrCat(finding.reset->sequence);
    EncodeClaims(finding.reset->before, finding.reset->after, &metadata);
  }
}

void EncodeStampWarning(const StampAhead& ahead, v1::Warning* warning) {
  warning->set_reason(v1::WARNING_REASON_STAMPS_AHEAD);
  warning->set_message(StrCat(
      "the stamp of sequence ", ahead.sequence, " is ",
      DurationText(ahead.nanoseconds),
      " ahead of the server's clock; the clock of the vehicle or of the server "
      "is wrong, and retention.max_age does not count such a stamp"));
  auto& metadata = *warning->mutable_metadata();
  metadata["sequence"] = StrCat(ahead.sequence);
  metadata["seconds"] = SecondsText(ahead.nanoseconds);
}

}  // namespace revisit::server
