#include "core/drive/consistent_set.h"

#include <algorithm>
#include <cassert>
#include <numeric>
#include <utility>

namespace revisit::core {
namespace {

constexpr std::size_t kWordBits = 64;

// Steps after which it is asked whether to stop.
constexpr std::int64_t kStepsAtATime = 64;

void ClearBit(std::size_t i, std::vector<std::uint64_t>* bits) {
  (*bits)[i / kWordBits] &= ~(std::uint64_t{1} << (i % kWordBits));
}

// The least bit of a word that is not 0.
std::size_t LeastBit(std::uint64_t word) {
  return static_cast<std::size_t>(__builtin_ctzll(word));
}

}  // namespace

ConsistencyGraph::ConsistencyGraph(std::size_t size, bool agreeing)
    : size_(size),
      words_((size + kWordBits - 1) / kWordBits),
      rows_(size * words_, 0) {
  if (!agreeing) return;
  for (std::size_t i = 0; i < size; ++i) {
    for (std::size_t j = 0; j < size; ++j) {
      if (i != j) {
        rows_[i * words_ + j / kWordBits] |= std::uint64_t{1}
                                             << (j % kWordBits);
      }
    }
  }
}

void ConsistencyGraph::SetAgree(std::size_t i, std::size_t j, bool agree) {
  assert(i != j && i < size_ && j < size_);
  for (const auto& [a, b] : {std::pair(i, j), std::pair(j, i)}) {
    std::uint64_t& word = rows_[a * words_ + b / kWordBits];
    const std::uint64_t bit = std::uint64_t{1} << (b % kWordBits);
    word = agree ? word | bit : word & ~bit;
  }
}

ConsistentSetSearch::ConsistentSetSearch(const ConsistencyGraph& graph,
                                         std::int64_t most_steps)
    : graph_(graph.size()),
      numbers_(graph.size()),
      steps_left_(most_steps),
      uncoloured_(graph.words()),
      of_colour_(graph.words()) {
  assert(most_steps >= 0);
  if (graph.size() == 0) return;
  TakeInOrder(graph);
  OrderByDegree(graph);
  for (std::size_t i = 0; i < graph.size(); ++i) {
    for (std::size_t j = 0; j < i; ++j) {
      if (graph.Agree(numbers_[i], numbers_[j])) graph_.SetAgree(i, j, true);
    }
  }
  Level root;
  root.candidates.assign(graph_.words(), ~std::uint64_t{0});
  if (const std::size_t rest = graph_.size() % kWordBits; rest != 0) {
    root.candidates.back() = (std::uint64_t{1} << rest) - 1;
  }
  Colour(&root);
  levels_.push_back(std::move(root));
  depth_ = 0;
}

// The first set: each vertex that agrees with all that were taken before it.
void ConsistentSetSearch::TakeInOrder(const ConsistencyGraph& graph) {
  for (std::size_t i = 0; i < graph.size(); ++i) {
    if (std::all_of(best_.begin(), best_.end(),
                    [&](std::size_t j) { return graph.Agree(i, j); })) {
      best_.push_back(i);
    }
  }
}

// The vertex of the least degree comes last, then that of the least among the
// others, and so on: colours are then few.
void ConsistentSetSearch::OrderByDegree(const ConsistencyGraph& graph) {
  const std::size_t size = graph.size();
  std::vector<std::size_t> degrees(size, 0);
  for (std::size_t i = 0; i < size; ++i) {
    for (std::size_t j = 0; j < size; ++j) degrees[i] += graph.Agree(i, j);
  }
  std::vector<std::size_t> left(size);
  std::iota(left.begin(), left.end(), std::size_t{0});
  for (std::size_t at = size; at-- > 0;) {
    // The last one of the caller's goes first where degrees are equal.
    const auto least = std::min_element(
        left.begin(), left.end(), [&degrees](std::size_t a, std::size_t b) {
          return degrees[a] != degrees[b] ? degrees[a] < degrees[b] : a > b;
        });
    numbers_[at] = *least;
    left.erase(least);
    for (const std::size_t i : left) {
      degrees[i] -= graph.Agree(i, numbers_[at]);
    }
  }
}

// Colours the candidates, and lists those that can lead to more than the best:
// a vertex of colour k is in no clique of more than k among those coloured up
// to it.
void ConsistentSetSearch::Colour(Level* level) {
  const std::size_t needed =
      best_.size() >= clique_.size() ? best_.size() - clique_.size() : 0;
  level->branches.clear();
  level->colours.clear();
  uncoloured_ = level->candidates;
  std::size_t words = graph_.words();
  for (std::size_t colour = 1;; ++colour) {
    while (words > 0 && uncoloured_[words - 1] == 0) --words;
    if (words == 0) return;
    std::copy_n(uncoloured_.begin(), words, of_colour_.begin());
    for (std::size_t w = 0; w < words; ++w) {
      while (of_colour_[w] != 0) {
        const std::size_t i = w * kWordBits + LeastBit(of_colour_[w]);
        const std::uint64_t* const row = graph_.row(i);
        ClearBit(i, &uncoloured_);
        ClearBit(i, &of_colour_);
        for (std::size_t k = w; k < words; ++k) of_colour_[k] &= ~row[k];
        if (colour > needed) {
          level->branches.push_back(i);
          level->colours.push_back(colour);
        }
      }
    }
  }
}

// Takes the last branch of the level at hand, or leaves the level where none
// can lead to more than the best.
void ConsistentSetSearch::Step() {
  const auto depth = static_cast<std::size_t>(depth_);
  if (levels_[depth].branches.empty() ||
      clique_.size() + levels_[depth].colours.back() <= best_.size()) {
    if (depth_-- > 0) clique_.pop_back();
    return;
  }
  --steps_left_;
  if (levels_.size() == depth + 1) {
    levels_.emplace_back();
    levels_.back().candidates.resize(graph_.words());
  }
  Level& level = levels_[depth];
  Level& next = levels_[depth + 1];
  const std::size_t vertex = level.branches.back();
  level.branches.pop_back();
  level.colours.pop_back();
  clique_.push_back(vertex);
  const std::uint64_t* const row = graph_.row(vertex);
  bool any = false;
  for (std::size_t w = 0; w < graph_.words(); ++w) {
    next.candidates[w] = level.candidates[w] & row[w];
    any = any || next.candidates[w] != 0;
  }
  ClearBit(vertex, &level.candidates);
  if (any) {
    Colour(&next);
    ++depth_;
    return;
  }
  if (clique_.size() > best_.size()) {
    best_.clear();
    for (const std::size_t i : clique_) best_.push_back(numbers_[i]);
  }
  clique_.pop_back();
}

bool ConsistentSetSearch::Run(const ShouldStop& should_stop) {
  const auto is_done = [this] { return depth_ < 0 || steps_left_ == 0; };
  while (!is_done()) {
    for (std::int64_t k = 0; k < kStepsAtATime && !is_done(); ++k) Step();
    if (!is_done() && should_stop && should_stop()) return false;
  }
  return true;
}

ConsistentSet ConsistentSetSearch::best() const {
  ConsistentSet set;
  set.members = best_;
  std::sort(set.members.begin(), set.members.end());
  set.approximate = depth_ >= 0;
  return set;
}

ConsistentSet LargestConsistentSet(const ConsistencyGraph& graph,
                                   std::int64_t most_steps) {
  ConsistentSetSearch search(graph, most_steps);
  search.Run(nullptr);
  return search.best();
}

}  // namespace revisit::core
