#include "server/conversion/pose_columns_answer.h"

#include <cstddef>
#include <cstring>
#include <string>

#include "absl/strings/str_cat.h"
#include "absl/strings/string_view.h"
#include "server/fields/covariances.h"
#include "server/fields/pose_fields.h"
#include "server/fields/timestamps.h"
#include "server/records/wire_bytes.h"

namespace revisit::server {
namespace {

using Doubles = google::protobuf::RepeatedField<double>;

// Whether a mask leaves a field of a position in, of either kind.
bool Includes(const google::protobuf::FieldMask& mask, absl::string_view local,
              absl::string_view geodetic) {
  for (const std::string& path : mask.paths()) {
    if (path == "local" || path == "geodetic" ||
        path == absl::StrCat("local.", local) ||
        path == absl::StrCat("geodetic.", geodetic)) {
      return true;
    }
  }
  return mask.paths().empty();
}

// -0.0 is none.
bool IsZero(double value) { return BitsOf(value) == 0; }

bool AreZeros(const Doubles& values) {
  for (const double value : values) {
    if (!IsZero(value)) return false;
  }
  return true;
}

int RowsOf(v1::CovarianceForm form) {
  return static_cast<int>(server::RowsOf(static_cast<CovarianceForm>(form)));
}

// Whether each `size` values are those before them, to the bit.
bool Repeat(const Doubles& values, int size) {
  for (int i = size; i < values.size(); i += size) {
    if (std::memcmp(values.data(), values.data() + i,
                    static_cast<std::size_t>(size) * sizeof(double)) != 0) {
      return false;
    }
  }
  return true;
}

// Adds the variances of these covariances; false if another entry is not 0.
bool AddVariances(const Doubles& values, v1::CovarianceForm form,
                  Doubles* variances) {
  const int rows = RowsOf(form);
  const bool is_full = form == v1::COVARIANCE_FORM_ROS_36;
  for (int i = 0; i < values.size();) {
    for (int r = 0; r < rows; ++r) {
      for (int c = is_full ? 0 : r; c < rows; ++c, ++i) {
        if (r == c) {
          variances->Add(values[i]);
        } else if (!IsZero(values[i])) {
          return false;
        }
      }
    }
  }
  return true;
}

}  // namespace

PoseColumnsAnswer::PoseColumnsAnswer(const google::protobuf::FieldMask& mask,
                                     int most_poses, Messages* messages)
    : has_x_(Includes(mask, "x_meters", "latitude_degrees")),
      has_y_(Includes(mask, "y_meters", "longitude_degrees")),
      has_z_(Includes(mask, "z_meters", "height_meters")),
      most_poses_(most_poses),
      messages_(messages) {}

bool PoseColumnsAnswer::Fits(const v1::Pose& pose,
                             std::uint64_t sequence) const {
  if (current_ == nullptr || current_->pose_count() == most_poses_ ||
      sequence != last_sequence_ + 1 || pose.has_recording_start() ||
      pose.has_stamp() != current_->has_first_stamp() ||
      pose.position_case() != position_ ||
      pose.orientation_case() != orientation_ ||
      pose.has_covariance() != has_covariance_ ||
      pose.covariance().form() != current_->covariance_form() ||
      pose.covariance().values_size() != covariance_values_) {
    return false;
  }
  // The first of a recording has no transition.
  const bool first_has_none = transition_ == 0 && current_->pose_count() == 1;
  if (pose.error_transition_size() != transition_ && !first_has_none) {
    return false;
  }
  std::int64_t step = 0;
  return !pose.has_stamp() ||
         !__builtin_sub_overflow(ToNanoseconds(pose.stamp()), last_stamp_ns_,
                                 &step);
}

void PoseColumnsAnswer::Begin(const v1::Pose& pose) {
  Finish();
  current_ = messages_->Add();
  current_->set_first_sequence(pose.sequence());
  current_->set_covariance_form(pose.covariance().form());
  if (pose.has_stamp()) *current_->mutable_first_stamp() = pose.stamp();
  if (pose.has_recording_start()) {
    *current_->mutable_recording_start() = pose.recording_start();
  }
  position_ = pose.position_case();
  orientation_ = pose.orientation_case();
  has_covariance_ = pose.has_covariance();
  covariance_values_ = pose.covariance().values_size();
}

void PoseColumnsAnswer::Add(const v1::Pose& pose, std::uint64_t sequence) {
  const bool fits = Fits(pose, sequence);
  if (!fits) Begin(pose);
  if (pose.has_stamp()) {
    const std::int64_t stamp_ns = ToNanoseconds(pose.stamp());
    if (fits) current_->add_stamp_step_nanos(stamp_ns - last_stamp_ns_);
    last_stamp_ns_ = stamp_ns;
  }
  AddPosition(pose);
  if (pose.has_heading_radians()) {
    current_->add_heading_radians(pose.heading_radians());
  } else if (pose.has_quaternion()) {
    const v1::Quaternion& turn = pose.quaternion();
    for (const double part : {turn.x(), turn.y(), turn.z(), turn.w()}) {
      current_->add_quaternions(part);
    }
  }
  current_->mutable_covariances()->MergeFrom(pose.covariance().values());
  current_->mutable_error_transitions()->MergeFrom(pose.error_transition());
  transition_ = pose.error_transition_size();
  current_->set_pose_count(current_->pose_count() + 1);
  last_sequence_ = sequence;
}

void PoseColumnsAnswer::AddPosition(const v1::Pose& pose) {
  if (pose.has_local()) {
    const v1::LocalPosition& local = pose.local();
    if (has_x_) current_->add_x_meters(local.x_meters());
    if (has_y_) current_->add_y_meters(local.y_meters());
    if (has_z_) current_->add_z_meters(local.z_meters());
  } else if (pose.has_geodetic()) {
    const v1::GeodeticPosition& geodetic = pose.geodetic();
    if (has_x_) current_->add_latitude_degrees(geodetic.latitude_degrees());
    if (has_y_) current_->add_longitude_degrees(geodetic.longitude_degrees());
    if (has_z_) current_->add_height_meters(geodetic.height_meters());
  }
}

void PoseColumnsAnswer::Finish() {
  if (current_ == nullptr) return;
  ShortenHeights();
  ShortenCovariances();
}

// Heights that are all 0 are left out, unless they alone say what kind of
// position there is.
void PoseColumnsAnswer::ShortenHeights() {
  if (!has_x_ && !has_y_) return;
  if (AreZeros(current_->z_meters())) current_->clear_z_meters();
  if (AreZeros(current_->height_meters())) current_->clear_height_meters();
}

// Leaves one of covariances that are all the same, and the variances of
// diagonal ones. Without the form nobody could tell what was left out.
void PoseColumnsAnswer::ShortenCovariances() {
  Doubles* const values = current_->mutable_covariances();
  const v1::CovarianceForm form = current_->covariance_form();
  if (RowsOf(form) == 0 || values->empty()) return;
  if (Repeat(*values, covariance_values_)) {
    values->Truncate(covariance_values_);
  }
  if (AddVariances(*values, form, current_->mutable_covariance_diagonals())) {
    values->Clear();
  } else {
    current_->clear_covariance_diagonals();
  }
}

}  // namespace revisit::server
