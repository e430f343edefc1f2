// Which confirmed loop closures of a drive are contradicted by the others.
//
// Two closures (m, c, z) and (m', c', z'), with z the pose of the query c as
// seen from the matched pose m, tell the same thing twice: from m to c by z and
// on along the path to c', or along the path to m' and then by z'. The two ways
// differ by eps, whose covariance is
//
//   Sigma = Q(c..c') + Q(m..m') + R_z + R_z',
//
// each swung to where the ways meet; Q is what dead reckoning adds between two
// poses, in closed form and scaled by the drive's mean inflation
// (Drive::SimilarityOf()). The drift that had come together before does not
// count, so that claims which are wrong over a long way, or an estimate that is
// far off, hide nothing. To Sigma is added, in x and y, what a turn moves
// beyond the first order: a turn of variance v at one end of a way of r metres
// moves the other end by 1/2 turn^2 r, of second moment 3/4 v^2 r^2. They are
// consistent if
//
//   eps^T Sigma^-1 eps <= the chi-square quantile at kConsistentProbability
//
// (11.34 in the plane): the pairwise consistency of J. G. Mangelson and others,
// "Pairwise consistent measurement set maximization for robust multi-robot map
// merging" (ICRA 2018). Where nothing was measured, z says one place, in the
// direction that the headings tell, with R_z = kConfirmedTolerance.
//
// Compared are pairs whose queries lie within kComparedWithinMeters along the
// path, each with at most kMostNeighbours, within one segment of the path at
// either end: what happened at a jump is not known. Those that are not compared
// contradict each other as little as those that are consistent. Closures that
// contradict each other, over any number of others, are a component, and of
// each component the largest set without a contradiction is believed
// (consistent_set.h); so is what nothing contradicts. Components of more than
// kMostTogether are cut along the path.
//
// A suspect is a closure that is not believed and whose innovation has a
// p-value below kSuspectProbability, given those that are: its z is held
// against what up to kGivenOnEachSide of them before it and behind, the nearest
// along the path at both ends, say of its two poses. Each side is a Kalman
// filter that goes along the path from one closure to the next, up to the one
// that is judged; both count where their matched poses lie on either side of
// its own, otherwise the side that ends nearer. p-values are those of one
// innovation alone. An odometer that once erred by more than usual sets whole
// groups of right closures against each other, which wrong ones are seldom: so
// if others that are not believed, within kSupportMeters along the path, agree
// with it, each of the first kMostSupporters of these has to be as improbable
// too, and the p-value is below kSuspectProbability to the power of their
// number and one.
//
// Closures of which a pose was dropped, and those of two recordings, are not
// judged, nor are any where closures show no drift
// (NoiseModel::closures_show_drift).
#ifndef REVISIT_CORE_DRIVE_SUSPECTS_H_
#define REVISIT_CORE_DRIVE_SUSPECTS_H_

#include <cstddef>
#include <cstdint>
#include <memory>
#include <vector>

#include "core/search/should_stop.h"

namespace revisit::core {

class Drive;

inline constexpr double kConsistentProbability = 0.99;
inline constexpr double kSuspectProbability = 0.01;
inline constexpr double kComparedWithinMeters = 5000.0;
inline constexpr std::size_t kMostNeighbours = 200;
inline constexpr std::size_t kGivenOnEachSide = 8;
inline constexpr std::size_t kMostTogether = 1024;
// Along the path at both ends together, m.
inline constexpr double kSupportMeters = 500.0;
inline constexpr std::size_t kMostSupporters = 4;

// A confirmed loop closure that the others contradict.
struct Suspect {
  std::uint64_t query_sequence = 0;
  std::uint64_t matched_sequence = 0;
  // Its index among the closures of the same two poses, in the order in which
  // they were added (Drive::RemoveLoopClosure()).
  std::size_t occurrence = 0;
  // Probability of at least this innovation for a true closure, in
  // [0, kSuspectProbability).
  double p_value = 0.0;
};

// A search for suspects that can be stopped and goes on where it was. Takes
// some 100 us for each closure, and up to a second for each component of
// hundreds. What it finds depends on the drive alone, not on how it was
// stopped.
//
// Thread-compatible.
class SuspectSearch {
 public:
  // Copies what it needs of the closures, some 0.5 KB each, and judges the
  // drive as it is now. The drive may not change between calls of Run(): the
  // answer would be about a drive that is gone.
  explicit SuspectSearch(const Drive& drive);
  ~SuspectSearch();
  SuspectSearch(SuspectSearch&&) noexcept;
  SuspectSearch& operator=(SuspectSearch&&) noexcept;

  // Goes on until all is done, and returns true, or until it is told to stop,
  // which is asked about once in 100 us, after some work: each call gets on.
  // Null: it is never told to.
  bool Run(const ShouldStop& should_stop);

  // In the order in which the closures were added. REQUIRES: Run() has returned
  // true.
  const std::vector<Suspect>& suspects() const;

 private:
  class Impl;
  template <int D>
  class ImplIn;

  std::unique_ptr<Impl> impl_;
};

// The same without stopping.
std::vector<Suspect> FindSuspects(const Drive& drive);

}  // namespace revisit::core

#endif  // REVISIT_CORE_DRIVE_SUSPECTS_H_
