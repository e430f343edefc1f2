// Signs that poses are in other axes or units than the API's: cheap to see, and
// seldom right for a vehicle. They are WarningReason in the proto, which states
// each; the figures are here.
#ifndef REVISIT_SERVER_CONVERSION_POSE_INSPECTION_H_
#define REVISIT_SERVER_CONVERSION_POSE_INSPECTION_H_

#include <cstddef>
#include <cstdint>
#include <optional>
#include <vector>

#include "core/geometry/pose.h"
#include "google/protobuf/repeated_field.h"
#include "revisit/v1/pose_graph_service.pb.h"
#include "server/sessions/vehicle_config.h"

namespace revisit::server {

// Looks at the first poses of a stream as they come. Each sign is reported
// once.
class PoseInspector {
 public:
  using Warnings = google::protobuf::RepeatedPtrField<v1::Warning>;

  // Poses beyond this number are not looked at.
  static constexpr int kMostPoses = 10'000;
  // The motion is judged once, over at least this many steps and metres.
  static constexpr std::size_t kLeastSteps = 10;
  static constexpr double kLeastMeters = 50.0;
  static constexpr double kMostCourseDegrees = 20.0;
  static constexpr double kMostMetersPerSecond = 150.0;
  // What a path has to reach up and down, more than sideways, to be steep.
  static constexpr double kLeastSteepMeters = 20.0;
  // Positions that look like degrees are judged over at least so much.
  static constexpr int kLeastCreepingPoses = 50;
  static constexpr double kLeastCreepingSeconds = 5.0;
  static constexpr double kMostCreepingMetersPerSecond = 1e-3;
  static constexpr double kLeastCreepingMetersPerSecond = 1e-7;

  explicit PoseInspector(CoordinateFrame frame) : frame_(frame) {}

  // Looks at poses that follow each other, and adds what they show.
  void Look(const std::vector<core::PoseSample>& samples, Warnings* warnings);

  // Whether nothing more will be looked at.
  bool done() const { return looked_ >= kMostPoses; }

 private:
  // The way from one pose to a later one, far enough apart that their errors
  // matter little.
  struct Step {
    core::Pose end;
    // Heading less course, in (-pi, pi]; absent for steep steps.
    std::optional<double> off_course;
    // Absent without stamps.
    std::optional<double> meters_per_second;
  };

  void BeginFrame(const core::PoseSample& sample);
  void LookAtHeading(const core::PoseSample& sample, Warnings* warnings);
  void LookAtStamps(const core::PoseSample& sample, Warnings* warnings);
  void LookAtMotion(const core::PoseSample& sample, Warnings* warnings);
  void LookForDegrees(const core::PoseSample& sample, Warnings* warnings);
  void JudgeMotion(std::uint64_t sequence, Warnings* warnings) const;
  // How far the steps reach along one axis.
  double Extent(double core::Pose::*coordinate) const;
  void JudgeCourse(std::uint64_t sequence, Warnings* warnings) const;

  const CoordinateFrame frame_;
  int looked_ = 0;
  // The first pose in the present frame, and its number among all.
  std::optional<core::PoseSample> first_;
  int first_looked_ = 0;
  core::PoseSample last_;
  bool warned_of_heading_ = false;
  bool warned_of_stamps_ = false;
  bool warned_of_degrees_ = false;
  // The motion: where the next step begins, and the steps so far.
  bool motion_is_judged_ = false;
  core::PoseSample step_start_;
  std::vector<Step> steps_;
  double step_meters_ = 0.0;
  // Sum of the distances between consecutive poses.
  double path_meters_ = 0.0;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_CONVERSION_POSE_INSPECTION_H_
