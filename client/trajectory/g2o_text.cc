#include "client/trajectory/g2o_text.h"

#include <cmath>

#include "client/answers/exact_text.h"

namespace revisit::client {
namespace {

template <typename Numbers>
void WriteNumbers(const Numbers& numbers, std::ostream& out) {
  for (const double value : numbers) out << ' ' << Exact(value);
}

}  // namespace

G2oWriter::G2oWriter(const v1::VehicleSettings& settings,
                     const std::vector<v1::LoopClosure>& closures,
                     std::ostream* out)
    : settings_(settings),
      spatial_(settings.state_space() == v1::STATE_SPACE_SPATIAL),
      closures_(closures),
      out_(*out) {
  for (const v1::LoopClosure& closure : closures) {
    closed_[closure.query_sequence()];
    closed_[closure.matched_sequence()];
  }
}

void G2oWriter::Add(const LocalPose& pose, const LocalPose& as_sent) {
  ++counts_.poses;
  WriteVertex(pose);
  if (as_sent.recording_start) {
    WriteStart(as_sent);
  } else if (last_) {
    WriteStep(*last_, as_sent);
  }
  last_ = as_sent;
  const auto closed = closed_.find(pose.sequence);
  if (closed != closed_.end()) closed->second = pose;
}

void G2oWriter::WriteStep(const LocalPose& from, const LocalPose& to) {
  if (to.sequence != from.sequence + 1) {
    // The way there was dropped, and with it what the errors share.
    v1::VehicleSettings unrelated = settings_;
    unrelated.set_correlation_model(v1::CORRELATION_MODEL_INDEPENDENT);
    ++counts_.gaps;
    WriteEdge(StepBetween(from, to, unrelated).relative, from, to);
  } else if (IsJump(from, to)) {
    ++counts_.jumps;
    WriteEdge(JumpBetween(from, to), from, to);
  } else {
    const Step step = StepBetween(from, to, settings_);
    if (step.raised) ++counts_.raised;
    WriteEdge(step.relative, from, to);
  }
}

void G2oWriter::WriteStart(const LocalPose& to) {
  const v1::RecordingStart& start = *to.recording_start;
  const v1::StateSpace space = settings_.state_space();
  bool is_tied = false;
  if (start.has_datum() && last_datum_) {
    is_tied = true;
    WriteEdge(DatumsBetween(*last_datum_, last_datum_->recording_start->datum(),
                            to, start.datum(), space),
              *last_datum_, to);
  } else if (last_ && !start.has_datum() && !start.unknown()) {
    is_tied = true;
    WriteEdge(GapBefore(to, start, space), *last_, to);
  }
  if (start.has_datum()) last_datum_ = to;
  if (!last_) return;
  ++counts_.recordings;
  if (!is_tied) ++counts_.untied;
}

void G2oWriter::AddClosures() {
  for (const v1::LoopClosure& closure : closures_) {
    ++counts_.closures;
    if (!closure.has_measurement()) ++counts_.unmeasured_closures;
    const LocalPose& matched = closed_[closure.matched_sequence()];
    const LocalPose& query = closed_[closure.query_sequence()];
    WriteEdge(ClosureBetween(closure, matched, query), matched, query);
  }
}

bool G2oWriter::IsJump(const LocalPose& from, const LocalPose& to) const {
  const double dz = spatial_ ? to.position[2] - from.position[2] : 0.0;
  return std::hypot(to.position[0] - from.position[0],
                    to.position[1] - from.position[1],
                    dz) > settings_.max_step_meters();
}

void G2oWriter::WriteVertex(const LocalPose& pose) {
  if (spatial_) {
    out_ << "VERTEX_SE3:QUAT " << pose.sequence;
    WriteNumbers(pose.position, out_);
    WriteNumbers(pose.orientation, out_);
  } else {
    out_ << "VERTEX_SE2 " << pose.sequence << ' ' << Exact(pose.position[0])
         << ' ' << Exact(pose.position[1]) << ' ' << Exact(pose.heading);
  }
  out_ << '\n';
}

void G2oWriter::WriteEdge(const RelativePose& relative, const LocalPose& from,
                          const LocalPose& to) {
  out_ << (spatial_ ? "EDGE_SE3:QUAT " : "EDGE_SE2 ") << from.sequence << ' '
       << to.sequence;
  if (spatial_) {
    const SpatialEdge edge = SpatialEdgeOf(relative, from, to);
    WriteNumbers(edge.position, out_);
    WriteNumbers(edge.orientation, out_);
    WriteNumbers(edge.information, out_);
  } else {
    out_ << ' ' << Exact(relative.position[0]) << ' '
         << Exact(relative.position[1]) << ' ' << Exact(relative.heading);
    WriteNumbers(PlanarInformation(relative), out_);
  }
  out_ << '\n';
}

}  // namespace revisit::client
