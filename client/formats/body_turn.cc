#include "client/formats/body_turn.h"

#include <algorithm>
#include <cmath>
#include <utility>

#include "absl/strings/str_cat.h"
#include "client/formats/angles.h"

namespace revisit::client {
namespace {

using Vector = std::array<double, 3>;

constexpr std::int64_t kLeastSteps = 10;
// A longer step is a jump, not travel.
constexpr double kLongestStepMeters = 100.0;
// Least length of the mean of unit vectors that agree: some 26 degrees.
constexpr double kLeastAgreement = 0.9;
constexpr double kLeastYawDegrees = 5.0;

double Length(const Vector& v) { return std::hypot(v[0], v[1], v[2]); }

double Dot(const Vector& a, const Vector& b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

// Adds a direction of the frame, in the axes of the body.
void AddInBody(const Sample& sample, const Vector& direction, Vector* sum) {
  const std::array<double, 9> rotation = RotationOf(sample);
  for (std::size_t axis = 0; axis < 3; ++axis) {
    for (std::size_t row = 0; row < 3; ++row) {
      (*sum)[axis] += rotation[3 * row + axis] * direction[row];
    }
  }
}

std::size_t LargestAxis(const Vector& v) {
  std::size_t largest = 0;
  for (std::size_t axis = 1; axis < 3; ++axis) {
    if (std::abs(v[axis]) > std::abs(v[largest])) largest = axis;
  }
  return largest;
}

// The axes that are nearest to these directions.
BodyAxes NearestAxes(Vector forward, const Vector& up) {
  BodyAxes body{};
  const std::size_t vertical = LargestAxis(up);
  body[vertical] = up[vertical] > 0.0 ? 'u' : 'd';
  forward[vertical] = 0.0;
  const std::size_t along = LargestAxis(forward);
  body[along] = forward[along] > 0.0 ? 'f' : 'b';
  const std::size_t across = 3 - vertical - along;
  for (const char letter : {'l', 'r'}) {
    body[across] = letter;
    if (ReadBodyAxes({body.data(), body.size()}).has_value()) break;
  }
  return body;
}

// How far forward points to the left in these axes, in degrees.
double LeftDegrees(const BodyAxes& body, const Vector& forward) {
  double ahead = 0.0;
  double left = 0.0;
  for (std::size_t axis = 0; axis < 3; ++axis) {
    if (body[axis] == 'f') ahead += forward[axis];
    if (body[axis] == 'b') ahead -= forward[axis];
    if (body[axis] == 'l') left += forward[axis];
    if (body[axis] == 'r') left -= forward[axis];
  }
  return std::atan2(left, ahead) / kRadiansPerDegree;
}

}  // namespace

void BodyTurn::Add(const Sample& sample) {
  if (!sample.has_heading) return;
  if (!anchor_.has_value()) {
    anchor_ = sample;
    return;
  }
  const Vector step = {
      sample.estimate.x - anchor_->estimate.x,
      sample.estimate.y - anchor_->estimate.y,
      // Heights of receivers are worse than their positions.
      sample.geodetic.has_value() ? 0.0 : sample.z - anchor_->z};
  const double length = Length(step);
  if (!(length >= step_meters_)) return;
  const Sample anchor = *std::exchange(anchor_, sample);
  if (length > kLongestStepMeters) return;
  ++steps_;
  has_quaternions_ = sample.quaternion.has_value();
  const Vector half = {0.5 * step[0] / length, 0.5 * step[1] / length,
                       0.5 * step[2] / length};
  AddInBody(anchor, half, &forward_);
  AddInBody(sample, half, &forward_);
  AddInBody(sample, {0.0, 0.0, 1.0}, &up_);
}

std::optional<BodyTurn::Finding> BodyTurn::Find() const {
  const double count = static_cast<double>(steps_);
  const double agreement = Length(forward_) / count;
  if (steps_ < kLeastSteps || !(agreement > kLeastAgreement) ||
      !(Length(up_) > kLeastAgreement * count) ||
      std::abs(Dot(forward_, up_)) > 0.3 * Length(forward_) * Length(up_)) {
    return std::nullopt;
  }
  const BodyAxes as_it_is = {'f', 'l', 'u'};
  const BodyAxes body =
      has_quaternions_ ? NearestAxes(forward_, up_) : as_it_is;
  // The body is turned the other way than the vehicle seems to be in it.
  const double yaw = -std::round(LeftDegrees(body, forward_));
  const bool turned = std::abs(yaw) >= kLeastYawDegrees;
  Finding finding;
  finding.spread_degrees =
      std::sqrt(2.0 * std::max(0.0, 1.0 - agreement)) / kRadiansPerDegree;
  if (body != as_it_is) {
    finding.flags =
        absl::StrCat("--body-axes ", std::string(body.begin(), body.end()));
    finding.words = absl::StrCat("the body's ", Describe(body));
  }
  if (turned) {
    absl::StrAppend(&finding.flags, finding.flags.empty() ? "" : " ",
                    "--body-yaw ", yaw);
    absl::StrAppend(&finding.words, finding.words.empty() ? "" : ", and ",
                    "the body is turned ", std::abs(yaw), " degrees to the ",
                    yaw > 0.0 ? "left" : "right", " of where it moves");
  }
  if (finding.flags.empty()) return std::nullopt;
  return finding;
}

}  // namespace revisit::client
