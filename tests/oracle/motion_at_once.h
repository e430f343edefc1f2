// The motion of a graph counted in one go, which indexes of it (MotionHistory)
// have to agree with.
#ifndef REVISIT_TESTS_ORACLE_MOTION_AT_ONCE_H_
#define REVISIT_TESTS_ORACLE_MOTION_AT_ONCE_H_

#include <vector>

#include "core/drive/motion_statistics.h"
#include "core/drive/pose_graph.h"
#include "core/noise/noise_model.h"

namespace revisit::oracle {

// The statistics over nodes [0, last].
template <int D>
core::MotionStatistics<D> MeasureMotion(const core::PoseGraph& graph,
                                        const core::Correlation& correlation,
                                        core::NodeIndex last) {
  core::MotionSums<D> sums;
  core::AddMotion<D>(graph, correlation, 0, last + 1, &sums);
  return core::MeanMotion<D>(correlation, sums);
}

// The shares of stretches of `stretch_nodes` steps within nodes [0, last].
inline std::vector<double> ShareOfStretches(const core::PoseGraph& graph,
                                            core::NodeIndex last,
                                            core::NodeIndex stretch_nodes,
                                            const std::vector<double>& turns,
                                            double tolerance_radians) {
  core::StretchCounter counter(turns, tolerance_radians);
  core::VisitStretches(graph, stretch_nodes, 0, last + 1,
                       [&](double turn) { counter.Add(turn); });
  return counter.Shares();
}

}  // namespace revisit::oracle

#endif  // REVISIT_TESTS_ORACLE_MOTION_AT_ONCE_H_
