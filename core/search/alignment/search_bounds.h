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
#include "core/search/alignment/history.h"
#include "core/search/alignment/path_axes.h"
#include "core/search/alignment/query.h"
#include "core/search/alignment/recent_path.h"
#include "core/search/alignment/relative_model.h"
#include "core/search/alignment/similarity_kernel.h"

namespace revisit::core {

// Error of a bound due to rounding, nats.
inline constexpr double kBoundSlack = 1e-6;

// 1/2 s^T B^-1 s at most: the standard deviation of B is twice as far as ends
// are apart in position, and as headings can be in heading.
inline constexpr double kAroundSlack = 0.5 * (0.25 + 1.0);

// Where ends are sampled, one of a stride of nodes is looked at. A stride has
// kLeastStride nodes, and twice as many again and again while a history would
// have more than kEnoughSamples samples. A block has whole strides.
inline constexpr std::size_t kLeastStride = 16;
inline constexpr std::size_t kEnoughSamples = 16384;

// The stride in a history of so many nodes.
std::size_t StrideOf(NodeIndex nodes);

// A bound is for the log-odds of one end, or for those of all ends within half
// a stride of it, as far as errors there are about the same.
enum class BoundOf { kEnd, kEndsAround };

template <int D>
class SearchBounds {
 public:
  // All must outlive this. The recent path is that of the query, in the axes of
  // the history.
  SearchBounds(const Query& query, const History& history,
               const RelativeModel& model, const RecentPath<D>& recent,
               const PathAxes<D>& axes);

  // The part of the log-odds that is the same for all ends.
  double constant() const { return constant_; }

  // Where ends are sampled, one in so many is looked at.
  std::size_t stride() const { return stride_; }

  // Blocks of the history that may hold an end with the least log-odds. They
  // fall from the last to the first, except where blocks could be ruled out:
  // there the nearest come first, which are likely to have the greatest odds.
  // The greater these, the fewer other ends need be walked from.
  struct Blocks {
    // The blocks whose ends are to be looked at one by one.
    std::vector<std::size_t> all;
    // The blocks whose ends may be sampled: full ones well before the query.
    // There are none where the model does not sample ends.
    std::vector<std::size_t> sampled;
  };
  Blocks BlocksToSearch() const;

  // For each end, the most that its log-odds can come to, but for what its path
  // gains. Infinity where nothing is known; undefined where the similarity is
  // impossible. `similarity` is what EvaluateDifferences() finds; `unshifted`
  // what BoundChanged() tells of it, for ends by themselves. `change`: what
  // paths can change, of these, in the axes of the differences.
  void BoundEnds(const ChangeBound& change, BoundOf of,
                 const DifferenceBlock& differences,
                 const BlockSimilarity& similarity, BlockColumn* most,
                 BlockColumn* unshifted) const;
  // The same where no difference counts.
  void BoundAnywhere(const BlockSimilarity& similarity, BlockColumn* most,
                     BlockColumn* unshifted) const;

 private:
  // Where ends of one part of the mixture may lie, in the history's frame. It
  // is for blocks [first, last).
  struct Region {
    std::size_t first = 0;
    std::size_t last = 0;
    BlockBounds::Region of_blocks;
    NodeRegion of_nodes;
  };
  // The covariance that counts between a node and the query along the line
  // between the two: a part of the query, and S_j times a scale.
  struct Along {
    double xx = 0.0;
    double xy = 0.0;
    double yy = 0.0;
    double node_scale = 0.0;
  };
  // Blocks [first, last) may be ruled out by where they and their nodes lie:
  // outside all regions. Of these, the blocks `always` may not.
  struct Regions {
    std::size_t first = 0;
    std::size_t last = 0;
    std::vector<std::size_t> always;
    std::vector<Region> regions;
  };

  std::optional<Regions> FindRegions() const;
  void AddOwnRegions(double position_variance, double log_determinant,
                     Regions* regions) const;
  void AddTiedRegions(double position_variance, double log_determinant,
                      Regions* regions) const;
  bool ErrorsGrow(Regions* regions) const;
  // `log_weight`: that of the part, of so many.
  Region RegionOf(const Along& along, double log_weight, std::size_t parts,
                  double position_variance, double log_determinant) const;
  bool SamplesEnds() const;
  void AddNear(const Regions& regions, std::vector<std::size_t>* blocks) const;
  std::optional<double> LeastLogDeterminant(
      const StateMatrix<D>& tolerance) const;
  // Blocks [FirstBlock(), BlocksBefore()) are full of nodes of the history,
  // well before the query.
  std::size_t FirstBlock() const { return BlocksOf(history_.first); }
  std::size_t BlocksBefore() const {
    return history_.relation.BlocksBefore(query_, history_.end);
  }
  void SortByDistance(std::vector<std::size_t>* blocks) const;

  const Query& query_;
  const History& history_;
  const RelativeModel& model_;
  const RecentPath<D>& recent_;
  const PathAxes<D>& axes_;
  const double constant_;
  const std::size_t stride_;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_ALIGNMENT_SEARCH_BOUNDS_H_
