// Judges the answers of checks against the truth of a drive.
//
// Nodes and their truth: a node lies between two poses of the stream, and so
// does its true pose, interpolated between theirs (heading on the shorter arc).
// Two nodes are one place if their true positions lie within a distance and
// their true headings within an angle. A check at node i is a TRUE LOOP if one
// of the nodes 0 to i - K is the same place, K nodes being the excluded recent
// path. A candidate is CORRECT if its matched node is one of those. Where
// opposite passes are sought, headings are compared after half a turn; a
// candidate is judged by the direction that it states. Precision and recall
// count the first candidate of a check only, and only if its verdict is
// ACCEPTED:
//
//   precision = accepted and correct / accepted
//   recall    = accepted and correct / true loops
//   f1        = 2 accepted and correct / (accepted + true loops)
//   top1      = first candidate correct / true loops, verdict aside
//   recall@5  = one of the first five correct / true loops, verdict aside
//   sure recall = first candidate correct and stated at 0.9 or more / true
//                 loops, verdict aside
//
// Where a drive has several recordings (Judging::first_asking_node), the last
// one asks: only its checks count, the nodes of the others take the place of
// the nodes 0 to i - K, and candidates in its own recording are left out. A
// check is at a NEW ROAD if none of these nodes lies within
// kNewRoadMeters of its true place and heads within the angle of one place.
//
// A candidate also says between which nodes the place lies. It HOLDS the place
// if one of these nodes is the same place:
//
//   interval precision = accepted and holds the place / accepted
//   interval recall    = accepted and holds the place / true loops
//   looks per loop = looks that a verifier takes at accepted candidates of any
//                    rank / checks with one that holds the place among these
#ifndef REVISIT_CLIENT_EVALUATION_EVALUATION_H_
#define REVISIT_CLIENT_EVALUATION_EVALUATION_H_

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "client/evaluation/calibration.h"
#include "client/formats/angles.h"
#include "client/formats/drive_file.h"
#include "revisit/v1/candidate.pb.h"

namespace revisit::client {

struct GraphNode {
  // The pose at or before the node, from 1, and how far on to the next.
  std::uint64_t sequence = 0;
  double fraction = 0.0;
  double travelled_meters = 0.0;
  PlanarPose estimate;
  // Covariance of the position: xx, xy, yy.
  double xx = 0.0;
  double xy = 0.0;
  double yy = 0.0;
};

struct CandidateAnswer {
  std::int64_t matched = 0;
  // Baselines, which know less, accept or reject by the gate.
  v1::Verdict verdict = v1::VERDICT_REJECTED_BY_GATE;
  // The gate that the verdict rests on: that of the whole path, otherwise that
  // of its end.
  bool path_gate = false;
  // Whether there is a gate at all: not where nothing tells how two frames lie
  // to each other.
  bool has_gate = true;
  double squared_distance = 0.0;
  double threshold = 0.0;
  double p_value = 0.0;
  // Absent where the method states none.
  std::optional<double> probability;
  // How far along the path, before and after the matched node, the place may
  // lie; 0 where the method does not say.
  double meters_before = 0.0;
  double meters_after = 0.0;
  // Whether the place was passed the other way.
  bool opposite = false;
  // How the frames of the two nodes are tied, where the service has answered.
  v1::FrameState frame_state = v1::FRAME_STATE_UNSPECIFIED;
  // The score of precision-recall curves, higher being surer: the probability
  // if there is one, otherwise the p-value of the gate.
  double confidence = 0.0;
};

// A verifier finds what lies this near along the path to where it looks.
inline constexpr double kLookMeters = 10.0;

// Looks that a verifier takes, one behind the other, to have seen all of the
// interval in which the place may lie: at least 1.
std::int64_t LooksAt(const CandidateAnswer& candidate);

// The answer to one check.
struct CheckAnswer {
  std::int64_t query = 0;
  std::vector<CandidateAnswer> candidates;
  // Why there are none.
  std::string empty_reason;
  // Whether there are none because each place is all but impossible.
  bool none_probable = false;
  // Absent where the method does not measure it.
  std::optional<double> search_milliseconds;
};

// Whether two answers are equal, apart from the time that the search took.
bool SameAnswer(const CheckAnswer& a, const CheckAnswer& b);

// Which passes are sought.
enum class PassDirection { kSame, kOpposite, kEither };

struct Judging {
  // Checks before this travelled distance do not count.
  double first_check_meters = 300.0;
  // K nodes of the excluded recent path, see above.
  std::int64_t excluded_nodes = 75;
  double loop_distance_meters = 10.0;
  double loop_heading_radians = kPi / 4.0;
  PassDirection direction = PassDirection::kSame;
  // Whether checks before the first true loop do not count, so that figures are
  // about a route that has been driven once.
  bool only_revisited = false;
  // The first node of the recording that asks; 0 where there is one recording.
  std::int64_t first_asking_node = 0;
  // Only checks at nodes behind this one count.
  std::int64_t counted_behind = -1;
};

// How far away any other road of its heading is from a new one.
inline constexpr double kNewRoadMeters = 40.0;

struct JudgedCheck {
  CheckAnswer answer;
  bool true_loop = false;
  // Only told where several recordings are.
  bool new_road = false;
  // One for each candidate: whether it is correct, and whether it holds the
  // place, as all correct ones do.
  std::vector<bool> correct;
  std::vector<bool> holds;

  bool accepted() const {
    return !answer.candidates.empty() &&
           answer.candidates[0].verdict == v1::VERDICT_ACCEPTED;
  }
  bool top_correct() const { return !correct.empty() && correct[0]; }
};

// The stated probability from which on a candidate counts as sure.
inline constexpr double kSure = 0.9;

struct Tally {
  std::int64_t checks = 0;
  std::int64_t true_loops = 0;
  // Checks whose first candidate was accepted, and, of these, is correct.
  std::int64_t accepted = 0;
  std::int64_t accepted_correct = 0;
  // Checks whose first candidate was accepted and holds the place.
  std::int64_t accepted_holding = 0;
  // Checks with a correct candidate first, or among the first five, whatever
  // the verdict.
  std::int64_t top1_correct = 0;
  std::int64_t top5_correct = 0;
  // Checks with a correct candidate first that is stated at kSure or more.
  std::int64_t sure_correct = 0;
  // Accepted candidates of any rank, which somebody would have to verify, and
  // checks with a correct one among them, which are loops that would be found.
  std::int64_t to_verify = 0;
  std::int64_t loops_found = 0;
  // Looks that these candidates take: LooksAt(), and checks with a place that
  // is seen in one.
  std::int64_t looks = 0;
  std::int64_t loops_seen = 0;
  // First candidates: their confidence, and their probability where stated.
  std::vector<Scored> confidences;
  std::vector<Scored> probabilities;
  // Where several recordings are: checks at new roads, and those of them at
  // which the first candidate was accepted.
  std::int64_t new_road_checks = 0;
  std::int64_t new_road_accepted = 0;
  // Candidates that the verifier confirmed and rejected.
  std::int64_t confirmed = 0;
  std::int64_t rejected = 0;
  // Jumps at which the trajectory was cut.
  std::int64_t jumps = 0;
  std::vector<double> search_milliseconds;
  std::int64_t poses = 0;
  // Poses that were streamed in `seconds`: more than `poses` where an
  // evaluation is repeated.
  std::int64_t timed_poses = 0;
  double seconds = 0.0;

  // Absent where the divisor is 0.
  std::optional<double> precision() const;
  std::optional<double> recall() const;
  std::optional<double> f1() const;
  std::optional<double> interval_precision() const;
  std::optional<double> interval_recall() const;
  std::optional<double> top1() const;
  std::optional<double> recall_at_5() const;
  std::optional<double> to_verify_per_loop() const;
  std::optional<double> looks_per_loop() const;
  // Absent also where no probability is stated.
  std::optional<double> sure_recall() const;
  std::optional<double> calibration_error() const;
  // Over what is stated at 0.1 or more.
  std::optional<double> positive_calibration_error() const;
  std::optional<double> poses_per_second() const;
  // The nearest-rank percentile, in [0, 100].
  std::optional<double> search_percentile(double percent) const;

  void Add(const Tally& other);
};

// The true pose between two poses of the stream. REQUIRES: as many truths as
// the stream had poses, one at least, and a sequence among them.
PlanarPose TruthAt(std::uint64_t sequence, double fraction,
                   const std::vector<PlanarPose>& truth);

// The true pose of each node. REQUIRES: as TruthAt().
std::vector<PlanarPose> TruthAtNodes(const std::vector<GraphNode>& nodes,
                                     const std::vector<PlanarPose>& truth);

// Whether two true poses are one place, passed the same or the opposite way.
bool SamePlace(const PlanarPose& a, const PlanarPose& b, bool opposite,
               const Judging& judging);

// Judges those answers that count, in order. REQUIRES: a true pose for each
// node, and all answers about nodes.
std::vector<JudgedCheck> Judge(const std::vector<GraphNode>& nodes,
                               const std::vector<PlanarPose>& truth_at_nodes,
                               const std::vector<CheckAnswer>& answers,
                               const Judging& judging);

// Counts what follows from the checks: not poses, times, jumps, and what a
// verifier confirmed or rejected.
Tally Count(const std::vector<JudgedCheck>& checks);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_EVALUATION_EVALUATION_H_
