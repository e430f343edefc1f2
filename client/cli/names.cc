#include "client/cli/names.h"

namespace revisit::client {
namespace {

std::string WithoutPrefix(const std::string& name, const std::string& prefix) {
  return name.compare(0, prefix.size(), prefix) == 0
             ? name.substr(prefix.size())
             : name;
}

}  // namespace

std::string VehicleName(const std::string& id) {
  constexpr char kPrefix[] = "vehicles/";
  return id.rfind(kPrefix, 0) == 0 ? id : kPrefix + id;
}

std::string NameOf(v1::StateSpace value) {
  return WithoutPrefix(v1::StateSpace_Name(value), "STATE_SPACE_");
}

std::string NameOf(v1::CorrelationModel value) {
  return WithoutPrefix(v1::CorrelationModel_Name(value), "CORRELATION_MODEL_");
}

std::string NameOf(v1::LikelihoodForm value) {
  return WithoutPrefix(v1::LikelihoodForm_Name(value), "LIKELIHOOD_FORM_");
}

std::string NameOf(v1::Alignment value) {
  return WithoutPrefix(v1::Alignment_Name(value), "ALIGNMENT_");
}

std::string NameOf(v1::CoordinateFrame value) {
  return WithoutPrefix(v1::CoordinateFrame_Name(value), "COORDINATE_FRAME_");
}

std::string NameOf(v1::VehicleState value) {
  return WithoutPrefix(v1::VehicleState_Name(value), "VEHICLE_STATE_");
}

std::string NameOf(v1::GateVerdict value) {
  return WithoutPrefix(v1::GateVerdict_Name(value), "GATE_VERDICT_");
}

std::string NameOf(v1::Verdict value) {
  return WithoutPrefix(v1::Verdict_Name(value), "VERDICT_");
}

std::string NameOf(v1::Direction value) {
  return WithoutPrefix(v1::Direction_Name(value), "DIRECTION_");
}

std::string Explain(v1::EmptyReason reason) {
  switch (reason) {
    case v1::EMPTY_REASON_PATH_TOO_SHORT:
      return "the path up to the query is shorter than the sequence";
    case v1::EMPTY_REASON_NO_HISTORY:
      return "there is no history before the sequence";
    case v1::EMPTY_REASON_ALL_SUPPRESSED:
      return "all history is too near the query along the path";
    case v1::EMPTY_REASON_NO_ALIGNMENT:
      return "the sequence aligns with no path of the history";
    case v1::EMPTY_REASON_NO_PROBABLE_PLACE:
      return "no place of the history is probable";
    default:
      return "the server gave no reason";
  }
}

}  // namespace revisit::client
