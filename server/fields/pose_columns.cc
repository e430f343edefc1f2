#include "server/fields/pose_columns.h"

#include <algorithm>
#include <utility>

#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/string_view.h"
#include "absl/strings/strip.h"
#include "absl/types/span.h"
#include "server/fields/covariances.h"
#include "server/fields/timestamps.h"

namespace revisit::server {
namespace {

using absl::StrCat;

std::size_t ValuesOf(CovarianceForm form) {
  const std::size_t size = RowsOf(form);
  return form == CovarianceForm::kRos36 ? size * size : size * (size + 1) / 2;
}

// Where the variance of a coordinate is among the values.
std::size_t DiagonalIndex(CovarianceForm form, std::size_t coordinate) {
  const std::size_t size = RowsOf(form);
  if (form == CovarianceForm::kRos36) return coordinate * (size + 1);
  // Row r of the upper triangle has size - r values.
  return coordinate * (2 * size - coordinate + 1) / 2;
}

constexpr char kColumnSize[] = "COLUMN_SIZE";
// Numbers of a transition of the two state spaces.
constexpr std::size_t kTransitionSizes[] = {9, 16};

std::string Element(const char* column, std::size_t index) {
  return StrCat(column, "[", index, "]");
}

// Where the numbers of a pose begin in a column of so many in all; at 0 where
// all poses have the same ones.
std::size_t BeginOf(std::size_t all, std::size_t per_pose, std::size_t index) {
  return all == per_pose ? 0 : index * per_pose;
}

// The index behind a name such as "covariance.values[4]"; nothing without one.
bool TakeIndex(absl::string_view text, absl::string_view name,
               std::size_t* index) {
  return absl::ConsumePrefix(&text, name) && absl::ConsumePrefix(&text, "[") &&
         absl::ConsumeSuffix(&text, "]") && absl::SimpleAtoi(text, index);
}

}  // namespace

PoseColumns::PoseColumns(ColumnFields fields, const FieldPath& path,
                         Violations* violations)
    : fields_(std::move(fields)),
      values_(ValuesOf(fields_.covariance_form)),
      diagonal_(RowsOf(fields_.covariance_form)),
      has_one_covariance_(fields_.covariances.empty()
                              ? fields_.covariance_diagonals.size() == diagonal_
                              : fields_.covariances.size() == values_) {
  const std::size_t before = violations->count();
  CheckChoices(path, violations);
  CheckLengths(path, violations);
  ReadTransitions(path, violations);
  if (violations->count() == before) ReadStamps(path, violations);
}

void PoseColumns::CheckChoices(const FieldPath& path,
                               Violations* violations) const {
  const auto one_of = [&](const char* first, bool has_first, const char* second,
                          bool has_second) {
    if (has_first == has_second) {
      violations->Add(kInvalidField, path.Field(first),
                      StrCat(has_first ? "got both this and `"
                                       : "required: either this or `",
                             second, has_first ? "`; allowed is one" : "`"));
    }
  };
  one_of("x_meters", !fields_.x_meters.empty(), "latitude_degrees",
         !fields_.latitude_degrees.empty());
  one_of("heading_radians", !fields_.heading_radians.empty(), "quaternions",
         !fields_.quaternions.empty());
  one_of("covariances", !fields_.covariances.empty(), "covariance_diagonals",
         !fields_.covariance_diagonals.empty());
}

void PoseColumns::CheckPerPose(std::size_t given, std::size_t per_pose,
                               bool may_be_one, const FieldPath& path,
                               Violations* violations) const {
  if (given == per_pose * size() || (may_be_one && given == per_pose)) return;
  violations->Add(
      kColumnSize, path,
      StrCat("got ", given, " numbers; ", size(), " poses have ",
             per_pose * size(),
             may_be_one ? StrCat(", or ", per_pose, " that all have") : ""));
}

void PoseColumns::CheckLengths(const FieldPath& path,
                               Violations* violations) const {
  const auto check = [&](const char* name, std::size_t given,
                         std::size_t per_pose, bool may_be_one = false) {
    if (given > 0) {
      CheckPerPose(given, per_pose, may_be_one, path.Field(name), violations);
    }
  };
  // Some must be there where another one is.
  const auto check_beside = [&](const char* name, std::size_t given,
                                std::size_t other) {
    if (other > 0 || given > 0) {
      CheckPerPose(given, 1, false, path.Field(name), violations);
    }
  };
  check_beside("x_meters", fields_.x_meters.size(), fields_.y_meters.size());
  check_beside("y_meters", fields_.y_meters.size(), fields_.x_meters.size());
  check("z_meters", fields_.z_meters.size(), 1);
  check_beside("latitude_degrees", fields_.latitude_degrees.size(),
               fields_.longitude_degrees.size());
  check_beside("longitude_degrees", fields_.longitude_degrees.size(),
               fields_.latitude_degrees.size());
  check("height_meters", fields_.height_meters.size(), 1);
  check("heading_radians", fields_.heading_radians.size(), 1);
  check("quaternions", fields_.quaternions.size(), 4);
  if (values_ == 0) {
    violations->Add(kInvalidField, path.Field("covariance_form"),
                    StrCat("got ", static_cast<int>(fields_.covariance_form),
                           "; required is PLANAR_6, SPATIAL_10 or ROS_36"));
  } else {
    check("covariances", fields_.covariances.size(), values_, true);
    check("covariance_diagonals", fields_.covariance_diagonals.size(),
          diagonal_, true);
  }
}

void PoseColumns::ReadTransitions(const FieldPath& path,
                                  Violations* violations) {
  const std::size_t given = fields_.error_transitions.size();
  if (given == 0) return;
  for (const std::size_t numbers : kTransitionSizes) {
    first_has_none_ = given == numbers * (size() - 1);
    if (!first_has_none_ && given != numbers * size()) continue;
    transition_ = numbers;
    return;
  }
  violations->Add(
      kColumnSize, path.Field("error_transitions"),
      StrCat("got ", given, " numbers; ", size(), " poses have ", 9 * size(),
             " in the state space PLANAR and ", 16 * size(),
             " in SPATIAL, or those of one pose less"));
}

void PoseColumns::ReadStamps(const FieldPath& path, Violations* violations) {
  const FieldPath steps = path.Field("stamp_step_nanos");
  const std::size_t given = fields_.stamp_step_nanos.size();
  if (!fields_.first_stamp) {
    if (given > 0) {
      violations->Add(kColumnSize, steps,
                      StrCat("got ", given,
                             " numbers; without `first_stamp` there are none"));
    }
    return;
  }
  if (given != size() - 1) {
    violations->Add(kColumnSize, steps,
                    StrCat("got ", given, " numbers; ", size(),
                           " poses with stamps have ", size() - 1));
    return;
  }
  if (!CheckTimestamp(*fields_.first_stamp, path.Field("first_stamp"),
                      violations)) {
    return;
  }
  stamps_ns_.reserve(size());
  stamps_ns_.push_back(ToNanoseconds(*fields_.first_stamp));
  for (const std::int64_t step : fields_.stamp_step_nanos) {
    std::int64_t next = 0;
    if (__builtin_add_overflow(stamps_ns_.back(), step, &next)) {
      violations->Add(kInvalidField,
                      path.At("stamp_step_nanos", stamps_ns_.size() - 1),
                      StrCat("got ", step,
                             ", to a stamp outside of the years 1678 to 2261"));
      return;
    }
    stamps_ns_.push_back(next);
  }
}

CovarianceFields PoseColumns::CovarianceAt(std::size_t index) {
  if (!fields_.covariances.empty()) {
    const absl::Span<const double> all = fields_.covariances;
    return {fields_.covariance_form,
            all.subspan(BeginOf(all.size(), values_, index), values_)};
  }
  const double* const variances =
      fields_.covariance_diagonals.data() +
      BeginOf(fields_.covariance_diagonals.size(), diagonal_, index);
  for (std::size_t k = 0; k < diagonal_; ++k) {
    covariance_[DiagonalIndex(fields_.covariance_form, k)] = variances[k];
  }
  return {fields_.covariance_form,
          absl::MakeConstSpan(covariance_.data(), values_)};
}

PoseFields PoseColumns::At(std::size_t index) {
  PoseFields fields;
  fields.sequence = fields_.first_sequence + index;
  if (!stamps_ns_.empty()) {
    EncodeTime(stamps_ns_[index], &stamp_);
    fields.stamp = &stamp_;
  }
  if (!fields_.x_meters.empty()) {
    fields.position_kind = PoseFields::Position::kLocal;
    fields.position = {
        fields_.x_meters[index], fields_.y_meters[index],
        fields_.z_meters.empty() ? 0.0 : fields_.z_meters[index]};
  } else {
    fields.position_kind = PoseFields::Position::kGeodetic;
    fields.position = {
        fields_.latitude_degrees[index], fields_.longitude_degrees[index],
        fields_.height_meters.empty() ? 0.0 : fields_.height_meters[index]};
  }
  if (!fields_.quaternions.empty()) {
    fields.orientation_kind = PoseFields::Orientation::kQuaternion;
    std::copy_n(fields_.quaternions.data() + 4 * index, 4,
                fields.orientation.begin());
  } else {
    fields.orientation_kind = PoseFields::Orientation::kHeading;
    fields.orientation[0] = fields_.heading_radians[index];
  }
  fields.covariance = CovarianceAt(index);
  fields.error_transition = TransitionAt(index);
  if (index == 0) fields.recording_start = fields_.recording_start;
  return fields;
}

absl::Span<const double> PoseColumns::TransitionAt(std::size_t index) const {
  if (transition_ == 0 || (first_has_none_ && index == 0)) return {};
  return fields_.error_transitions.subspan(TransitionBegin(index), transition_);
}

ColumnFields PoseColumns::Slice(std::size_t first, std::size_t count) const {
  ColumnFields slice = fields_;
  slice.first_sequence += first;
  slice.pose_count = static_cast<std::int32_t>(count);
  if (!stamps_ns_.empty()) EncodeTime(stamps_ns_[first], &*slice.first_stamp);
  const auto cut = [&](auto* column, std::size_t per_pose) {
    if (!column->empty()) {
      *column = column->subspan(first * per_pose, count * per_pose);
    }
  };
  if (!stamps_ns_.empty()) {
    slice.stamp_step_nanos = slice.stamp_step_nanos.subspan(first, count - 1);
  }
  for (auto* column : {&slice.x_meters, &slice.y_meters, &slice.z_meters,
                       &slice.latitude_degrees, &slice.longitude_degrees,
                       &slice.height_meters, &slice.heading_radians}) {
    cut(column, 1);
  }
  cut(&slice.quaternions, 4);
  if (!has_one_covariance_) {
    cut(&slice.covariances, values_);
    cut(&slice.covariance_diagonals, diagonal_);
  }
  if (transition_ > 0) {
    const std::size_t begin = first == 0 ? 0 : TransitionBegin(first);
    slice.error_transitions = slice.error_transitions.subspan(
        begin, TransitionBegin(first + count) - begin);
  }
  if (first > 0) slice.recording_start = nullptr;
  return slice;
}

std::string PoseColumns::ColumnOf(std::size_t index,
                                  const std::string& field) const {
  absl::string_view name = field;
  if (absl::ConsumePrefix(&name, "stamp")) {
    return index == 0 ? StrCat("first_stamp", name)
                      : Element("stamp_step_nanos", index - 1);
  }
  if (name == "sequence") return "first_sequence";
  // All positions are of the wrong kind for the vehicle.
  if (name == "local") return "x_meters";
  if (name == "geodetic") return "latitude_degrees";
  if (absl::ConsumePrefix(&name, "local.") ||
      absl::ConsumePrefix(&name, "geodetic.") || name == "heading_radians") {
    return StrCat(name, "[", index, "]");
  }
  if (name == "orientation") {
    return fields_.quaternions.empty() ? Element("heading_radians", index)
                                       : Element("quaternions", 4 * index);
  }
  if (absl::ConsumePrefix(&name, "quaternion")) {
    const std::size_t part =
        absl::string_view("xyzw").find(name.empty() ? 'x' : name.back());
    return Element("quaternions", 4 * index + part);
  }
  std::size_t number = 0;
  if (TakeIndex(name, "error_transition", &number)) {
    return Element("error_transitions", TransitionBegin(index) + number);
  }
  if (name == "error_transition") return "error_transitions";
  if (name == "covariance.form") return "covariance_form";
  if (absl::ConsumePrefix(&name, "covariance.")) {
    TakeIndex(name, "values", &number);
    if (!fields_.covariances.empty()) {
      return Element(
          "covariances",
          BeginOf(fields_.covariances.size(), values_, index) + number);
    }
    std::size_t coordinate = 0;
    while (coordinate + 1 < diagonal_ &&
           DiagonalIndex(fields_.covariance_form, coordinate) < number) {
      ++coordinate;
    }
    return Element(
        "covariance_diagonals",
        BeginOf(fields_.covariance_diagonals.size(), diagonal_, index) +
            coordinate);
  }
  return field;
}

}  // namespace revisit::server
