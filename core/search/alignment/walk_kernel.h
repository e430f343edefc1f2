// One step of many paths through the history at once: the recursion of
// shape_filter.h, with the widest vectors of the machine, for paths that keep
// step with the recent one. Walkers for which keeping step may not be best are
// left to the caller.
//
// Equals ShapeFilter::Advance() operation by operation, in double precision
// without fused multiply-add.
#ifndef REVISIT_CORE_SEARCH_ALIGNMENT_WALK_KERNEL_H_
#define REVISIT_CORE_SEARCH_ALIGNMENT_WALK_KERNEL_H_

#include <cstddef>
#include <cstdint>
#include <vector>

#include "core/geometry/pose.h"

namespace revisit::core {

// Paths side by side, one array per quantity.
class Walkers {
 public:
  enum Column : std::size_t {
    // The pose from which the path is seen: its end's, carried over loop
    // closures. kHeading is less by pi where the path is walked forward in
    // time, since the headings of the nodes there are not turned.
    kX,
    kY,
    kZ,
    kHeading,
    kCosine,
    kSine,
    // ShapeFilter::Drift: now and at_end.
    kNow,
    kAtEnd = kNow + 4,
    // Log-likelihood ratio so far, and sum of squared innovations.
    kRatio = kAtEnd + 4,
    kSquared,
    // Ratio, squares, at_end and number of steps at the step at which the ratio
    // was greatest.
    kBestRatio,
    kBestSquared,
    kBestAtEnd,
    kBestSteps = kBestAtEnd + 4,
    // A path is of no use once its ratio plus a quarter of its squared
    // innovations cannot come to this.
    kNeeded,
    // Scratch of the kernel.
    kThere,
    kColumns = kThere + 4,
  };
  static constexpr std::size_t kIndices = 6;
  enum Index : std::size_t {
    kNode,
    // -1 walks back in time, as the recent path is walked; 1 walks forward.
    kStride,
    // Last node of the road, walked this way.
    kLast,
    // For the caller: the slot of the end from which the path began, and where
    // its steps are recorded.
    kEnd,
    kTrail,
    kBestTrail,
  };

  std::size_t size() const { return size_; }
  // Distance from one column to the next.
  std::size_t room() const { return room_; }
  // Replaces all walkers by `count` new ones, with all entries 0.
  void Begin(std::size_t count);
  // Appends a walker with undefined entries; returns its index.
  std::size_t Add();
  // Removes walker i: the last one takes its index.
  void Remove(std::size_t i);
  // Copies all entries of walker `from` to walker `to`.
  void Copy(std::size_t from, std::size_t to);

  double* column(std::size_t c) { return columns_.data() + c * room_; }
  double& at(std::size_t c, std::size_t i) { return columns_[c * room_ + i]; }
  double at(std::size_t c, std::size_t i) const {
    return columns_[c * room_ + i];
  }
  std::int64_t* indices(Index c) { return indices_.data() + c * room_; }
  std::int64_t& at(Index c, std::size_t i) { return indices_[c * room_ + i]; }
  std::int64_t at(Index c, std::size_t i) const {
    return indices_[c * room_ + i];
  }

 private:
  // Makes room for at least this many walkers.
  void Grow(std::size_t least);

  std::size_t size_ = 0;
  // Entries per column: whole vectors of any machine.
  std::size_t room_ = 0;
  // One column behind the other.
  std::vector<double> columns_;
  std::vector<std::int64_t> indices_;
};

// The values that all paths share at one step. Matrices are stored by rows, in
// the order of the state.
struct WalkStep {
  // The number t of the step.
  double number = 0.0;
  double path[4] = {};
  double step_x = 0.0;
  double step_y = 0.0;
  double gain[4][4] = {};
  double end_gain[4][4] = {};
  // Upper triangle U with U^T U = S^-1.
  double whitening[4][4] = {};
  double surprise = 0.0;
  // Sum of the surprises of all later steps.
  double to_come = 0.0;
  // Keeping step is best up to this squared innovation.
  double settled = 0.0;
};

// A walker that the kernel has left to the caller.
struct Unsettled {
  std::size_t walker = 0;
  // Whether it has walked on but is of no further use. If not, it has not
  // walked on.
  bool hopeless = false;
  // Its squared innovation if it keeps step; infinite where the road ends.
  double squared_innovation = 0.0;
};

// Takes those of the first `count` walkers one step on for which keeping step
// is best. `poses` holds x, y, z and heading of each node of the history.
// `unsettled` is overwritten with the others, and with those of no further use,
// in the order of the walkers.
void WalkOn(StateSpace state_space, const WalkStep& step, const double* poses,
            std::size_t count, Walkers* walkers,
            std::vector<Unsettled>* unsettled);

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_ALIGNMENT_WALK_KERNEL_H_
