#include "server/conversion/proto_conversion.h"

#include <xxhash.h>

#include <GeographicLib/LocalCartesian.hpp>
#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <set>
#include <utility>

#include "core/base/number_text.h"
#include "core/geometry/heading.h"
#include "google/protobuf/io/coded_stream.h"
#include "google/protobuf/timestamp.pb.h"
#include "server/base/status.h"
#include "server/sessions/vehicle_uid.h"

namespace revisit::server {
namespace {

constexpr char kInvalidField[] = "INVALID_FIELD";
constexpr char kNotFinite[] = "NOT_FINITE";
constexpr char kQuaternionInvalid[] = "QUATERNION_INVALID";

// Stamps are kept as 64-bit nanoseconds, which reach a little beyond these
// years.
constexpr std::int64_t kFirstStampSeconds = -9214560000;  // 1678-01-01
constexpr std::int64_t kEndStampSeconds = 9214646400;     // 2262-01-01
constexpr std::int64_t kNanosPerSecond = 1000000000;
constexpr double kMaxNormError = 1e-3;
// Length of the forward axis' projection onto the ground below which it has no
// heading.
constexpr double kMinHorizontal = 1e-6;
// Of `repeated Pose poses = 1` in PoseBatch, length-delimited.
constexpr std::uint32_t kPosesTag = (1 << 3) | 2;

// Whether the value is finite; a violation otherwise.
bool CheckFinite(double value, const FieldPath& path, Violations* violations) {
  if (std::isfinite(value)) return true;
  violations->Add(
      kNotFinite, path,
      "got " + core::NumberText(value) + "; allowed are finite numbers");
  return false;
}

bool CheckRange(double value, double lowest, double highest,
                const FieldPath& path, Violations* violations) {
  if (!CheckFinite(value, path, violations)) return false;
  if (value >= lowest && value <= highest) return true;
  violations->Add(kInvalidField, path,
                  "got " + core::NumberText(value) + "; allowed is [" +
                      core::NumberText(lowest) + ", " +
                      core::NumberText(highest) + "]");
  return false;
}

void CheckGeodetic(const v1::GeodeticPosition& position, const FieldPath& path,
                   Violations* violations) {
  CheckRange(position.latitude_degrees(), -90, 90,
             path.Field("latitude_degrees"), violations);
  CheckRange(position.longitude_degrees(), -180, 180,
             path.Field("longitude_degrees"), violations);
  CheckRange(position.height_meters(), -10000, 100000,
             path.Field("height_meters"), violations);
}

GeodeticOrigin ToOrigin(const v1::GeodeticPosition& position) {
  return {position.latitude_degrees(), position.longitude_degrees(),
          position.height_meters()};
}

void EncodeTime(std::int64_t nanoseconds,
                google::protobuf::Timestamp* timestamp) {
  std::int64_t seconds = nanoseconds / kNanosPerSecond;
  std::int64_t nanos = nanoseconds % kNanosPerSecond;
  if (nanos < 0) {
    nanos += kNanosPerSecond;
    --seconds;
  }
  timestamp->set_seconds(seconds);
  timestamp->set_nanos(static_cast<std::int32_t>(nanos));
}

// REQUIRES: within the range of stamps.
std::int64_t ToNanoseconds(const google::protobuf::Timestamp& timestamp) {
  return timestamp.seconds() * kNanosPerSecond + timestamp.nanos();
}

bool CheckTimestamp(const google::protobuf::Timestamp& timestamp,
                    const FieldPath& path, Violations* violations) {
  bool valid = true;
  if (timestamp.seconds() < kFirstStampSeconds ||
      timestamp.seconds() >= kEndStampSeconds) {
    violations->Add(kInvalidField, path.Field("seconds"),
                    "got " + std::to_string(timestamp.seconds()) +
                        "; allowed are the years 1678 to 2261");
    valid = false;
  }
  if (timestamp.nanos() < 0 || timestamp.nanos() >= kNanosPerSecond) {
    violations->Add(kInvalidField, path.Field("nanos"),
                    "got " + std::to_string(timestamp.nanos()) +
                        "; allowed is [0, 999999999]");
    valid = false;
  }
  return valid;
}

// ---- Enums of the settings, with what each means in core. The first row is
// the default.

template <typename Proto, typename Core>
struct EnumRow {
  Proto proto;
  Core core;
};

constexpr EnumRow<v1::StateSpace, core::StateSpace> kStateSpaces[] = {
    {v1::STATE_SPACE_PLANAR, core::StateSpace::kPlanar},
    {v1::STATE_SPACE_SPATIAL, core::StateSpace::kSpatial}};
constexpr EnumRow<v1::CorrelationModel, core::CorrelationModel>
    kCorrelationModels[] = {
        {v1::CORRELATION_MODEL_DEAD_RECKONING,
         core::CorrelationModel::kDeadReckoning},
        {v1::CORRELATION_MODEL_INDEPENDENT,
         core::CorrelationModel::kIndependent},
        {v1::CORRELATION_MODEL_FILTER, core::CorrelationModel::kFilter}};
constexpr EnumRow<v1::LikelihoodForm, core::LikelihoodForm> kLikelihoodForms[] =
    {{v1::LIKELIHOOD_FORM_GAUSSIAN, core::LikelihoodForm::kGaussian},
     {v1::LIKELIHOOD_FORM_AS_PRINTED, core::LikelihoodForm::kAsPrinted}};
constexpr EnumRow<v1::Alignment, core::AlignmentKind> kAlignments[] = {
    {v1::ALIGNMENT_RELATIVE, core::AlignmentKind::kRelative},
    {v1::ALIGNMENT_COMPOSITE, core::AlignmentKind::kComposite}};
constexpr EnumRow<v1::Direction, core::SearchDirection> kSearchDirections[] = {
    {v1::DIRECTION_SAME, core::SearchDirection::kSame},
    {v1::DIRECTION_OPPOSITE, core::SearchDirection::kOpposite},
    {v1::DIRECTION_EITHER, core::SearchDirection::kEither}};
constexpr EnumRow<v1::Direction, core::Direction> kDirections[] = {
    {v1::DIRECTION_SAME, core::Direction::kSame},
    {v1::DIRECTION_OPPOSITE, core::Direction::kOpposite}};
constexpr EnumRow<v1::CoordinateFrame, CoordinateFrame> kCoordinateFrames[] = {
    {v1::COORDINATE_FRAME_LOCAL, CoordinateFrame::kLocal},
    {v1::COORDINATE_FRAME_GEODETIC, CoordinateFrame::kGeodetic}};
constexpr EnumRow<v1::Verdict, core::Verdict> kVerdicts[] = {
    {v1::VERDICT_ACCEPTED, core::Verdict::kAccepted},
    {v1::VERDICT_REJECTED_BY_GATE, core::Verdict::kRejectedByGate},
    {v1::VERDICT_REJECTED_BY_SHAPE, core::Verdict::kRejectedByShape},
    {v1::VERDICT_AMBIGUOUS, core::Verdict::kAmbiguous},
    {v1::VERDICT_UNINFORMATIVE, core::Verdict::kUninformative},
    {v1::VERDICT_ILL_CONDITIONED, core::Verdict::kIllConditioned}};
constexpr EnumRow<v1::GateVerdict, core::GateVerdict> kGateVerdicts[] = {
    {v1::GATE_VERDICT_ACCEPTED, core::GateVerdict::kAccepted},
    {v1::GATE_VERDICT_REJECTED, core::GateVerdict::kRejected},
    {v1::GATE_VERDICT_ILL_CONDITIONED, core::GateVerdict::kIllConditioned}};
constexpr EnumRow<v1::EmptyReason, core::EmptyReason> kEmptyReasons[] = {
    {v1::EMPTY_REASON_UNSPECIFIED, core::EmptyReason::kNotEmpty},
    {v1::EMPTY_REASON_PATH_TOO_SHORT, core::EmptyReason::kPathTooShort},
    {v1::EMPTY_REASON_NO_HISTORY, core::EmptyReason::kNoHistory},
    {v1::EMPTY_REASON_ALL_SUPPRESSED, core::EmptyReason::kAllSuppressed},
    {v1::EMPTY_REASON_NO_ALIGNMENT, core::EmptyReason::kNoAlignment},
    {v1::EMPTY_REASON_NO_PROBABLE_PLACE, core::EmptyReason::kNoProbablePlace},
    {v1::EMPTY_REASON_LIMIT_EXCEEDED, core::EmptyReason::kTooMuchWork}};

template <typename Proto, typename Core, std::size_t N>
Proto ToProto(const EnumRow<Proto, Core> (&rows)[N], Core value) {
  for (const auto& row : rows) {
    if (row.core == value) return row.proto;
  }
  return rows[0].proto;
}

// Leaves the value alone if the field is unspecified.
template <typename Proto, typename Core, std::size_t N>
void DecodeEnum(const EnumRow<Proto, Core> (&rows)[N], Proto field,
                const FieldPath& path, Core* value, Violations* violations) {
  if (field == 0) return;
  for (const auto& row : rows) {
    if (row.proto == field) {
      *value = row.core;
      return;
    }
  }
  violations->Add(kInvalidField, path,
                  "got " + std::to_string(static_cast<int>(field)) +
                      ", which is no value of this enum");
}

void DecodeTolerance(const v1::PlaceTolerance& message, const FieldPath& path,
                     core::PlaceTolerance* tolerance, Violations* violations) {
  if (CheckFinite(message.position_meters(), path.Field("position_meters"),
                  violations)) {
    tolerance->position_meters = message.position_meters();
  }
  if (CheckFinite(message.heading_radians(), path.Field("heading_radians"),
                  violations)) {
    tolerance->heading_radians = message.heading_radians();
  }
}

// What VehicleSettings and CandidateOptions have in common.
template <typename Message>
void DecodeSearch(const Message& message, const FieldPath& path,
                  core::SearchOptions* search, Violations* violations) {
  DecodeEnum(kCorrelationModels, message.correlation_model(),
             path.Field("correlation_model"), &search->correlation_model,
             violations);
  DecodeEnum(kLikelihoodForms, message.likelihood_form(),
             path.Field("likelihood_form"), &search->likelihood_form,
             violations);
  if (message.has_sequence_length_meters() &&
      CheckFinite(message.sequence_length_meters(),
                  path.Field("sequence_length_meters"), violations)) {
    search->sequence_length_meters = message.sequence_length_meters();
  }
  if (message.has_gate_probability() &&
      CheckFinite(message.gate_probability(), path.Field("gate_probability"),
                  violations)) {
    search->gate_probability = message.gate_probability();
  }
  if (message.has_place_tolerance()) {
    DecodeTolerance(message.place_tolerance(), path.Field("place_tolerance"),
                    &search->place_tolerance, violations);
  }
  if (message.has_candidate_separation_meters() &&
      CheckFinite(message.candidate_separation_meters(),
                  path.Field("candidate_separation_meters"), violations)) {
    search->candidate_separation_meters = message.candidate_separation_meters();
  }
  if (message.has_max_candidates()) {
    search->max_candidates = message.max_candidates();
  }
  DecodeEnum(kAlignments, message.alignment(), path.Field("alignment"),
             &search->alignment, violations);
  if (message.has_acceptance_probability() &&
      CheckFinite(message.acceptance_probability(),
                  path.Field("acceptance_probability"), violations)) {
    search->acceptance_probability = message.acceptance_probability();
  }
  if (message.has_road_spacing_meters() &&
      CheckFinite(message.road_spacing_meters(),
                  path.Field("road_spacing_meters"), violations)) {
    search->road_spacing_meters = message.road_spacing_meters();
  }
  if (message.has_shape_tolerance()) {
    DecodeTolerance(message.shape_tolerance(), path.Field("shape_tolerance"),
                    &search->shape.tolerance, violations);
  }
  if (message.has_shape_correlation_meters() &&
      CheckFinite(message.shape_correlation_meters(),
                  path.Field("shape_correlation_meters"), violations)) {
    search->shape.correlation_meters = message.shape_correlation_meters();
  }
}

// The field of the messages that a setting of core's comes from.
std::string FieldOf(const std::string& setting) {
  const std::string shape = "shape.";
  return setting.compare(0, shape.size(), shape) == 0
             ? "shape_" + setting.substr(shape.size())
             : setting;
}

// Of settings that were read from this message. What is allowed may depend on
// others, so that a default can be wrong that nobody gave.
void AddProblems(const std::vector<core::SettingProblem>& problems,
                 const google::protobuf::Message& settings,
                 const FieldPath& path, Violations* violations) {
  for (const core::SettingProblem& problem : problems) {
    const std::string field = FieldOf(problem.field);
    const auto* const given = settings.GetDescriptor()->FindFieldByName(
        field.substr(0, field.find('.')));
    const bool left_out = given != nullptr &&
                          !settings.GetReflection()->HasField(settings, given);
    violations->Add(
        kInvalidField, path.Field(field.c_str()),
        problem.description + (left_out ? " (left out: its default)" : ""));
  }
}

// ---- Poses

// Where poses come from decides what they may leave out.
enum class PoseSource { kAppend, kRevision, kStored };

// J of the header.
template <int D>
core::StateMatrix<D> Jacobian(const std::vector<double>& m,
                              double heading_scale) {
  core::StateMatrix<D> j = core::StateMatrix<D>::Zero();
  for (int r = 0; r < D - 1; ++r) {
    for (int c = 0; c < D - 1; ++c) {
      j(r, c) = m[static_cast<std::size_t>(3 * r + c)];
    }
  }
  j(D - 1, D - 1) = heading_scale;
  return j;
}

template <int D>
core::StateMatrix<D> InverseJacobian(const std::vector<double>& m,
                                     double heading_scale) {
  core::StateMatrix<D> inverse = core::StateMatrix<D>::Zero();
  if constexpr (D == 3) {
    const double determinant = m[0] * m[4] - m[1] * m[3];
    inverse(0, 0) = m[4] / determinant;
    inverse(0, 1) = -m[1] / determinant;
    inverse(1, 0) = -m[3] / determinant;
    inverse(1, 1) = m[0] / determinant;
  } else {
    for (int r = 0; r < 3; ++r) {
      for (int c = 0; c < 3; ++c) {
        inverse(r, c) = m[static_cast<std::size_t>(3 * c + r)];
      }
    }
  }
  inverse(D - 1, D - 1) = 1.0 / heading_scale;
  return inverse;
}

template <int D>
void RotateUncertainty(const std::vector<double>& m, double heading_scale,
                       core::PoseSample* sample) {
  const core::StateMatrix<D> j = Jacobian<D>(m, heading_scale);
  const core::StateMatrix<D> covariance = core::ToMatrix<D>(sample->covariance);
  sample->covariance = core::ToCovariance<D>(j * covariance * j.transpose());
  if (sample->transition) {
    sample->transition =
        core::ToErrorTransition<D>(j * core::ToMatrix<D>(*sample->transition) *
                                   InverseJacobian<D>(m, heading_scale));
  }
}

class PoseDecoder {
 public:
  PoseDecoder(const VehicleConfig& config, PoseSource source,
              Violations* violations)
      : config_(config),
        source_(source),
        violations_(violations),
        spatial_(config.engine.state_space == core::StateSpace::kSpatial),
        filter_(config.engine.search.correlation_model ==
                core::CorrelationModel::kFilter),
        rotation_(9) {
    if (config.frame == CoordinateFrame::kGeodetic && config.origin) {
      SetOrigin(*config.origin);
    }
  }

  // Meaningless if it adds violations.
  core::PoseSample Decode(const v1::Pose& pose, const FieldPath& path) {
    const std::size_t violations_before = violations_->count();
    core::PoseSample sample;
    sample.sequence = pose.sequence();
    if (pose.sequence() < 1 || pose.sequence() > kMaxSequence) {
      Refuse(path.Field("sequence"),
             "got " + std::to_string(pose.sequence()) +
                 "; allowed is [1, 9223372036854775807]");
    }
    if (pose.has_stamp() &&
        CheckTimestamp(pose.stamp(), path.Field("stamp"), violations_)) {
      sample.stamp_ns = ToNanoseconds(pose.stamp());
    }
    DecodePosition(pose, path, &sample.pose);
    const std::optional<Forward> forward = DecodeOrientation(pose, path);
    DecodeCovariance(pose, path, &sample.covariance);
    DecodeTransition(pose, path, &sample);
    if (violations_->count() != violations_before) return sample;

    if (pose.has_geodetic()) {
      ToLocalFrame(pose, *forward, path, &sample);
    } else {
      sample.pose.heading = forward->heading;
    }
    if (violations_->count() != violations_before) return sample;
    if (const auto defect =
            core::FindDefect(sample, config_.engine.state_space)) {
      AddDefect(*defect, path);
    }
    return sample;
  }

  const std::optional<GeodeticOrigin>& origin() const { return origin_; }

 private:
  // The forward axis, and its heading, in the axes of the pose's own position.
  // Of a pose that is local, nobody asks for the axis.
  struct Forward {
    double heading = 0.0;
    std::array<double, 3> axis{};
  };

  void Refuse(const FieldPath& path, const std::string& description) {
    violations_->Add(kInvalidField, path, description);
  }

  void SetOrigin(const GeodeticOrigin& origin) {
    origin_ = origin;
    frame_.emplace(origin.latitude_degrees, origin.longitude_degrees,
                   origin.height_meters);
  }

  void DecodePosition(const v1::Pose& pose, const FieldPath& path,
                      core::Pose* position) {
    const bool geodetic_vehicle = config_.frame == CoordinateFrame::kGeodetic;
    switch (pose.position_case()) {
      case v1::Pose::kLocal: {
        const FieldPath local = path.Field("local");
        if (geodetic_vehicle && source_ == PoseSource::kAppend) {
          Refuse(local,
                 "got a local position; this vehicle's coordinate frame "
                 "is GEODETIC");
          return;
        }
        const double limit = core::kMaxCoordinateMeters;
        CheckRange(pose.local().x_meters(), -limit, limit,
                   local.Field("x_meters"), violations_);
        CheckRange(pose.local().y_meters(), -limit, limit,
                   local.Field("y_meters"), violations_);
        CheckRange(pose.local().z_meters(), -limit, limit,
                   local.Field("z_meters"), violations_);
        position->x = pose.local().x_meters();
        position->y = pose.local().y_meters();
        position->z = pose.local().z_meters();
        return;
      }
      case v1::Pose::kGeodetic:
        if (!geodetic_vehicle) {
          Refuse(path.Field("geodetic"),
                 "got a geodetic position; this vehicle's coordinate frame is "
                 "LOCAL");
          return;
        }
        CheckGeodetic(pose.geodetic(), path.Field("geodetic"), violations_);
        return;
      case v1::Pose::POSITION_NOT_SET:
        Refuse(path.Field("position"),
               std::string("required; this vehicle takes ") +
                   (geodetic_vehicle ? "`geodetic`" : "`local`"));
        return;
    }
  }

  std::optional<Forward> DecodeOrientation(const v1::Pose& pose,
                                           const FieldPath& path) {
    switch (pose.orientation_case()) {
      case v1::Pose::kHeadingRadians: {
        const double heading = pose.heading_radians();
        if (!CheckRange(heading, -core::kMaxHeadingRadians,
                        core::kMaxHeadingRadians, path.Field("heading_radians"),
                        violations_)) {
          return std::nullopt;
        }
        if (!pose.has_geodetic()) return Forward{heading, {}};
        return Forward{heading, {std::cos(heading), std::sin(heading), 0.0}};
      }
      case v1::Pose::kQuaternion:
        return DecodeQuaternion(pose.quaternion(), path.Field("quaternion"));
      case v1::Pose::ORIENTATION_NOT_SET:
        Refuse(path.Field("orientation"),
               "required: `heading_radians` or `quaternion`");
        return std::nullopt;
    }
    return std::nullopt;
  }

  std::optional<Forward> DecodeQuaternion(const v1::Quaternion& quaternion,
                                          const FieldPath& path) {
    double x = quaternion.x();
    double y = quaternion.y();
    double z = quaternion.z();
    double w = quaternion.w();
    bool finite = CheckFinite(x, path.Field("x"), violations_);
    finite &= CheckFinite(y, path.Field("y"), violations_);
    finite &= CheckFinite(z, path.Field("z"), violations_);
    finite &= CheckFinite(w, path.Field("w"), violations_);
    if (!finite) return std::nullopt;
    const double norm = std::hypot(std::hypot(x, y), std::hypot(z, w));
    if (!(std::abs(norm - 1.0) <= kMaxNormError)) {
      violations_->Add(kQuaternionInvalid, path,
                       "its norm is " + core::NumberText(norm) +
                           "; allowed is 1 to within 0.001");
      return std::nullopt;
    }
    x /= norm;
    y /= norm;
    z /= norm;
    w /= norm;
    Forward forward;
    forward.axis = {1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z),
                    2.0 * (x * z - w * y)};
    if (std::hypot(forward.axis[0], forward.axis[1]) <= kMinHorizontal) {
      violations_->Add(kQuaternionInvalid, path,
                       "the forward axis points straight up or down and has no "
                       "heading");
      return std::nullopt;
    }
    forward.heading = std::atan2(forward.axis[1], forward.axis[0]);
    return forward;
  }

  // Whether there are as many numbers as needed, all finite.
  bool CheckValues(const google::protobuf::RepeatedField<double>& values,
                   int needed, const char* form, const FieldPath& path,
                   Violations* violations) {
    if (values.size() != needed) {
      violations->Add("COVARIANCE_SIZE", path.Field("values"),
                      "got " + std::to_string(values.size()) + " numbers; " +
                          form + " has " + std::to_string(needed));
      return false;
    }
    bool finite = true;
    for (int i = 0; i < needed; ++i) {
      finite &=
          CheckFinite(values[i], path.At("values", static_cast<std::size_t>(i)),
                      violations);
    }
    return finite;
  }

  void DecodeCovariance(const v1::Pose& pose, const FieldPath& pose_path,
                        core::Covariance* covariance) {
    const FieldPath path = pose_path.Field("covariance");
    if (!pose.has_covariance()) {
      Refuse(path, "required");
      return;
    }
    const auto& values = pose.covariance().values();
    switch (pose.covariance().form()) {
      case v1::COVARIANCE_FORM_PLANAR_6: {
        if (spatial_) {
          Refuse(path.Field("form"),
                 "got PLANAR_6; this vehicle's state space is SPATIAL, which "
                 "takes SPATIAL_10 or ROS_36");
          return;
        }
        if (!CheckValues(values, 6, "PLANAR_6", path, violations_)) return;
        int next = 0;
        for (int r = 0; r < 3; ++r) {
          for (int c = r; c < 3; ++c) {
            (*covariance)(core::StateIndex<3>(r), core::StateIndex<3>(c)) =
                values[next++];
          }
        }
        return;
      }
      case v1::COVARIANCE_FORM_SPATIAL_10: {
        if (!CheckValues(values, 10, "SPATIAL_10", path, violations_)) return;
        int next = 0;
        for (int r = 0; r < 4; ++r) {
          for (int c = r; c < 4; ++c, ++next) {
            if (spatial_ || (r != 2 && c != 2)) {
              (*covariance)(r, c) = values[next];
            }
          }
        }
        return;
      }
      case v1::COVARIANCE_FORM_ROS_36: {
        if (!CheckValues(values, 36, "ROS_36", path, violations_)) return;
        ReduceRos(values, path, covariance);
        return;
      }
      default:
        Refuse(path.Field("form"),
               "got " +
                   std::to_string(static_cast<int>(pose.covariance().form())) +
                   "; required is " +
                   (spatial_ ? "SPATIAL_10 or ROS_36"
                             : "PLANAR_6, SPATIAL_10 or ROS_36"));
    }
  }

  // Takes the rows and columns x, y, (z) and rotation about z.
  void ReduceRos(const google::protobuf::RepeatedField<double>& values,
                 const FieldPath& path, core::Covariance* covariance) {
    static constexpr int kRosRow[] = {0, 1, 2, 5};
    std::array<int, 4> kept{0, 1, 2, 3};
    int size = 4;
    if (!spatial_) {
      kept = {0, 1, 3, 0};
      size = 3;
    }
    std::array<double, 16> reduced{};
    for (int r = 0; r < size; ++r) {
      for (int c = 0; c < size; ++c) {
        const double value = values[6 * kRosRow[kept[static_cast<size_t>(r)]] +
                                    kRosRow[kept[static_cast<size_t>(c)]]];
        reduced[static_cast<std::size_t>(size * r + c)] = value;
        if (c >= r) {
          (*covariance)(kept[static_cast<std::size_t>(r)],
                        kept[static_cast<std::size_t>(c)]) = value;
        }
      }
    }
    if (const auto defect = core::FindAsymmetry(reduced.data(), size)) {
      violations_->Add("COVARIANCE_NOT_SYMMETRIC", path.Field("values"),
                       "reduced to the state, " + defect->description);
    }
  }

  void DecodeTransition(const v1::Pose& pose, const FieldPath& path,
                        core::PoseSample* sample) {
    const int given = pose.error_transition_size();
    const FieldPath field = path.Field("error_transition");
    if (!filter_) {
      if (given != 0) {
        Refuse(field,
               "got " + std::to_string(given) +
                   " numbers; this vehicle's correlation model is not FILTER");
      }
      return;
    }
    const int size = spatial_ ? 4 : 3;
    const bool optional =
        pose.sequence() == 1 || source_ == PoseSource::kRevision;
    if (given == 0 && optional) return;
    if (given != size * size) {
      Refuse(field,
             "got " + std::to_string(given) +
                 " numbers; this vehicle's correlation model is FILTER and "
                 "needs " +
                 std::to_string(size * size));
      return;
    }
    core::ErrorTransition transition;
    bool finite = true;
    for (int i = 0; i < given; ++i) {
      const double value = pose.error_transition(i);
      finite &= CheckFinite(
          value, path.At("error_transition", static_cast<std::size_t>(i)),
          violations_);
      const auto coordinate = [this](int k) {
        return spatial_ ? k : core::StateIndex<3>(k);
      };
      transition.values[static_cast<std::size_t>(4 * coordinate(i / size) +
                                                 coordinate(i % size))] = value;
    }
    if (finite) sample->transition = transition;
  }

  // See the header. The origin is set by the first pose that can.
  void ToLocalFrame(const v1::Pose& pose, const Forward& forward,
                    const FieldPath& path, core::PoseSample* sample) {
    const v1::GeodeticPosition& position = pose.geodetic();
    if (!frame_) SetOrigin(ToOrigin(position));
    frame_->Forward(position.latitude_degrees(), position.longitude_degrees(),
                    position.height_meters(), sample->pose.x, sample->pose.y,
                    sample->pose.z, rotation_);
    const std::vector<double>& m = rotation_;
    const auto& f = forward.axis;
    const double x = m[0] * f[0] + m[1] * f[1] + m[2] * f[2];
    const double y = m[3] * f[0] + m[4] * f[1] + m[5] * f[2];
    const double squared = x * x + y * y;
    if (!(squared > kMinHorizontal * kMinHorizontal)) {
      Refuse(
          path.Field("orientation"),
          "so far from the vehicle's origin, the forward axis is vertical in "
          "the local frame and has no heading");
      return;
    }
    sample->pose.heading = std::atan2(y, x);
    // The forward axis turns along (-f[1], f[0], 0).
    const double turned_x = -m[0] * f[1] + m[1] * f[0];
    const double turned_y = -m[3] * f[1] + m[4] * f[0];
    const double heading_scale = (x * turned_y - y * turned_x) / squared;
    if (spatial_) {
      RotateUncertainty<4>(m, heading_scale, sample);
    } else {
      RotateUncertainty<3>(m, heading_scale, sample);
    }
  }

  void AddDefect(const core::Defect& defect, const FieldPath& path) {
    const char* reason = kInvalidField;
    switch (defect.kind) {
      case core::DefectKind::kNotFinite:
        reason = kNotFinite;
        break;
      case core::DefectKind::kOutOfRange:
        break;
      case core::DefectKind::kNotSymmetric:
        reason = "COVARIANCE_NOT_SYMMETRIC";
        break;
      case core::DefectKind::kNotPositiveDefinite:
        reason = "COVARIANCE_NOT_POSITIVE_DEFINITE";
        break;
    }
    const FieldPath part = path.Field(defect.part.c_str());
    violations_->Add(reason,
                     defect.part == "covariance" ? part.Field("values") : part,
                     defect.description);
  }

  const VehicleConfig& config_;
  const PoseSource source_;
  Violations* const violations_;
  const bool spatial_;
  const bool filter_;
  std::optional<GeodeticOrigin> origin_;
  std::optional<GeographicLib::LocalCartesian> frame_;
  // Row-major 3x3, kept to be used again.
  std::vector<double> rotation_;
};

void CheckFollows(const Poses& poses, int index, const FieldPath& path,
                  Violations* violations) {
  if (index == 0) return;
  const std::uint64_t expected = poses[index - 1].sequence() + 1;
  if (poses[index].sequence() == expected) return;
  violations->Add(kInvalidField, path.Field("sequence"),
                  "got " + std::to_string(poses[index].sequence()) +
                      "; the poses of a batch have consecutive sequences, "
                      "and after the pose before comes " +
                      std::to_string(expected));
}

// Serializes the poses as a PoseBatch, each once, for both payload and
// fingerprint.
void Fingerprint(const Poses& poses, DecodedBatch* batch) {
  using google::protobuf::io::CodedOutputStream;
  std::size_t bytes = 0;
  for (const v1::Pose& pose : poses) {
    const std::size_t size = pose.ByteSizeLong();
    bytes += 1 + size +
             static_cast<std::size_t>(CodedOutputStream::VarintSize32(
                 static_cast<std::uint32_t>(size)));
  }
  batch->payload.resize(bytes);
  batch->fingerprints.reserve(static_cast<std::size_t>(poses.size()));
  auto* next = reinterpret_cast<std::uint8_t*>(batch->payload.data());
  for (const v1::Pose& pose : poses) {
    const auto size = static_cast<std::uint32_t>(pose.GetCachedSize());
    next = CodedOutputStream::WriteTagToArray(kPosesTag, next);
    next = CodedOutputStream::WriteVarint32ToArray(size, next);
    std::uint8_t* const content = next;
    next = pose.SerializeWithCachedSizesToArray(content);
    batch->fingerprints.push_back(XXH3_64bits(content, size));
  }
}

absl::StatusOr<DecodedBatch> Decode(const Poses& poses,
                                    const VehicleConfig& config,
                                    PoseSource source, const FieldPath& path) {
  Violations violations;
  PoseDecoder decoder(config, source, &violations);
  DecodedBatch batch;
  batch.samples.reserve(static_cast<std::size_t>(poses.size()));
  for (int i = 0; i < poses.size(); ++i) {
    const FieldPath pose_path = path.At("poses", static_cast<std::size_t>(i));
    batch.samples.push_back(decoder.Decode(poses[i], pose_path));
    CheckFollows(poses, i, pose_path, &violations);
  }
  if (violations.count() > 0) return violations.ToStatus();
  Fingerprint(poses, &batch);
  batch.origin = decoder.origin();
  return batch;
}

absl::Status Corrupt(const std::string& what) {
  return Error(absl::StatusCode::kDataLoss, "STORE_CORRUPT", what);
}

absl::StatusOr<v1::PoseBatch> ParseBatch(const std::string& payload) {
  v1::PoseBatch batch;
  if (!batch.ParseFromString(payload)) {
    return Corrupt("a stored batch is not a PoseBatch");
  }
  return batch;
}

void EncodeCovariance(const core::Covariance& covariance,
                      core::StateSpace space, v1::Covariance* message) {
  if (space == core::StateSpace::kSpatial) {
    message->set_form(v1::COVARIANCE_FORM_SPATIAL_10);
    message->mutable_values()->Add(covariance.upper.begin(),
                                   covariance.upper.end());
    return;
  }
  message->set_form(v1::COVARIANCE_FORM_PLANAR_6);
  for (int r = 0; r < 3; ++r) {
    for (int c = r; c < 3; ++c) {
      message->add_values(
          covariance(core::StateIndex<3>(r), core::StateIndex<3>(c)));
    }
  }
}

void EncodeTransition(const core::ErrorTransition& transition,
                      core::StateSpace space, v1::Pose* pose) {
  pose->clear_error_transition();
  const int size = core::DegreesOfFreedom(space);
  const auto coordinate = [size](int k) {
    return size == 4 ? k : core::StateIndex<3>(k);
  };
  for (int r = 0; r < size; ++r) {
    for (int c = 0; c < size; ++c) {
      pose->add_error_transition(transition.values[static_cast<std::size_t>(
          4 * coordinate(r) + coordinate(c))]);
    }
  }
}

// Puts the estimate of `revised` into `stored`.
void Replace(const v1::Pose& revised, const VehicleConfig& config,
             v1::Pose* stored) {
  if (revised.error_transition_size() > 0) {
    *stored->mutable_error_transition() = revised.error_transition();
  } else if (stored->error_transition_size() > 0 && stored->has_geodetic() &&
             revised.has_local()) {
    // It speaks of the axes at the geodetic position, which go away.
    Violations violations;
    const core::PoseSample sample =
        PoseDecoder(config, PoseSource::kStored, &violations)
            .Decode(*stored, FieldPath());
    if (violations.count() == 0 && sample.transition) {
      EncodeTransition(*sample.transition, config.engine.state_space, stored);
    }
  }
  if (revised.has_local()) {
    *stored->mutable_local() = revised.local();
  } else {
    *stored->mutable_geodetic() = revised.geodetic();
  }
  if (revised.has_quaternion()) {
    *stored->mutable_quaternion() = revised.quaternion();
  } else {
    stored->set_heading_radians(revised.heading_radians());
  }
  *stored->mutable_covariance() = revised.covariance();
}

void EncodeTolerance(const core::PlaceTolerance& tolerance,
                     v1::PlaceTolerance* message) {
  message->set_position_meters(tolerance.position_meters);
  message->set_heading_radians(tolerance.heading_radians);
}

// Of the gate at the end, or of the whole path.
template <typename Message>
void EncodeGate(const core::GateResult& result, Message* gate) {
  gate->set_squared_mahalanobis_distance(result.squared_mahalanobis);
  // A whole number in Gate, as it is there.
  gate->set_degrees_of_freedom(
      static_cast<decltype(gate->degrees_of_freedom())>(
          result.degrees_of_freedom));
  gate->set_threshold(result.threshold);
  gate->set_p_value(result.p_value);
  gate->set_verdict(ToProto(kGateVerdicts, result.verdict));
}

void EncodeEvidence(const core::RelativeEvidence& evidence,
                    v1::Candidate* candidate) {
  candidate->set_probability(evidence.probability);
  if (evidence.odds_to_runner_up) {
    candidate->set_odds_to_runner_up(*evidence.odds_to_runner_up);
  }
  EncodeGate(evidence.path_gate, candidate->mutable_path_gate());
  candidate->mutable_path_gate()->set_end_squared_mahalanobis_distance(
      evidence.squared_end_difference);
  v1::ShapeEvidence* shape = candidate->mutable_shape();
  shape->set_overlap_meters(evidence.overlap_meters);
  shape->set_log_likelihood_ratio(evidence.log_likelihood_ratio);
}

const char* CollectionOf(PairKind kind) {
  return kind == PairKind::kLoopClosure ? "/loopClosures/"
                                        : "/rejectedCandidates/";
}

// LoopClosure and RejectedCandidate have the same fields.
template <typename Message>
absl::StatusOr<PosePairRecord> DecodePair(PairKind kind, const Message* pair,
                                          const std::string& id) {
  const char* const field = WordsOf(kind).field;
  const FieldPath request;
  const FieldPath path = request.Field(field);
  Violations violations;
  if (pair == nullptr) {
    violations.Add(kInvalidField, path, "required");
    return violations.ToStatus();
  }
  if (pair->query_sequence() == 0) {
    violations.Add(kInvalidField, path.Field("query_sequence"),
                   "required: sequences start at 1");
  }
  if (pair->matched_sequence() == 0) {
    violations.Add(kInvalidField, path.Field("matched_sequence"),
                   "required: sequences start at 1");
  } else if (pair->query_sequence() != 0 &&
             pair->matched_sequence() >= pair->query_sequence()) {
    violations.Add(kInvalidField, path.Field("matched_sequence"),
                   "got " + std::to_string(pair->matched_sequence()) +
                       "; allowed is less than query_sequence, " +
                       std::to_string(pair->query_sequence()));
  }
  if (violations.count() > 0) return violations.ToStatus();
  PosePairRecord record;
  record.id = !id.empty() ? id
                          : std::to_string(pair->query_sequence()) + "-" +
                                std::to_string(pair->matched_sequence());
  const std::string id_field = std::string(field) + "_id";
  if (absl::Status status = CheckId(record.id, request.Field(id_field.c_str()));
      !status.ok()) {
    return status;
  }
  record.query_sequence = pair->query_sequence();
  record.matched_sequence = pair->matched_sequence();
  return record;
}

template <typename Message>
void EncodePair(PairKind kind, const std::string& vehicle_id,
                const PosePairRecord& record, Message* message) {
  message->set_name(VehicleName(vehicle_id) + CollectionOf(kind) + record.id);
  message->set_query_sequence(record.query_sequence);
  message->set_matched_sequence(record.matched_sequence);
  EncodeTime(record.create_time_ns, message->mutable_create_time());
}

void EncodeConsistency(const core::Consistency& consistency, bool applied,
                       v1::Consistency* message) {
  message->set_confirmed_count(consistency.confirmed);
  message->set_rejected_count(consistency.rejected);
  if (consistency.mean_normalized_innovation_squared) {
    message->set_mean_normalized_innovation_squared(
        *consistency.mean_normalized_innovation_squared);
  }
  message->set_degrees_of_freedom(consistency.degrees_of_freedom);
  message->set_inflation(consistency.inflation);
  message->set_applied(applied);
}

// Fields of VehicleSettings that the mask names, below `vehicle`.
absl::StatusOr<std::vector<const google::protobuf::FieldDescriptor*>>
MaskedSettings(const google::protobuf::FieldMask& mask) {
  const std::string prefix = "settings.";
  const auto* descriptor = v1::VehicleSettings::descriptor();
  const FieldPath path = FieldPath().Field("update_mask");
  std::set<const google::protobuf::FieldDescriptor*> fields;
  Violations violations;
  if (mask.paths().empty()) {
    violations.Add(kInvalidField, path,
                   "required: name the settings that change, such as "
                   "\"settings.max_candidates\"");
  }
  for (int i = 0; i < mask.paths_size(); ++i) {
    const std::string& name = mask.paths(i);
    if (name == "settings") {
      for (int f = 0; f < descriptor->field_count(); ++f) {
        fields.insert(descriptor->field(f));
      }
      continue;
    }
    const auto* field =
        name.compare(0, prefix.size(), prefix) == 0
            ? descriptor->FindFieldByName(name.substr(prefix.size()))
            : nullptr;
    if (field == nullptr) {
      violations.Add(kInvalidField,
                     path.At("paths", static_cast<std::size_t>(i)),
                     "got " + Quoted(name) +
                         "; allowed are \"settings\" and \"settings.\" with "
                         "the name of a setting, which changes as a whole");
      continue;
    }
    fields.insert(field);
  }
  if (violations.count() > 0) return violations.ToStatus();
  return std::vector<const google::protobuf::FieldDescriptor*>(fields.begin(),
                                                               fields.end());
}

absl::Status SettingFixed(const char* setting,
                          const char* change = "cannot change") {
  return Error(absl::StatusCode::kFailedPrecondition, "SETTING_FIXED",
               std::string("settings.") + setting + " " + change +
                   ": the vehicle has poses",
               {{"field", std::string("settings.") + setting}});
}

bool SameOrigin(const std::optional<GeodeticOrigin>& a,
                const std::optional<GeodeticOrigin>& b) {
  if (!a || !b) return !a && !b;
  return a->latitude_degrees == b->latitude_degrees &&
         a->longitude_degrees == b->longitude_degrees &&
         a->height_meters == b->height_meters;
}

}  // namespace

// ---- Names

std::string VehicleName(const std::string& vehicle_id) {
  return "vehicles/" + vehicle_id;
}

absl::Status CheckId(const std::string& id, const FieldPath& path) {
  const auto alphanumeric = [](char c) {
    return (c >= 'a' && c <= 'z') || (c >= '0' && c <= '9');
  };
  const bool matches = !id.empty() && id.size() <= 63 &&
                       alphanumeric(id.front()) && alphanumeric(id.back()) &&
                       std::all_of(id.begin(), id.end(), [&](char c) {
                         return alphanumeric(c) || c == '-';
                       });
  if (matches) return absl::OkStatus();
  return InvalidField("INVALID_RESOURCE_NAME", path,
                      "got " + Quoted(id) +
                          "; an id is 1 to 63 lower-case letters, digits and "
                          "hyphens, with no hyphen at either end");
}

absl::Status CheckUid(const std::string& uid, const FieldPath& path) {
  if (uid.empty() || IsUuid(uid)) return absl::OkStatus();
  return InvalidField(kInvalidField, path,
                      "got " + Quoted(uid) +
                          "; a uid is 8-4-4-4-12 hexadecimal digits in lower "
                          "case, as Vehicle.uid has it");
}

absl::StatusOr<std::string> ParseVehicleName(const std::string& name,
                                             const FieldPath& path) {
  const std::string collection = "vehicles/";
  if (name.compare(0, collection.size(), collection) != 0) {
    return InvalidField(
        "INVALID_RESOURCE_NAME", path,
        "got " + Quoted(name) + "; the form is vehicles/{vehicle}");
  }
  const std::string id = name.substr(collection.size());
  if (absl::Status status = CheckId(id, path); !status.ok()) return status;
  return id;
}

absl::StatusOr<PosePairName> ParsePosePairName(PairKind kind,
                                               const std::string& name,
                                               const FieldPath& path) {
  const std::string collection = CollectionOf(kind);
  const std::size_t at = name.find(collection);
  if (at == std::string::npos) {
    return InvalidField("INVALID_RESOURCE_NAME", path,
                        "got " + Quoted(name) +
                            "; the form is vehicles/{vehicle}" + collection +
                            "{" + WordsOf(kind).field + "}");
  }
  absl::StatusOr<std::string> vehicle =
      ParseVehicleName(name.substr(0, at), path);
  if (!vehicle.ok()) return vehicle.status();
  PosePairName parsed{*vehicle, name.substr(at + collection.size())};
  if (absl::Status status = CheckId(parsed.id, path); !status.ok()) {
    return status;
  }
  return parsed;
}

// ---- Vehicles and their settings

absl::StatusOr<VehicleConfig> DecodeSettings(
    const v1::VehicleSettings& settings, const FieldPath& path) {
  Violations violations;
  VehicleConfig config;
  core::EngineSettings& engine = config.engine;
  DecodeEnum(kStateSpaces, settings.state_space(), path.Field("state_space"),
             &engine.state_space, &violations);
  DecodeEnum(kCoordinateFrames, settings.coordinate_frame(),
             path.Field("coordinate_frame"), &config.frame, &violations);
  if (settings.has_geodetic_origin()) {
    const FieldPath origin = path.Field("geodetic_origin");
    CheckGeodetic(settings.geodetic_origin(), origin, &violations);
    if (config.frame == CoordinateFrame::kGeodetic) {
      config.origin = ToOrigin(settings.geodetic_origin());
    } else {
      violations.Add(kInvalidField, origin,
                     "allowed only where the coordinate frame is GEODETIC");
    }
  }
  if (settings.has_node_spacing_meters() &&
      CheckFinite(settings.node_spacing_meters(),
                  path.Field("node_spacing_meters"), &violations)) {
    engine.node_spacing_meters = settings.node_spacing_meters();
  }
  if (settings.has_check_interval_meters() &&
      CheckFinite(settings.check_interval_meters(),
                  path.Field("check_interval_meters"), &violations)) {
    engine.check_interval_meters = settings.check_interval_meters();
  }
  if (!settings.has_max_step_meters()) {
    engine.max_step_meters = core::DefaultMaxStep(engine.node_spacing_meters);
  } else if (CheckFinite(settings.max_step_meters(),
                         path.Field("max_step_meters"), &violations)) {
    engine.max_step_meters = settings.max_step_meters();
  }
  if (settings.has_apply_inflation()) {
    engine.apply_inflation = settings.apply_inflation();
  }
  if (settings.has_max_inflation() &&
      CheckFinite(settings.max_inflation(), path.Field("max_inflation"),
                  &violations)) {
    engine.max_inflation = settings.max_inflation();
  }
  DecodeSearch(settings, path, &engine.search, &violations);
  AddProblems(core::FindProblems(engine), settings, path, &violations);
  if (violations.count() > 0) return violations.ToStatus();
  return config;
}

void EncodeSettings(const VehicleConfig& config,
                    v1::VehicleSettings* settings) {
  const core::EngineSettings& engine = config.engine;
  const core::SearchOptions& search = engine.search;
  settings->set_state_space(ToProto(kStateSpaces, engine.state_space));
  settings->set_correlation_model(
      ToProto(kCorrelationModels, search.correlation_model));
  settings->set_likelihood_form(
      ToProto(kLikelihoodForms, search.likelihood_form));
  settings->set_coordinate_frame(ToProto(kCoordinateFrames, config.frame));
  settings->clear_geodetic_origin();
  if (config.origin) {
    auto* origin = settings->mutable_geodetic_origin();
    origin->set_latitude_degrees(config.origin->latitude_degrees);
    origin->set_longitude_degrees(config.origin->longitude_degrees);
    origin->set_height_meters(config.origin->height_meters);
  }
  settings->set_node_spacing_meters(engine.node_spacing_meters);
  settings->set_sequence_length_meters(search.sequence_length_meters);
  settings->set_check_interval_meters(engine.check_interval_meters);
  settings->set_max_step_meters(engine.max_step_meters);
  settings->set_gate_probability(search.gate_probability);
  EncodeTolerance(search.place_tolerance, settings->mutable_place_tolerance());
  settings->set_candidate_separation_meters(search.candidate_separation_meters);
  settings->set_max_candidates(search.max_candidates);
  settings->set_alignment(ToProto(kAlignments, search.alignment));
  settings->set_acceptance_probability(search.acceptance_probability);
  settings->set_road_spacing_meters(search.road_spacing_meters);
  EncodeTolerance(search.shape.tolerance, settings->mutable_shape_tolerance());
  settings->set_shape_correlation_meters(search.shape.correlation_meters);
  settings->set_apply_inflation(engine.apply_inflation);
  settings->set_max_inflation(engine.max_inflation);
}

absl::StatusOr<VehicleConfig> UpdateSettings(
    const VehicleConfig& current, bool has_poses,
    const v1::VehicleSettings& settings,
    const google::protobuf::FieldMask& update_mask) {
  const auto fields = MaskedSettings(update_mask);
  if (!fields.ok()) return fields.status();
  v1::VehicleSettings merged;
  EncodeSettings(current, &merged);
  v1::VehicleSettings given = settings;
  // What is named but not given becomes unset, which decodes to its default.
  v1::VehicleSettings::GetReflection()->SwapFields(&merged, &given, *fields);
  absl::StatusOr<VehicleConfig> updated =
      DecodeSettings(merged, FieldPath().Field("vehicle").Field("settings"));
  if (!updated.ok()) return updated.status();
  updated->create_time_ns = current.create_time_ns;
  updated->data_loss = current.data_loss;
  updated->uid = current.uid;
  if (!has_poses) return updated;

  const auto filter = [](const VehicleConfig& config) {
    return config.engine.search.correlation_model ==
           core::CorrelationModel::kFilter;
  };
  if (updated->engine.state_space != current.engine.state_space) {
    return SettingFixed("state_space");
  }
  if (filter(*updated) != filter(current)) {
    return SettingFixed("correlation_model",
                        filter(*updated) ? "cannot become FILTER"
                                         : "cannot be other than FILTER");
  }
  if (updated->frame != current.frame) return SettingFixed("coordinate_frame");
  // By default the origin is that of the first pose, which is there already.
  if (!updated->origin) updated->origin = current.origin;
  if (!SameOrigin(updated->origin, current.origin)) {
    return SettingFixed("geodetic_origin");
  }
  return updated;
}

bool SameSettings(const VehicleConfig& existing,
                  const VehicleConfig& requested) {
  v1::VehicleSettings a;
  v1::VehicleSettings b;
  EncodeSettings(existing, &a);
  EncodeSettings(requested, &b);
  if (!requested.origin) a.clear_geodetic_origin();
  return a.SerializeAsString() == b.SerializeAsString();
}

namespace {

void EncodeConfig(const VehicleConfig& config, v1::Vehicle* vehicle) {
  EncodeSettings(config, vehicle->mutable_settings());
  vehicle->set_state(config.data_loss ? v1::VEHICLE_STATE_DATA_LOSS
                                      : v1::VEHICLE_STATE_ACTIVE);
  EncodeTime(config.create_time_ns, vehicle->mutable_create_time());
  vehicle->set_uid(config.uid);
}

}  // namespace

void EncodeVehicle(const VehicleView& view, v1::Vehicle* vehicle) {
  vehicle->set_name(VehicleName(view.id));
  if (view.config_is_known) EncodeConfig(view.config, vehicle);
  if (!view.damage.ok()) vehicle->set_state(v1::VEHICLE_STATE_DAMAGED);
  vehicle->set_durable_sequence(view.durable_sequence);
  vehicle->set_revision(view.revision);
  vehicle->set_node_count(view.engine.graph().size());
  vehicle->set_loop_closure_count(view.loop_closure_count);
  vehicle->set_travelled_meters(view.engine.travelled_meters());
  if (!view.config_is_known) return;
  EncodeConsistency(view.engine.consistency(),
                    view.config.engine.apply_inflation,
                    vehicle->mutable_consistency());
}

void EncodeVehicle(const VehicleRecord& record, v1::Vehicle* vehicle) {
  const absl::StatusOr<VehicleConfig> config =
      ProtoRecordCodec().DecodeVehicle(record);
  std::string name = VehicleName(record.id);
  // A damaged one may hold bytes that no message can.
  std::replace_if(
      name.begin(), name.end(), [](char c) { return c < ' ' || c > '~'; }, '?');
  vehicle->set_name(name);
  if (config.ok()) EncodeConfig(*config, vehicle);
  if (!config.ok() || !record.damage.ok()) {
    vehicle->set_state(v1::VEHICLE_STATE_DAMAGED);
    return;
  }
  vehicle->set_revision(record.revision);
  vehicle->set_durable_sequence(record.durable_sequence);
  vehicle->set_loop_closure_count(record.loop_closure_count);
}

absl::StatusOr<core::SearchOptions> DecodeCandidateOptions(
    const v1::CandidateOptions& options, const VehicleConfig& config,
    const FieldPath& path) {
  Violations violations;
  core::SearchOptions search = config.engine.search;
  DecodeSearch(options, path, &search, &violations);
  search.exhaustive = options.exhaustive();
  search.tell_paths = options.include_aligned_path();
  DecodeEnum(kSearchDirections, options.direction(), path.Field("direction"),
             &search.direction, &violations);
  AddProblems(core::FindProblems(search, config.engine), options, path,
              &violations);
  if (violations.count() > 0) return violations.ToStatus();
  return search;
}

// ---- Poses

absl::StatusOr<DecodedBatch> DecodeBatch(const Poses& poses, int max_poses,
                                         const VehicleConfig& config,
                                         const FieldPath& path) {
  if (poses.empty() || poses.size() > max_poses) {
    return InvalidField("BATCH_SIZE", path.Field("poses"),
                        "got " + std::to_string(poses.size()) +
                            " poses; allowed is [1, " +
                            std::to_string(max_poses) + "]");
  }
  return Decode(poses, config, PoseSource::kAppend, path);
}

void DropUnknownFields(Poses* poses) {
  // Asked of each message first: dropping visits every field by reflection.
  const auto is_clean = [](bool has, const google::protobuf::Message& message) {
    return !has || message.GetReflection()->GetUnknownFields(message).empty();
  };
  for (v1::Pose& pose : *poses) {
    if (is_clean(true, pose) && is_clean(pose.has_stamp(), pose.stamp()) &&
        is_clean(pose.has_local(), pose.local()) &&
        is_clean(pose.has_geodetic(), pose.geodetic()) &&
        is_clean(pose.has_quaternion(), pose.quaternion()) &&
        is_clean(pose.has_covariance(), pose.covariance())) {
      continue;
    }
    pose.DiscardUnknownFields();
  }
}

absl::Status CheckRevisedPoses(const Poses& poses, std::size_t first_number,
                               const VehicleConfig& config) {
  Violations violations;
  PoseDecoder decoder(config, PoseSource::kRevision, &violations);
  std::size_t number = first_number;
  for (const v1::Pose& pose : poses) {
    decoder.Decode(pose, FieldPath().At("poses", number++));
  }
  return violations.ToStatus();
}

absl::StatusOr<std::optional<BatchRecord>> ReviseBatch(
    const BatchRecord& stored, const VehicleConfig& config,
    const RevisedPose& revised) {
  absl::StatusOr<v1::PoseBatch> batch = ParseBatch(stored.payload);
  if (!batch.ok()) return batch.status();
  bool any = false;
  for (v1::Pose& pose : *batch->mutable_poses()) {
    const v1::Pose* replacement = revised(pose.sequence());
    if (replacement == nullptr) continue;
    any = true;
    Replace(*replacement, config, &pose);
  }
  if (!any) return std::optional<BatchRecord>();
  BatchRecord record;
  record.first_sequence = stored.first_sequence;
  record.count = stored.count;
  record.payload = batch->SerializeAsString();
  return std::optional<BatchRecord>(std::move(record));
}

absl::Status VisitPoses(const BatchRecord& stored,
                        const std::function<bool(v1::Pose*)>& visit) {
  absl::StatusOr<v1::PoseBatch> batch = ParseBatch(stored.payload);
  if (!batch.ok()) return batch.status();
  // Earlier servers stored what they did not know.
  DropUnknownFields(batch->mutable_poses());
  for (v1::Pose& pose : *batch->mutable_poses()) {
    if (!visit(&pose)) break;
  }
  return absl::OkStatus();
}

std::string ProtoRecordCodec::EncodeVehicle(const VehicleConfig& config) const {
  v1::Vehicle vehicle;
  EncodeConfig(config, &vehicle);
  return vehicle.SerializeAsString();
}

absl::StatusOr<VehicleConfig> ProtoRecordCodec::DecodeVehicle(
    const VehicleRecord& record) const {
  v1::Vehicle vehicle;
  if (!vehicle.ParseFromString(record.payload)) {
    return Corrupt("a stored vehicle is not a Vehicle");
  }
  absl::StatusOr<VehicleConfig> config =
      DecodeSettings(vehicle.settings(), FieldPath().Field("settings"));
  if (!config.ok()) {
    return Corrupt("a stored vehicle does not decode: " +
                   std::string(config.status().message()));
  }
  Violations violations;
  if (!vehicle.has_create_time() ||
      !CheckTimestamp(vehicle.create_time(), FieldPath(), &violations)) {
    return Corrupt("a stored vehicle has no creation time");
  }
  config->create_time_ns = ToNanoseconds(vehicle.create_time());
  config->data_loss = vehicle.state() == v1::VEHICLE_STATE_DATA_LOSS;
  config->uid =
      vehicle.uid().empty()
          ? DerivedVehicleUid(record.key, record.id, config->create_time_ns)
          : vehicle.uid();
  return config;
}

absl::StatusOr<DecodedBatch> ProtoRecordCodec::DecodeBatch(
    const std::string& payload, const VehicleConfig& config) const {
  const absl::StatusOr<v1::PoseBatch> batch = ParseBatch(payload);
  if (!batch.ok()) return batch.status();
  absl::StatusOr<DecodedBatch> decoded =
      Decode(batch->poses(), config, PoseSource::kStored, FieldPath());
  if (!decoded.ok()) {
    return Corrupt("a stored batch does not decode: " +
                   std::string(decoded.status().message()));
  }
  return decoded;
}

absl::StatusOr<std::string> ProtoRecordCodec::SliceBatch(
    const std::string& payload, std::size_t first, std::size_t count) const {
  absl::StatusOr<v1::PoseBatch> batch = ParseBatch(payload);
  if (!batch.ok()) return batch.status();
  const auto size = static_cast<std::size_t>(batch->poses_size());
  if (first > size || count > size - first) {
    return Corrupt("a stored batch has " + std::to_string(size) +
                   " poses; asked for " + std::to_string(count) + " from " +
                   std::to_string(first));
  }
  Poses* poses = batch->mutable_poses();
  poses->DeleteSubrange(static_cast<int>(first + count),
                        static_cast<int>(size - first - count));
  poses->DeleteSubrange(0, static_cast<int>(first));
  return batch->SerializeAsString();
}

// ---- Pairs of poses

absl::StatusOr<PosePairRecord> DecodePosePair(const v1::LoopClosure* pair,
                                              const std::string& id) {
  return DecodePair(PairKind::kLoopClosure, pair, id);
}

absl::StatusOr<PosePairRecord> DecodePosePair(const v1::RejectedCandidate* pair,
                                              const std::string& id) {
  return DecodePair(PairKind::kRejectedCandidate, pair, id);
}

void EncodePosePair(const std::string& vehicle_id, const PosePairRecord& record,
                    v1::LoopClosure* message) {
  EncodePair(PairKind::kLoopClosure, vehicle_id, record, message);
}

void EncodePosePair(const std::string& vehicle_id, const PosePairRecord& record,
                    v1::RejectedCandidate* message) {
  EncodePair(PairKind::kRejectedCandidate, vehicle_id, record, message);
}

// ---- Answers

void EncodeAck(const Acknowledgement& acknowledgement, v1::Ack* ack) {
  ack->set_durable_sequence(acknowledgement.durable_sequence);
  ack->set_revision(acknowledgement.revision);
  ack->clear_jumps();
  for (const core::Jump& jump : acknowledgement.jumps) {
    v1::Jump* added = ack->add_jumps();
    added->set_sequence(jump.sequence);
    added->set_distance_meters(jump.distance_meters);
  }
}

void EncodeNode(const core::PoseGraph& graph, core::NodeIndex index,
                core::StateSpace space, bool with_covariance, v1::Node* node) {
  const core::Node from = graph.node(index);
  node->set_index(index);
  node->set_sequence(from.sequence);
  node->set_fraction(from.fraction);
  if (from.stamp_ns) EncodeTime(*from.stamp_ns, node->mutable_stamp());
  node->set_travelled_meters(from.travelled_meters);
  v1::StatePose* pose = node->mutable_pose();
  pose->set_x_meters(from.pose.x);
  pose->set_y_meters(from.pose.y);
  if (space == core::StateSpace::kSpatial) pose->set_z_meters(from.pose.z);
  pose->set_heading_radians(from.pose.heading);
  if (with_covariance) {
    EncodeCovariance(from.covariance, space, node->mutable_covariance());
  }
}

void EncodeCandidateSet(const VehicleView& view, const core::CandidateSet& set,
                        bool include_aligned_path,
                        std::chrono::nanoseconds search_duration,
                        v1::CandidateSet* message) {
  const core::PoseGraph& graph = view.engine.graph();
  const core::StateSpace space = view.config.engine.state_space;
  if (set.query) {
    EncodeNode(graph, *set.query, space, false, message->mutable_query());
  }
  message->set_revision(view.revision);
  for (const core::Candidate& candidate : set.candidates) {
    v1::Candidate* added = message->add_candidates();
    added->set_rank(candidate.rank);
    added->set_score(candidate.score);
    *added->mutable_query() = message->query();
    EncodeNode(graph, candidate.matched, space, false,
               added->mutable_matched());
    EncodeGate(candidate.difference.gate, added->mutable_gate());
    added->mutable_gate()->set_inflation(set.inflation);
    added->set_verdict(ToProto(kVerdicts, candidate.verdict));
    added->set_direction(ToProto(kDirections, candidate.direction));
    if (candidate.relative) EncodeEvidence(*candidate.relative, added);
    const core::Pose& difference = candidate.difference.difference;
    v1::PoseDifference* encoded = added->mutable_difference();
    encoded->set_x_meters(difference.x);
    encoded->set_y_meters(difference.y);
    if (space == core::StateSpace::kSpatial) {
      encoded->set_z_meters(difference.z);
    }
    encoded->set_heading_radians(difference.heading);
    EncodeCovariance(candidate.difference.covariance, space,
                     encoded->mutable_covariance());
    if (!include_aligned_path) continue;
    for (const auto& [query_index, matched_index] : candidate.path) {
      v1::AlignedPair* pair = added->add_aligned_path();
      pair->set_query_index(query_index);
      pair->set_matched_index(matched_index);
    }
  }
  message->set_empty_reason(ToProto(kEmptyReasons, set.empty_reason));
  message->set_nodes_considered(set.nodes_considered);
  message->set_nodes_pruned(set.nodes_pruned);
  if (set.new_place_probability) {
    message->set_new_place_probability(*set.new_place_probability);
  }
  message->mutable_search_duration()->set_seconds(search_duration.count() /
                                                  kNanosPerSecond);
  message->mutable_search_duration()->set_nanos(
      static_cast<std::int32_t>(search_duration.count() % kNanosPerSecond));
}

}  // namespace revisit::server
