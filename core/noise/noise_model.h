// The noise models, one row each: what is known of the errors of poses.
//
// A row says how the errors of two poses are correlated, what a pose has to
// bring, and what searches may take for granted; whoever needs to know asks the
// row, and nobody else asks which model it is. Each model is whole in a file of
// its own beside this one: its row, with a reason for each entry, and its
// formulas. To add one: such a file, an entry in CorrelationModel and in
// models.h, and its name in API and store: the enums of that name in
// proto/revisit/v1/vehicle.proto and server/records/stored_records.proto, and
// kCorrelationModels in server/fields/settings_table.h (docs/how-it-works.md).
//
// A new row is cautious: it claims nothing that a search could rely on.
#ifndef REVISIT_CORE_NOISE_NOISE_MODEL_H_
#define REVISIT_CORE_NOISE_NOISE_MODEL_H_

namespace revisit::core {

// How the errors of poses are correlated with each other.
enum class CorrelationModel {
  kDeadReckoning,    // dead_reckoning.h
  kIndependent,      // independent_fixes.h
  kFilter,           // filter.h
  kCorrelatedFixes,  // correlated_fixes.h
};

// How Gamma, the covariance of the difference of two poses, is made: by this,
// kernels compare many nodes at once, and searches rule out where no candidate
// can lie.
enum class DifferenceForm {
  // Gamma = S_later - S_earlier, but for the swing of the earlier heading's
  // error at right angles to the line between the two: along this line the
  // variance of the earlier pose is taken away.
  kGrown,
  // Gamma = (1 - r) (S_i + S_j) with r in [0, 1): the variance of each pose
  // adds to it.
  kSummed,
  // Gamma depends on all nodes between the two. No index and no kernel helps:
  // searches carry it from node to node.
  kOfPath,
};

// How the claimed covariances go along a stretch of road if the model holds
// (model_check.h).
enum class ClaimedGrowth { kAny, kGrows, kDoesNotGrow };

struct NoiseModel {
  DifferenceForm form = DifferenceForm::kOfPath;

  // ---- The poses.

  // Whether each pose brings the transition of its error from the pose before,
  // which nodes then keep.
  bool carries_transitions = false;
  // Whether errors decorrelate over Correlation::meters of the way.
  bool decorrelates_over_way = false;
  ClaimedGrowth claimed_growth = ClaimedGrowth::kAny;
  // Whether errors of neighbouring poses are independent of each other, so that
  // a path which is smoother than they allow contradicts the model.
  bool is_white = false;

  // ---- Two passes of one place.

  // Whether Gamma is at least the covariance of either pose: two passes of a
  // place are never surer of each other than of themselves.
  bool exceeds_either = false;
  // Whether a confirmed loop closure shows the drift between other pairs of
  // nodes (known_drift.h).
  bool closures_show_drift = false;
  // Whether the scale of the errors and the drift, as the marks of a drive show
  // them, hold for later searches (drive_belief.h).
  bool lets_belief_begin = false;

  // ---- The history, node by node.

  // Whether neighbouring nodes err alike, so that one end of a search speaks
  // for the others around it.
  bool neighbours_err_alike = false;
  // Whether a pose tells its place by itself, and not by those before it.
  // There a candidate stands for its place; else for a stretch of road
  // (posterior.h).
  bool fixes_place = false;
  // Whether an overlap of more than one sequence tells more.
  bool long_overlaps_tell = true;
  // Whether the claims have a margin for how a whole drive's drift adds up,
  // more than one step ever adds (shape_filter.h).
  bool has_margin_per_step = false;

  // Whether claims of another shape than the model's are carried on by dead
  // reckoning (carried_claim.h).
  bool carries_claims() const {
    return claimed_growth == ClaimedGrowth::kGrows;
  }
  // Whether Gamma of two nodes takes O(1).
  bool has_closed_form() const { return form != DifferenceForm::kOfPath; }
};

// The row of a model.
const NoiseModel& NoiseOf(CorrelationModel model);

// A model with its parameter.
struct Correlation {
  Correlation() = default;
  // Implicit, since most models have no parameter.
  Correlation(CorrelationModel of, double over_meters = kUsualMeters)
      : model(of), meters(over_meters) {}

  const NoiseModel& noise() const { return NoiseOf(model); }

  // Some 30 s of a car in a city, for which reflections between buildings and
  // the smoothing of receivers last.
  static constexpr double kUsualMeters = 300.0;

  CorrelationModel model = CorrelationModel::kDeadReckoning;
  // The way over which errors decorrelate, where they do so.
  double meters = kUsualMeters;
};

// Whether both mean the same: the parameter counts where the model has it.
bool operator==(const Correlation& a, const Correlation& b);
inline bool operator!=(const Correlation& a, const Correlation& b) {
  return !(a == b);
}

}  // namespace revisit::core

#endif  // REVISIT_CORE_NOISE_NOISE_MODEL_H_
