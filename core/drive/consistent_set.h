// The largest set of things all of which agree with each other: the largest
// clique of a graph, found by branch and bound. The vertices are coloured
// greedily so that none has the colour of a neighbour; a clique has at most one
// vertex of each colour, so that a branch which cannot have more than the best
// that was found is left.
//
// Source: E. Tomita and others, "A simple and faster branch-and-bound algorithm
// for finding a maximum clique" (WALCOM 2010), MCS, without its recolouring;
// neighbours as bits as in P. San Segundo and others, "An exact bit-parallel
// algorithm for the maximum clique problem" (2011).
//
// Thread-compatible.
#ifndef REVISIT_CORE_DRIVE_CONSISTENT_SET_H_
#define REVISIT_CORE_DRIVE_CONSISTENT_SET_H_

#include <cstddef>
#include <cstdint>
#include <vector>

#include "core/search/should_stop.h"

namespace revisit::core {

// Which of the things 0, 1, ..., size - 1 agree with which. Takes size^2 / 8
// bytes.
class ConsistencyGraph {
 public:
  // None agree yet. With `agreeing`, all do.
  explicit ConsistencyGraph(std::size_t size, bool agreeing = false);

  std::size_t size() const { return size_; }
  // REQUIRES: i != j, both below size().
  void SetAgree(std::size_t i, std::size_t j, bool agree);
  // REQUIRES: both below size(). False for i == j.
  bool Agree(std::size_t i, std::size_t j) const {
    return (rows_[i * words_ + j / 64] >> (j % 64) & 1) != 0;
  }

  // The neighbours of i as bits, in words() words of 64, the least first.
  const std::uint64_t* row(std::size_t i) const {
    return rows_.data() + i * words_;
  }
  std::size_t words() const { return words_; }

 private:
  std::size_t size_;
  std::size_t words_;
  std::vector<std::uint64_t> rows_;
};

struct ConsistentSet {
  // In rising order.
  std::vector<std::size_t> members;
  // Whether there may be a larger one: the steps have come to an end.
  bool approximate = false;
};

// Branches that are looked into before the best so far is taken. A step takes
// O(size^2 / 64) at most, and some microseconds for a hundred vertices.
inline constexpr std::int64_t kMostCliqueSteps = 1'000'000;

// A search that can be stopped and goes on where it was. What it finds depends
// on the graph and the number of steps alone. Of several largest sets it finds
// the one that results from taking the vertices in their order, where that is
// one of them.
class ConsistentSetSearch {
 public:
  // REQUIRES: most_steps >= 0.
  explicit ConsistentSetSearch(const ConsistencyGraph& graph,
                               std::int64_t most_steps = kMostCliqueSteps);

  // Goes on until all is done, and returns true, or until it is told to stop,
  // which is asked after every few steps: each call gets on.
  bool Run(const ShouldStop& should_stop);

  // The best so far. Before Run() has returned true, it counts as approximate.
  ConsistentSet best() const;

 private:
  using Bits = std::vector<std::uint64_t>;

  // A node of the search tree: the vertices that may still come to the clique,
  // and those of them that are worth a branch, in the order of their colours.
  struct Level {
    Bits candidates;
    std::vector<std::size_t> branches;
    std::vector<std::size_t> colours;
  };

  void OrderByDegree(const ConsistencyGraph& graph);
  void TakeInOrder(const ConsistencyGraph& graph);
  void Colour(Level* level);
  void Step();

  // With the vertices in the order in which the search numbers them.
  ConsistencyGraph graph_;
  // The caller's number of each.
  std::vector<std::size_t> numbers_;
  std::int64_t steps_left_;
  // levels_[depth_] is at hand, if depth_ is not negative. Others are kept for
  // their memory.
  std::vector<Level> levels_;
  std::ptrdiff_t depth_ = -1;
  std::vector<std::size_t> clique_;
  // By the caller's numbers.
  std::vector<std::size_t> best_;
  // Scratch of Colour().
  Bits uncoloured_;
  Bits of_colour_;
};

// The same without stopping.
ConsistentSet LargestConsistentSet(const ConsistencyGraph& graph,
                                   std::int64_t most_steps = kMostCliqueSteps);

}  // namespace revisit::core

#endif  // REVISIT_CORE_DRIVE_CONSISTENT_SET_H_
