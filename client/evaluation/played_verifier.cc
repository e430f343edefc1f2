#include "client/evaluation/played_verifier.h"

#include "revisit/v1/geometry.pb.h"

namespace revisit::client {

PlayedVerifier::Word PlayedVerifier::Judge(bool is_right) {
  // Both are drawn for each candidate, so that one share does not move the
  // other.
  const bool is_silent = draws_.Uniform() <= errors_.silent;
  const bool is_wrong = draws_.Uniform() <= errors_.wrong;
  if (is_silent) return Word::kNothing;
  return is_right != is_wrong ? Word::kConfirm : Word::kReject;
}

std::optional<v1::LoopClosureMeasurement> PlayedVerifier::Measure(
    const PlanarPose& query, const PlanarPose& matched, bool is_right) {
  if (!errors_.measured) return std::nullopt;
  const PlanarPose seen = Between(matched, is_right ? query : matched);
  const double meters = errors_.measured->meters;
  const double radians = errors_.measured->heading_radians;
  v1::LoopClosureMeasurement measurement;
  measurement.set_x_meters(seen.x + meters * noise_.Next());
  measurement.set_y_meters(seen.y + meters * noise_.Next());
  measurement.set_heading_radians(seen.heading + radians * noise_.Next());
  v1::Covariance* const covariance = measurement.mutable_covariance();
  covariance->set_form(v1::COVARIANCE_FORM_PLANAR_6);
  for (const double value :
       {meters * meters, 0.0, 0.0, meters * meters, 0.0, radians * radians}) {
    covariance->add_values(value);
  }
  return measurement;
}

}  // namespace revisit::client
