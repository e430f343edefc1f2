// One step of many paths through history at once: the recursion of
// shape_filter.h with the widest vectors of the machine, for paths that keep
// step with the recent one. What that does not settle is left to the caller.
//
// Operation by operation what ShapeFilter::Advance() does, in double precision
// without fused multiply-add.
#ifndef REVISIT_CORE_ALIGNMENT_WALK_KERNEL_H_
#define REVISIT_CORE_ALIGNMENT_WALK_KERNEL_H_

#include <cstddef>
#include <cstdint>
#include <vector>

#include "core/geometry/pose.h"

namespace revisit::core {

// Paths side by side, one array a quantity.
class Walkers {
 public:
  enum Column : std::size_t {
    // From where the path is seen: its end pose, carried over loop closures.
    // The heading is that less pi where the path is walked the other way.
    kX,
    kY,
    kZ,
    kHeading,
    kCosine,
    kSine,
    // What the shape filter knows of it.
    kNow,
    kAtEnd = kNow + 4,
    // Log-likelihood ratio and sum of squared innovations so far.
    kRatio = kAtEnd + 4,
    kSquared,
    // The same, what was known of the end, and steps, where the ratio was
    // greatest.
    kBestRatio,
    kBestSquared,
    kBestAtEnd,
    kBestSteps = kBestAtEnd + 4,
    // A path whose ratio plus a quarter of its squared innovations cannot come
    // to this is of no use.
    kNeeded,
    // For the kernel.
    kThere,
    kColumns = kThere + 4,
  };
  static constexpr std::size_t kIndices = 6;
  enum Index : std::size_t {
    kNode,
    // -1 walks back in time, as the recent path is walked; 1 forward.
    kStride,
    // Where the road ends, walked this way.
    kLast,
    // For the caller: where it began, and where its way is recorded.
    kEnd,
    kTrail,
    kBestTrail,
  };

  std::size_t size() const { return size_; }
  // From one column to the next.
  std::size_t room() const { return room_; }
  // As many, all of whose entries are 0, and no others.
  void Begin(std::size_t count);
  // Appends one; returns its place. What it holds is left from others.
  std::size_t Add();
  // Puts the last one into its place.
  void Remove(std::size_t i);
  // Makes `to` what `from` is.
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
  // Room for at least as many.
  void Grow(std::size_t least);

  std::size_t size_ = 0;
  // Of each column: whole vectors of any machine.
  std::size_t room_ = 0;
  // One column behind the other.
  std::vector<double> columns_;
  std::vector<std::int64_t> indices_;
};

// What all paths share at one step; matrices by rows, in the order of the
// state.
struct WalkStep {
  // t
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
  // Keeping step settles it up to this squared innovation.
  double settled = 0.0;
};

// What the kernel left, of one walker.
struct Unsettled {
  std::size_t walker = 0;
  // Keeps step and is of no further use. If not, it has not walked on.
  bool hopeless = false;
  // Its squared innovation where it would be, keeping step; infinite where the
  // road ends before.
  double squared_innovation = 0.0;
};

// Walks on those of the first `count` walkers that keep step. `poses` has x, y,
// z and heading of each node of history. `unsettled` is overwritten, in the
// order of the walkers.
void WalkOn(StateSpace state_space, const WalkStep& step, const double* poses,
            std::size_t count, Walkers* walkers,
            std::vector<Unsettled>* unsettled);

}  // namespace revisit::core

#endif  // REVISIT_CORE_ALIGNMENT_WALK_KERNEL_H_
