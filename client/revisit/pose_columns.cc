#include "client/revisit/pose_columns.h"

#include <cstddef>
#include <cstdint>
#include <cstring>
#include <utility>

namespace revisit::client {
namespace {

// Seconds whose nanoseconds have 64 bits.
constexpr std::int64_t kMostSeconds = 9'223'372'035;
constexpr std::int32_t kNanosPerSecond = 1'000'000'000;

// The size of the matrix of a form; 0 for one that is not known.
int SizeOf(v1::CovarianceForm form) {
  switch (form) {
    case v1::COVARIANCE_FORM_PLANAR_6:
      return 3;
    case v1::COVARIANCE_FORM_SPATIAL_10:
      return 4;
    case v1::COVARIANCE_FORM_ROS_36:
      return 6;
    default:
      return 0;
  }
}

int ValuesOf(v1::CovarianceForm form) {
  const int size = SizeOf(form);
  return form == v1::COVARIANCE_FORM_ROS_36 ? size * size
                                            : size * (size + 1) / 2;
}

bool IsZero(double value) {
  std::uint64_t bits;
  static_assert(sizeof(bits) == sizeof(value));
  std::memcpy(&bits, &value, sizeof(bits));
  return bits == 0;
}

class Columns {
 public:
  explicit Columns(const v1::Pose& first) : first_(first) {
    columns_.set_first_sequence(first.sequence());
    columns_.set_covariance_form(first.covariance().form());
    if (first.has_stamp()) *columns_.mutable_first_stamp() = first.stamp();
    if (first.has_recording_start()) {
      *columns_.mutable_recording_start() = first.recording_start();
    }
  }

  // Whether the pose can be said beside those before it.
  bool Add(const v1::Pose& pose) {
    const bool is_added = AddStamp(pose) && AddPosition(pose) &&
                          AddOrientation(pose) && AddCovariance(pose) &&
                          AddTransition(pose) &&
                          (&pose == &first_ || !pose.has_recording_start());
    columns_.set_pose_count(columns_.pose_count() + 1);
    return is_added;
  }

  v1::PoseColumns Finish() && {
    if (!has_z_) {
      columns_.clear_z_meters();
      columns_.clear_height_meters();
    }
    ShortenCovariances();
    return std::move(columns_);
  }

 private:
  bool AddStamp(const v1::Pose& pose) {
    if (pose.has_stamp() != first_.has_stamp()) return false;
    if (!pose.has_stamp()) return true;
    const std::int64_t seconds = pose.stamp().seconds();
    const std::int32_t nanos = pose.stamp().nanos();
    if (seconds < -kMostSeconds || seconds > kMostSeconds || nanos < 0 ||
        nanos >= kNanosPerSecond) {
      return false;
    }
    const std::int64_t stamp_ns = seconds * kNanosPerSecond + nanos;
    if (&pose != &first_) {
      std::int64_t step = 0;
      if (__builtin_sub_overflow(stamp_ns, stamp_ns_, &step)) return false;
      columns_.add_stamp_step_nanos(step);
    }
    stamp_ns_ = stamp_ns;
    return true;
  }

  bool AddPosition(const v1::Pose& pose) {
    if (pose.position_case() != first_.position_case()) return false;
    switch (pose.position_case()) {
      case v1::Pose::kLocal:
        columns_.add_x_meters(pose.local().x_meters());
        columns_.add_y_meters(pose.local().y_meters());
        columns_.add_z_meters(pose.local().z_meters());
        has_z_ = has_z_ || !IsZero(pose.local().z_meters());
        return true;
      case v1::Pose::kGeodetic:
        columns_.add_latitude_degrees(pose.geodetic().latitude_degrees());
        columns_.add_longitude_degrees(pose.geodetic().longitude_degrees());
        columns_.add_height_meters(pose.geodetic().height_meters());
        has_z_ = has_z_ || !IsZero(pose.geodetic().height_meters());
        return true;
      default:
        return false;
    }
  }

  bool AddOrientation(const v1::Pose& pose) {
    if (pose.orientation_case() != first_.orientation_case()) return false;
    if (pose.has_heading_radians()) {
      columns_.add_heading_radians(pose.heading_radians());
      return true;
    }
    const v1::Quaternion& turn = pose.quaternion();
    for (const double part : {turn.x(), turn.y(), turn.z(), turn.w()}) {
      columns_.add_quaternions(part);
    }
    return pose.has_quaternion();
  }

  bool AddCovariance(const v1::Pose& pose) {
    const v1::Covariance& covariance = pose.covariance();
    const int values = ValuesOf(covariance.form());
    if (values == 0 || covariance.form() != columns_.covariance_form() ||
        covariance.values_size() != values) {
      return false;
    }
    columns_.mutable_covariances()->MergeFrom(covariance.values());
    return true;
  }

  // All have as many numbers, but for the first pose, which may have none.
  bool AddTransition(const v1::Pose& pose) {
    const int size = pose.error_transition_size();
    const bool first_has_none = transition_ == 0 && columns_.pose_count() == 1;
    if (&pose == &first_ || first_has_none) transition_ = size;
    columns_.mutable_error_transitions()->MergeFrom(pose.error_transition());
    return size == transition_ && (size == 0 || size == 9 || size == 16);
  }

  // Leaves one of covariances that are all the same, and the diagonals of
  // diagonal ones.
  void ShortenCovariances() {
    const auto values =
        static_cast<std::size_t>(ValuesOf(columns_.covariance_form()));
    auto* const all = columns_.mutable_covariances();
    const double* const first = all->data();
    bool is_constant = true;
    for (int i = 1; i < columns_.pose_count() && is_constant; ++i) {
      is_constant =
          std::memcmp(first, first + static_cast<std::size_t>(i) * values,
                      values * sizeof(double)) == 0;
    }
    if (is_constant) all->Truncate(static_cast<int>(values));
    const int size = SizeOf(columns_.covariance_form());
    const bool is_triangle =
        columns_.covariance_form() != v1::COVARIANCE_FORM_ROS_36;
    bool is_diagonal = true;
    for (int i = 0; i < all->size() && is_diagonal;) {
      for (int r = 0; r < size; ++r) {
        for (int c = is_triangle ? r : 0; c < size; ++c, ++i) {
          if (r == c) {
            columns_.add_covariance_diagonals(all->Get(i));
          } else {
            is_diagonal = is_diagonal && IsZero(all->Get(i));
          }
        }
      }
    }
    if (is_diagonal) {
      all->Clear();
    } else {
      columns_.clear_covariance_diagonals();
    }
  }

  const v1::Pose& first_;
  v1::PoseColumns columns_;
  std::int64_t stamp_ns_ = 0;
  bool has_z_ = false;
  int transition_ = 0;
};

}  // namespace

std::optional<v1::PoseColumns> PoseColumnsOf(
    const std::vector<const v1::Pose*>& poses) {
  Columns columns(*poses.front());
  for (const v1::Pose* const pose : poses) {
    if (!columns.Add(*pose)) return std::nullopt;
  }
  return std::move(columns).Finish();
}

}  // namespace revisit::client
