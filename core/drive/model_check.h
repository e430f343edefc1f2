// Whether a vehicle's poses contradict the model of their errors that it has:
// three shares, each of which one kind of estimator keeps near 0 and another
// near 1, whatever the road.
//
// The share of growing stretches. Where errors are carried on, the later pose
// of a stretch is less certain than the earlier one carried over to it:
//
//   tr S_j > tr F S_i F^T
//
// over x and y, with F the transition of dead reckoning. The difference is the
// trace of what the stretch adds, so it holds for every stretch that a filter
// which only predicts has covered, also for those that lead back to where it
// began and where S itself shrinks. Covariances that stay the same never grow,
// since F adds the swing of the heading's error; those of fixes, which go up
// and down with the view of the sky, grow half of the time.
//
// The share of stretches without a lever, among the same: the claim at the
// later end has nothing of what the swing of the earlier heading's error makes
// of it (carried_claim.h). Such a stretch grows too if the heading's variance
// does, since the positions' alone shrink on ways that lead back.
//
// The share of smooth triples. For three poses a, b, c, the distance of b from
// the line through a and c is free of the vehicle's speed. With errors that are
// independent it has at least the variance
//
//   v = n^T (S_b + (1 - t)^2 S_a + t^2 S_c) n,
//
// n normal to the line and t the part of the way at which b lies: a bend of the
// road only adds to it. So the distance is below kSmooth sqrt(v), which is a
// third of the median of a normal variable's magnitude, in at most
// P(|z| < kSmooth) = 0.178 of all triples. Errors with the correlation rho
// between neighbours leave about (1 - rho)(3 - rho) / 3 of v. (Allan's variance
// compares neighbours to the same end: Allan, "Statistics of atomic frequency
// standards", Proc. IEEE 54 (1966).)
//
// All are weighted so that the last few kilometres count: a vehicle whose
// estimator was mended is found to be. O(1) per pose and in memory, and a
// function of the poses alone.
#ifndef REVISIT_CORE_DRIVE_MODEL_CHECK_H_
#define REVISIT_CORE_DRIVE_MODEL_CHECK_H_

#include <optional>

#include "core/base/byte_stream.h"
#include "core/drive/findings.h"
#include "core/geometry/pose.h"
#include "core/noise/noise_model.h"

namespace revisit::core {

class ModelCheck {
 public:
  // Distance between the two ends of a stretch, at least.
  static constexpr double kStretchMeters = 5.0;
  // Distance between two poses of a triple, at least: a vehicle that stands
  // tells nothing.
  static constexpr double kStepMeters = 0.5;
  // So many of each have to be seen, and about so many last ones count.
  static constexpr double kLeastStretches = 50.0;
  static constexpr double kLastStretches = 200.0;
  static constexpr double kLeastTriples = 50.0;
  static constexpr double kLastTriples = 300.0;
  // Fewer growing stretches are those of fixes, and more those of reckoning.
  // Where half of them grow by chance, 0.75 is five standard deviations away.
  static constexpr double kLeastGrowing = 0.75;
  static constexpr double kMostGrowing = 0.95;
  // Nearly all stretches of a driver that leaves the lever out are without one,
  // and hardly any of one that does not.
  static constexpr double kMostWithoutLever = 0.95;
  // A third of 0.6745.
  static constexpr double kSmooth = 0.2248;
  // More smooth triples than this: the median is a third of what independent
  // errors make it, or less.
  static constexpr double kMostSmooth = 0.5;

  // Looks at the next pose of the vehicle. A step that is longer than the
  // longest one, which is the same at each call, is a jump.
  void Look(const PoseSample& sample, double max_step_meters);

  // Poses are missing before the next one: nothing is judged across them.
  void Skip() {
    stretch_start_.reset();
    before_.reset();
    last_.reset();
  }

  // The finding by which the poses contradict this model, if any. Of two, it is
  // the one from which the other follows: errors that are carried on are
  // correlated too.
  std::optional<FindingCode> Judge(CorrelationModel model) const;
  // The same with what was seen.
  std::optional<Finding> Find(CorrelationModel model) const;

  void Save(ByteWriter* writer) const;
  // Goes on where another was when it was saved; false, and unspecified, if
  // none can have been so.
  bool Load(ByteReader* reader);

 private:
  // A position with its covariance, in the plane. Vehicles are many, so no more
  // is kept of a pose than is needed.
  struct Position {
    double x = 0.0;
    double y = 0.0;
    double xx = 0.0;
    double xy = 0.0;
    double yy = 0.0;
  };
  // A position with what its covariance has to do with the heading.
  struct Estimate {
    Position position;
    double xh = 0.0;
    double yh = 0.0;
    double hh = 0.0;
  };

  // A share among the last ones.
  class Share {
   public:
    void Add(bool is_of, double last) {
      const double kept = 1.0 - 1.0 / last;
      counted_ = kept * counted_ + 1.0;
      of_ = kept * of_ + (is_of ? 1.0 : 0.0);
    }
    // Approaches the number of last ones.
    double counted() const { return counted_; }
    // REQUIRES: counted() > 0.
    double value() const { return of_ / counted_; }
    bool IsValid() const {
      return 0.0 <= of_ && of_ <= counted_ && counted_ <= kLastTriples + 1.0;
    }

   private:
    double counted_ = 0.0;
    double of_ = 0.0;
  };

  static bool IsFinite(const std::optional<Position>& position);
  static double MetersBetween(const Position& a, const Position& b);
  static double VarianceAlong(const Position& position, double x, double y);
  static double CarriedVariance(const Estimate& from, const Position& to);
  static bool HasLever(const Estimate& from, const Estimate& to);

  void LookAtStretch(const Estimate& now, double max_step_meters);
  // c: the last of a triple.
  void LookAtTriple(const Position& c, double max_step_meters);

  // Where the stretch at hand began.
  std::optional<Estimate> stretch_start_;
  Share growing_;
  // How many of the stretches that growing_ has counted are without a lever,
  // weighted as there.
  double without_lever_ = 0.0;
  // The last positions of the triples: the one before the last, and the last.
  std::optional<Position> before_;
  std::optional<Position> last_;
  Share smooth_;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_DRIVE_MODEL_CHECK_H_
