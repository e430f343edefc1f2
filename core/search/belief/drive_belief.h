// The belief with which a search begins: a drive has shown the scale of its
// errors to the claimed ones, and its drift, as far as it passed places again.
//
// Two things are learned from the marks of the drive (mark.h), without a
// verifier:
//
// - The scale f of the true standard deviations to the claimed ones. Each mark
//   says how probable what it found is under each scale,
//   Z(f) = 1 + sum of the odds of all places; by Bayes,
//
//     ln P(f | marks) = ln P(f) + sum over marks of a ln Z(f) + constant.
//
//   Before the first mark, ln f is normal with kLogScalePrior. Neighbouring
//   marks share most of their paths and of their drift, so each counts for
//   a < 1 of an observation of its own (kScaleShare).
//
// - The drift. A recent mark that found its place surely enough shows the drift
//   between the two passes as a loop closure would, together with the marks
//   before it (shown_drift.h), with the probability that it is right.
#ifndef REVISIT_CORE_SEARCH_BELIEF_DRIVE_BELIEF_H_
#define REVISIT_CORE_SEARCH_BELIEF_DRIVE_BELIEF_H_

#include <cstddef>
#include <cstdint>
#include <map>
#include <vector>

#include "core/drive/dropped_stretch.h"
#include "core/drive/pose_graph.h"
#include "core/drive/recordings.h"
#include "core/search/alignment/relative_model.h"
#include "core/search/belief/mark.h"
#include "core/search/belief/scale_estimate.h"
#include "core/settings.h"

namespace revisit::core {

// Standard deviation of the prior of ln f: a factor of two.
inline constexpr double kLogScalePrior = 0.7;
// Share of an observation of its own that a mark is.
inline constexpr double kScaleShare = 0.1;
// Most marks whose evidence of the scale is asked for.
inline constexpr std::int64_t kMostScaleMarks = 32;
// How far the drift that a mark has shown reaches along the path from its place
// either way, in spacings of marks.
inline constexpr double kDriftReach = 40.0;
// Most places that show one drift together.
inline constexpr std::size_t kMostPairs = 6;
// Least probability of a place that shows the drift.
inline constexpr double kLeastDriftProbability = 0.9;
// Most drifts that are held possible at a time, beside the one as claimed.
inline constexpr std::size_t kMostDrifts = 2;

// Marks of a drive: mark k is the first node at or after k spacings of the way
// whose poses are still there.
struct MarkLine {
  const PoseGraph& graph;
  double spacing_meters;
  const DroppedStretches& dropped;

  // The last mark that lies at least a spacing before the node; negative if
  // there is none.
  std::int64_t LastBefore(NodeIndex node) const;
  NodeIndex NodeOf(std::int64_t mark) const;

 private:
  double MetersTo(NodeIndex node) const;
};

// The marks up to `last` whose evidence of the scale is asked for: all of them,
// or every second, fourth and so on, so that there are at most kMostScaleMarks;
// a mark that is asked for at a later node was asked for at all earlier ones.
struct ScaleMarks {
  explicit ScaleMarks(std::int64_t last);

  std::int64_t stride = 1;
  std::vector<std::int64_t> marks;
};

class DriveBelief {
 public:
  // The belief before the first mark.
  DriveBelief();

  // Learns the scale from a mark; marks that are asked for lie `stride` apart.
  void LearnScale(const MarkEvidence& mark, std::int64_t stride);
  // Learns the drift from a mark, whose place counts for ends of its recording
  // within `reach_meters` of it along the path, and before the mark. Where that
  // is not the mark's own recording, it shows how the frames of the two lie.
  // REQUIRES: marks of one recording come in their order, after all scales were
  // learned.
  void LearnDrift(const PoseGraph& graph, const Recordings& recordings,
                  const MarkEvidence& mark, double reach_meters);

  // The scales that are not too improbable, all of them, and the drifts that
  // are shown by places of one recording.
  std::vector<WeighedScale> Scales() const;
  std::vector<WeighedScale> AllScales() const;
  std::vector<WeighedDrift> drifts(std::size_t recording) const;

  // exp of the mean of ln f; the bounds are as coarse as the steps are.
  ScaleEstimate Scale() const;

 private:
  ByScale Weights() const;

  ByScale log_density_;
  // By recording: the newest marks that show the drift, and the drifts.
  std::map<std::size_t, std::vector<ConfirmedLoop>> pairs_;
  std::map<std::size_t, std::vector<WeighedDrift>> drifts_;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_BELIEF_DRIVE_BELIEF_H_
