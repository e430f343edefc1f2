#include "client/trajectory/recording_starts.h"

#include <algorithm>
#include <cmath>
#include <utility>
#include <vector>

#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_split.h"
#include "client/formats/angles.h"
#include "client/formats/text_lines.h"
#include "client/revisit/printable_text.h"
#include "client/terminal/terminal.h"
#include "client/trajectory/local_pose.h"
#include "google/protobuf/util/json_util.h"

namespace revisit::client {
namespace {

using Kind = RecordingChoice::Kind;

// RecordingStart.label has at most so many bytes, Datum.datum_id so many.
constexpr std::size_t kMostLabelBytes = 256;
constexpr std::size_t kMostDatumBytes = 128;

// A file goes on in the frame of the one before it if its first pose is as near
// to the last one as the next step may lead, and heads about the same way, a
// minute later at most.
constexpr double kNearMeters = 5.0;
constexpr double kUsualSteps = 4.0;
constexpr double kNearRadians = 0.3;
constexpr double kNearSeconds = 60.0;

// A positive number with this unit behind it.
std::optional<double> NumberWithUnit(const std::string& text,
                                     const std::string& unit) {
  if (text.size() <= unit.size() ||
      text.compare(text.size() - unit.size(), unit.size(), unit) != 0) {
    return std::nullopt;
  }
  const std::string number = text.substr(0, text.size() - unit.size());
  if (number.find_first_not_of("0123456789.eE+-") != number.npos) {
    return std::nullopt;
  }
  double value = 0.0;
  if (!absl::SimpleAtod(number, &value) || !std::isfinite(value) ||
      value <= 0.0) {
    return std::nullopt;
  }
  return value;
}

std::optional<RecordingChoice::Size> SizeOf(const std::string& meters,
                                            const std::string& degrees) {
  const auto position = NumberWithUnit(meters, "m");
  const auto heading = NumberWithUnit(degrees, "deg");
  if (!position || !heading) return std::nullopt;
  return RecordingChoice::Size{*position, *heading * kRadiansPerDegree};
}

std::string Sizes(const v1::Covariance& covariance) {
  const StateMatrix matrix = StateCovariance(covariance);
  return absl::StrCat(
      absl::SixDigits(std::sqrt(0.5 * (matrix[0] + matrix[5]))), " m and ",
      Fixed(std::sqrt(matrix[15]) / kRadiansPerDegree, 1), " degrees");
}

double MetersBetween(const PlanarPose& a, const PlanarPose& b) {
  return std::hypot(b.x - a.x, b.y - a.y);
}

}  // namespace

std::string ReadRecordingChoice(const std::string& text,
                                RecordingChoice* choice) {
  const std::string allowed = absl::StrCat(
      kRecordingWords,
      ", with the units, such as after:5m,17deg or datum:10m,1deg,survey-2");
  const std::size_t colon = text.find(':');
  const std::string word = text.substr(0, colon);
  RecordingChoice read;
  if (colon == text.npos) {
    if (word == "after") {
      read.kind = Kind::kAfter;
    } else if (word == "unknown") {
      read.kind = Kind::kUnknown;
    } else if (word == "same") {
      read.kind = Kind::kSame;
    } else {
      return allowed;
    }
    *choice = read;
    return "";
  }
  const std::vector<std::string> parts =
      absl::StrSplit(text.substr(colon + 1), absl::MaxSplits(',', 2));
  const bool is_datum = word == "datum";
  if ((word != "after" && !is_datum) || parts.size() < 2 ||
      (parts.size() > 2 && !is_datum)) {
    return allowed;
  }
  read.kind = is_datum ? Kind::kDatum : Kind::kAfter;
  read.size = SizeOf(parts[0], parts[1]);
  if (!read.size) return allowed;
  if (parts.size() > 2) {
    read.datum_id = parts[2];
    if (read.datum_id.empty() || read.datum_id.size() > kMostDatumBytes) {
      return absl::StrCat("an ID of 1 to ", kMostDatumBytes, " bytes");
    }
  }
  *choice = std::move(read);
  return "";
}

std::string ReadSize(const std::string& text, RecordingChoice::Size* size) {
  const std::vector<std::string> parts = absl::StrSplit(text, ',');
  const auto read =
      parts.size() == 2 ? SizeOf(parts[0], parts[1]) : std::nullopt;
  if (!read) {
    return absl::StrCat(kSizeWords, ", with the units, such as 10m,1deg");
  }
  *size = *read;
  return "";
}

v1::Covariance CovarianceOf(const RecordingChoice::Size& size,
                            v1::StateSpace state_space) {
  StateMatrix matrix = {};
  for (const std::size_t axis : {0, 1, 2}) {
    matrix[5 * axis] = size.meters * size.meters;
  }
  matrix[15] = size.radians * size.radians;
  return ToCovariance(matrix, state_space == v1::STATE_SPACE_SPATIAL);
}

v1::RecordingStart MakeRecordingStart(const RecordingChoice& choice,
                                      const std::string& label,
                                      v1::StateSpace state_space) {
  v1::RecordingStart start;
  start.set_label(label);
  switch (choice.kind) {
    case Kind::kDatum:
      start.mutable_datum()->set_datum_id(choice.datum_id);
      *start.mutable_datum()->mutable_covariance() =
          CovarianceOf(*choice.size, state_space);
      break;
    case Kind::kUnknown:
      start.set_unknown(true);
      break;
    default:
      if (choice.size) {
        *start.mutable_after() = CovarianceOf(*choice.size, state_space);
      }
      break;
  }
  return start;
}

std::string DatumText(const v1::Datum& datum) {
  std::string text = "datum";
  if (datum.covariance().values_size() > 0) {
    absl::StrAppend(&text, " within ", Sizes(datum.covariance()));
  }
  if (!datum.datum_id().empty()) absl::StrAppend(&text, ", ", datum.datum_id());
  return text;
}

std::string RelationText(const v1::RecordingStart& start) {
  switch (start.relation_case()) {
    case v1::RecordingStart::kDatum:
      return DatumText(start.datum());
    case v1::RecordingStart::kUnknown:
      return "unknown";
    case v1::RecordingStart::kAfter:
      return start.after().values_size() > 0
                 ? absl::StrCat("after, within ", Sizes(start.after()))
                 : "after";
    default:
      return "after";
  }
}

bool PosesTellOfFrames(v1::CorrelationModel model,
                       const UncertaintyOptions& uncertainty) {
  return (model == v1::CORRELATION_MODEL_UNSPECIFIED ||
          model == v1::CORRELATION_MODEL_DEAD_RECKONING) &&
         uncertainty.source != UncertaintyOptions::Source::kFixes &&
         !uncertainty.start_is_given;
}

RecordingStarts::RecordingStarts(const RecordingChoice& choice,
                                 v1::StateSpace state_space,
                                 bool looks_at_poses)
    : choice_(choice),
      state_space_(state_space),
      looks_at_poses_(looks_at_poses) {}

void RecordingStarts::BeginFile(const std::string& path) {
  path_ = path;
  is_first_of_file_ = true;
}

void RecordingStarts::ContinueFrom(std::optional<Place> before_last,
                                   const Place& last) {
  last_step_meters_ =
      before_last ? MetersBetween(before_last->pose, last.pose) : 0.0;
  last_ = last;
}

absl::StatusOr<std::optional<RecordingStarts::Begun>> RecordingStarts::Next(
    const Sample& sample) {
  auto begun = StatedBy(sample);
  if (!begun.ok()) return begun.status();
  if (!begun->has_value()) begun = BegunBy(sample);
  if (begun->has_value()) ++count_;
  last_step_meters_ = last_ ? MetersBetween(last_->pose, sample.estimate) : 0.0;
  last_ = {sample.estimate, sample.time_nanoseconds};
  is_first_of_file_ = false;
  return begun;
}

absl::StatusOr<std::optional<RecordingStarts::Begun>> RecordingStarts::StatedBy(
    const Sample& sample) const {
  if (!sample.recording_start || choice_.kind != Kind::kByPoses) {
    return std::nullopt;
  }
  Begun begun;
  const auto read = google::protobuf::util::JsonStringToMessage(
      *sample.recording_start, &begun.start);
  if (!read.ok()) {
    return absl::InvalidArgumentError(absl::StrCat(
        path_, ":", sample.line,
        ": expected a recording start as JSON in the comment before it, got ",
        Quoted(*sample.recording_start)));
  }
  return begun;
}

std::optional<RecordingStarts::Begun> RecordingStarts::BegunBy(
    const Sample& sample) const {
  if (sample.geodetic || choice_.kind == Kind::kSame) return std::nullopt;
  const bool by_poses = choice_.kind == Kind::kByPoses;
  const std::string place = absl::StrCat(
      Printable(path_), sample.line > 0 ? absl::StrCat(":", sample.line) : "");
  if (sample.restarts && !is_first_of_file_ && (looks_at_poses_ || !by_poses)) {
    Begun begun;
    // The datum is that of the frame before.
    RecordingChoice choice = choice_;
    if (choice.kind != Kind::kUnknown) choice.kind = Kind::kAfter;
    if (choice_.kind == Kind::kDatum) choice.size.reset();
    begun.start = MakeRecordingStart(choice, LabelOfFile(), state_space_);
    begun.by_poses = true;
    begun.note = absl::StrCat(
        place,
        ": the odometry is back at its start, so it began anew: another "
        "recording begins (--recording same: it is in the same frame)");
    return begun;
  }
  if (!is_first_of_file_) return std::nullopt;
  if (!last_) {
    if (choice_.kind != Kind::kDatum) return std::nullopt;
    return Begun{MakeRecordingStart(choice_, LabelOfFile(), state_space_),
                 false, ""};
  }
  if (!by_poses) {
    return Begun{MakeRecordingStart(choice_, LabelOfFile(), state_space_),
                 false, ""};
  }
  const std::string why = looks_at_poses_ ? WhyNotOn(sample) : "";
  if (why.empty()) return std::nullopt;
  Begun begun;
  begun.start = MakeRecordingStart(choice_, LabelOfFile(), state_space_);
  begun.by_poses = true;
  begun.note = absl::StrCat(
      place, ": ", why,
      ", so another recording begins, where the one before it ended "
      "(--recording unknown: it may be elsewhere; same: it is in the same "
      "frame; datum: see --help)");
  return begun;
}

std::string RecordingStarts::WhyNotOn(const Sample& sample) const {
  const double meters = MetersBetween(last_->pose, sample.estimate);
  if (meters > std::max(kNearMeters, kUsualSteps * last_step_meters_)) {
    return absl::StrCat("lies ", Fixed(meters, 0), " m from the pose before");
  }
  const double turn = std::abs(
      std::remainder(sample.estimate.heading - last_->pose.heading, kTurn));
  if (turn > kNearRadians) {
    return absl::StrCat("heads ", Fixed(turn / kRadiansPerDegree, 0),
                        " degrees away from the pose before");
  }
  if (!sample.time_nanoseconds || !last_->time_nanoseconds) return "";
  const double seconds = 1e-9 * (static_cast<double>(*sample.time_nanoseconds) -
                                 static_cast<double>(*last_->time_nanoseconds));
  if (std::abs(seconds) <= kNearSeconds) return "";
  return absl::StrCat("is ", Fixed(std::abs(seconds), 0), " s ",
                      seconds > 0.0 ? "later" : "earlier",
                      " than the pose before");
}

std::string RecordingStarts::LabelOfFile() const {
  if (path_ == "-") return "";
  std::string label = Printable(StemOf(path_));
  if (label.size() <= kMostLabelBytes) return label;
  std::size_t end = kMostLabelBytes;
  // A character of UTF-8 stays whole.
  while (end > 0 && (static_cast<unsigned char>(label[end]) & 0xC0) == 0x80) {
    --end;
  }
  label.resize(end);
  return label;
}

}  // namespace revisit::client
