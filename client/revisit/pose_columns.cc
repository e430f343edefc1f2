#include "client/revisit/pose_columns.h"

#include <cstddef>
#include <cstdint>
#include <cstring>
#include <string>
#include <utility>

#include "absl/strings/str_cat.h"

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

// Whether the nanoseconds of a stamp since 1970 have 64 bits.
bool IsInRange(const google::protobuf::Timestamp& stamp) {
  return stamp.seconds() >= -kMostSeconds && stamp.seconds() <= kMostSeconds &&
         stamp.nanos() >= 0 && stamp.nanos() < kNanosPerSecond;
}

std::int64_t NanosecondsOf(const google::protobuf::Timestamp& stamp) {
  return stamp.seconds() * kNanosPerSecond + stamp.nanos();
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
    if (!IsInRange(pose.stamp())) return false;
    const std::int64_t stamp_ns = NanosecondsOf(pose.stamp());
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

// The way back.
class ColumnsReader {
 public:
  explicit ColumnsReader(const v1::PoseColumns& columns)
      : columns_(columns),
        count_(columns.pose_count()),
        is_geodetic_(!columns.latitude_degrees().empty()),
        size_(SizeOf(columns.covariance_form())),
        values_(ValuesOf(columns.covariance_form())) {}

  // Says what does not fit; empty if all does.
  std::string Defect() {
    // The positions bound what a wrong count can take.
    if (count_ < 1 || !HasPositions()) return "positions";
    if (!HasOrientations()) return "orientations";
    if (!HasCovariances()) return "covariances";
    if (!FindTransitions()) return "error_transitions";
    return FindStamps() ? "" : "stamps";
  }

  // REQUIRES: there is no defect; the index is below the number of poses.
  void Write(int i, v1::Pose* pose) const {
    pose->set_sequence(columns_.first_sequence() +
                       static_cast<std::uint64_t>(i));
    WriteStamp(i, pose);
    WritePosition(i, pose);
    if (columns_.quaternions().empty()) {
      pose->set_heading_radians(columns_.heading_radians(i));
    } else {
      v1::Quaternion* const turn = pose->mutable_quaternion();
      turn->set_x(columns_.quaternions(4 * i));
      turn->set_y(columns_.quaternions(4 * i + 1));
      turn->set_z(columns_.quaternions(4 * i + 2));
      turn->set_w(columns_.quaternions(4 * i + 3));
    }
    WriteCovariance(i, pose->mutable_covariance());
    if (transition_ > 0 && i >= without_transition_) {
      const double* const first = columns_.error_transitions().data() +
                                  (i - without_transition_) * transition_;
      pose->mutable_error_transition()->Add(first, first + transition_);
    }
    if (i == 0 && columns_.has_recording_start()) {
      *pose->mutable_recording_start() = columns_.recording_start();
    }
  }

 private:
  using Doubles = google::protobuf::RepeatedField<double>;

  bool Fit(const Doubles& first, const Doubles& second,
           const Doubles& heights) const {
    return first.size() == count_ && second.size() == count_ &&
           (heights.empty() || heights.size() == count_);
  }

  bool HasPositions() const {
    return is_geodetic_
               ? Fit(columns_.latitude_degrees(), columns_.longitude_degrees(),
                     columns_.height_meters())
               : Fit(columns_.x_meters(), columns_.y_meters(),
                     columns_.z_meters());
  }

  bool HasOrientations() const {
    const int headings = columns_.heading_radians_size();
    const int parts = columns_.quaternions_size();
    return (headings == count_ && parts == 0) ||
           (headings == 0 && parts == 4 * count_);
  }

  bool HasCovariances() const {
    const auto fits = [this](const Doubles& given, int of_each) {
      return given.size() == of_each || given.size() == of_each * count_;
    };
    return values_ > 0 && (columns_.covariances().empty()
                               ? fits(columns_.covariance_diagonals(), size_)
                               : fits(columns_.covariances(), values_));
  }

  bool FindTransitions() {
    const int given = columns_.error_transitions_size();
    for (const int numbers : {9, 16}) {
      for (const int without : {0, 1}) {
        if (given != numbers * (count_ - without)) continue;
        transition_ = given == 0 ? 0 : numbers;
        without_transition_ = without;
        return true;
      }
    }
    return given == 0;
  }

  bool FindStamps() {
    const int steps = columns_.stamp_step_nanos_size();
    if (!columns_.has_first_stamp()) return steps == 0;
    if (steps != count_ - 1 || !IsInRange(columns_.first_stamp())) return false;
    stamps_ns_.push_back(NanosecondsOf(columns_.first_stamp()));
    for (const std::int64_t step : columns_.stamp_step_nanos()) {
      std::int64_t next = 0;
      if (__builtin_add_overflow(stamps_ns_.back(), step, &next)) return false;
      stamps_ns_.push_back(next);
    }
    return true;
  }

  void WriteStamp(int i, v1::Pose* pose) const {
    if (stamps_ns_.empty()) return;
    const std::int64_t stamp_ns = stamps_ns_[static_cast<std::size_t>(i)];
    std::int64_t nanos = stamp_ns % kNanosPerSecond;
    std::int64_t seconds = stamp_ns / kNanosPerSecond;
    if (nanos < 0) nanos += kNanosPerSecond, --seconds;
    pose->mutable_stamp()->set_seconds(seconds);
    pose->mutable_stamp()->set_nanos(static_cast<std::int32_t>(nanos));
  }

  void WritePosition(int i, v1::Pose* pose) const {
    const auto height = [i](const Doubles& heights) {
      return heights.empty() ? 0.0 : heights[i];
    };
    if (is_geodetic_) {
      v1::GeodeticPosition* const geodetic = pose->mutable_geodetic();
      geodetic->set_latitude_degrees(columns_.latitude_degrees(i));
      geodetic->set_longitude_degrees(columns_.longitude_degrees(i));
      geodetic->set_height_meters(height(columns_.height_meters()));
    } else {
      v1::LocalPosition* const local = pose->mutable_local();
      local->set_x_meters(columns_.x_meters(i));
      local->set_y_meters(columns_.y_meters(i));
      local->set_z_meters(height(columns_.z_meters()));
    }
  }

  // Where the numbers of a pose begin in a column that may have those of one.
  static const double* At(const Doubles& column, int of_each, int i) {
    return column.data() + (column.size() == of_each ? 0 : i * of_each);
  }

  void WriteCovariance(int i, v1::Covariance* covariance) const {
    covariance->set_form(columns_.covariance_form());
    Doubles* const values = covariance->mutable_values();
    if (!columns_.covariances().empty()) {
      const double* const first = At(columns_.covariances(), values_, i);
      values->Add(first, first + values_);
      return;
    }
    const double* const variances =
        At(columns_.covariance_diagonals(), size_, i);
    values->Resize(values_, 0.0);
    const bool is_full =
        columns_.covariance_form() == v1::COVARIANCE_FORM_ROS_36;
    for (int r = 0, place = 0; r < size_; ++r) {
      values->Set(place, variances[r]);
      place += is_full ? size_ + 1 : size_ - r;
    }
  }

  const v1::PoseColumns& columns_;
  const int count_;
  const bool is_geodetic_;
  const int size_;
  const int values_;
  int transition_ = 0;
  // How many poses at the beginning have no transition.
  int without_transition_ = 0;
  std::vector<std::int64_t> stamps_ns_;
};

}  // namespace

absl::Status AddPosesOf(const v1::PoseColumns& columns,
                        google::protobuf::RepeatedPtrField<v1::Pose>* poses) {
  ColumnsReader reader(columns);
  if (const std::string defect = reader.Defect(); !defect.empty()) {
    return absl::InternalError(
        absl::StrCat("the server's columns do not fit: the ", defect, " of ",
                     columns.pose_count(), " poses from sequence ",
                     columns.first_sequence()));
  }
  for (int i = 0; i < columns.pose_count(); ++i) reader.Write(i, poses->Add());
  return absl::OkStatus();
}

std::optional<v1::PoseColumns> PoseColumnsOf(
    const std::vector<const v1::Pose*>& poses) {
  Columns columns(*poses.front());
  for (const v1::Pose* const pose : poses) {
    if (!columns.Add(*pose)) return std::nullopt;
  }
  return std::move(columns).Finish();
}

}  // namespace revisit::client
