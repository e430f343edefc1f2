// Which ends of a relative alignment can have the odds that are asked for:
// upper bounds of log-odds, from the little that is known before any path is
// walked. Nothing that has the odds is ever ruled out.
#ifndef REVISIT_CORE_SEARCH_ALIGNMENT_SEARCH_BOUNDS_H_
#define REVISIT_CORE_SEARCH_ALIGNMENT_SEARCH_BOUNDS_H_

#include <cstddef>
#include <optional>
#include <vector>

#include "core/drive/block_bounds.h"
#include "core/drive/pose_graph.h"
#include "core/geometry/state_matrix.h"
#include "core/search/alignment/recent_path.h"
#include "core/search/alignment/relative_model.h"
#include "core/search/alignment/similarity_kernel.h"

namespace revisit::core {

// Error of a bound due to rounding, nats.
inline constexpr double kBoundSlack = 1e-6;

// Where ends are sampled, one of so many is looked at: of more, where the
// history has more than kEnoughSamples of them. A block has whole strides.
inline constexpr std::size_t kLeastStride = 16;
inline constexpr std::size_t kEnoughSamples = 16384;

// Whose log-odds a bound is for: those of one end, or of all ends within half a
// stride of it, as far as errors there are about the same.
enum class BoundOf { kEnd, kEndsAround };

template <int D>
class SearchBounds {
 public:
  // The ends are sought in [0, history_size). The graph, the model and the
  // recent path must outlive this.
  SearchBounds(const PoseGraph& graph, const RelativeModel& model,
               const RecentPath<D>& recent, NodeIndex query,
               NodeIndex history_size);

  // The part of the log-odds that is the same for all ends.
  double constant() const { return constant_; }

  // Where ends are sampled, one in so many is looked at.
  std::size_t stride() const { return stride_; }

  // Blocks of the history that may hold an end with the least log-odds. They
  // fall from the last to the first, except where blocks could be ruled out:
  // there the nearest come first, which are likely to have the greatest odds.
  // The greater these, the fewer other ends need be walked from.
  struct Blocks {
    // Whose ends are to be looked at one by one.
    std::vector<std::size_t> all;
    // Whose ends may be sampled: full blocks well before the query. None where
    // the model does not sample ends.
    std::vector<std::size_t> sampled;
  };
  Blocks BlocksToSearch() const;

  // For each end, the most that its log-odds can come to, but for what its path
  // gains. Infinity where nothing is known; undefined where the similarity is
  // impossible. `similarity` is what EvaluateDifferences() finds; `unshifted`
  // what BoundChanged() tells of it, for ends by themselves.
  void BoundEnds(const DifferenceBlock& differences,
                 const BlockSimilarity& similarity, BoundOf of,
                 BlockColumn* most, BlockColumn* unshifted) const;

 private:
  // Where ends of one scale may lie.
  struct Region {
    BlockBounds::Region of_blocks;
    NodeRegion of_nodes;
  };
  // Blocks [first, last) may be ruled out by where they and their nodes lie:
  // outside the regions of all scales.
  struct Regions {
    std::size_t first = 0;
    std::size_t last = 0;
    std::vector<Region> of_scales;
  };

  std::optional<Regions> FindRegions() const;
  Region RegionOf(const WeighedScale& scale, double position_variance,
                  double log_determinant) const;
  bool SamplesEnds() const;
  void AddNear(const Regions& regions, std::vector<std::size_t>* blocks) const;
  std::optional<double> LeastLogDeterminant(
      const StateMatrix<D>& tolerance) const;
  std::size_t FullBlocksBefore() const;
  void SortByDistance(std::vector<std::size_t>* blocks) const;

  const PoseGraph& graph_;
  const RelativeModel& model_;
  const RecentPath<D>& recent_;
  const NodeIndex query_;
  const NodeIndex size_;
  const double constant_;
  const std::size_t stride_;
  ChangeBound change_bound_;
  // The same for ends around one.
  ChangeBound around_bound_;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_ALIGNMENT_SEARCH_BOUNDS_H_
