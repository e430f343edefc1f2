#include "core/search/alignment/relative.h"

#include <algorithm>
#include <bitset>
#include <cassert>
#include <cmath>
#include <cstddef>
#include <limits>
#include <memory>
#include <numeric>
#include <utility>

#include "core/drive/node_range.h"
#include "core/geometry/state_matrix.h"
#include "core/search/alignment/anchors.h"
#include "core/search/alignment/heading_match.h"
#include "core/search/alignment/pose_table.h"
#include "core/search/alignment/recent_path.h"
#include "core/search/alignment/search_bounds.h"
#include "core/search/alignment/similarity_kernel.h"

namespace revisit::core {
namespace {

using BlockNodes = std::bitset<NodeBlock::kSize>;

// Ends that are less probable than the best by this share (e^-7) are sampled.
constexpr double kMostLogShareSampled = -7.0;

// Steps of log-odds in which ends are looked at.
constexpr double kAboutAsGood = 2.0;

std::size_t BlockOf(NodeIndex i) {
  return static_cast<std::size_t>(i) / NodeBlock::kSize;
}
std::size_t PlaceInBlock(NodeIndex i) {
  return static_cast<std::size_t>(i) % NodeBlock::kSize;
}

// Which nodes of the history were considered: walked from, counted by another
// that stands for them, not sought, or ill-conditioned.
class Considered {
 public:
  explicit Considered(NodeIndex history_size)
      : blocks_(BlocksOf(history_size)) {}

  void Add(NodeIndex i) { blocks_[BlockOf(i)].set(PlaceInBlock(i)); }
  NodeIndex count() const {
    NodeIndex count = 0;
    for (const BlockNodes& block : blocks_) {
      count += static_cast<NodeIndex>(block.count());
    }
    return count;
  }

 private:
  std::vector<BlockNodes> blocks_;
};

// The search of one direction, some nodes at a time.
template <int D>
class DirectionSearch {
 public:
  // All must outlive this. `headings`: null where ends are not sampled.
  DirectionSearch(const PoseGraph& graph, const RelativeModel& model,
                  const RecentPath<D>& recent, const SearchBounds<D>& bounds,
                  NodeIndex query, NodeIndex history_size, Direction direction,
                  const HeadingMatch* headings, PoseTable* table)
      : graph_(graph),
        model_(model),
        recent_(recent),
        bounds_(bounds),
        size_(history_size),
        direction_(direction),
        constant_(bounds.constant()),
        stride_(bounds.stride()),
        samples_of_block_(kNodes / stride_),
        blocks_at_a_time_(kNodes / samples_of_block_),
        headings_(headings),
        anchors_(graph, model, query, direction),
        walk_(graph, recent, history_size, direction, model.over_loops, table) {
  }

  Direction direction() const { return direction_; }

  // Finds the ends in block k. `greatest` rises to the greatest log-odds, if it
  // is less. `next`: the block that will be asked for after it.
  void Search(std::size_t k, std::size_t next, double* greatest,
              Considered* considered) {
    const auto first = static_cast<NodeIndex>(k * NodeBlock::kSize);
    count_ =
        std::min(NodeBlock::kSize, static_cast<std::size_t>(size_ - first));
    std::iota(nodes_.begin(), nodes_.end(), first);
    of_each_.fill(1.0);
    if (headings_ != nullptr) {
      BlockRatios ratios;
      headings_->Bound(k, direction_, &ratios);
      std::copy(ratios.begin(), ratios.end(), gains_.begin());
    } else {
      gains_.fill(recent_.most_log_likelihood_ratio());
    }
    anchors_.Find(k, count_, next);
    FindSought(k, &sought_);
    FindEnds(greatest, considered);
  }

  // Finds the ends in these blocks. Returns false if told to stop. REQUIRES:
  // headings, unless there are none.
  bool SampleAll(std::vector<std::size_t> blocks, const ShouldStop& should_stop,
                 double* greatest, Considered* considered) {
    std::stable_sort(blocks.begin(), blocks.end(),
                     [this](std::size_t a, std::size_t b) {
                       return DriftsInto(a) > DriftsInto(b);
                     });
    std::size_t last = 0;
    for (std::size_t first = 0; first < blocks.size(); first = last) {
      if (should_stop && should_stop()) return false;
      const std::size_t drifts = DriftsInto(blocks[first]);
      while (last < blocks.size() && last - first < blocks_at_a_time_ &&
             DriftsInto(blocks[last]) == drifts) {
        ++last;
      }
      Sample(blocks.data() + first, last - first,
             model_.least_log_share + *greatest, considered);
    }
    return SearchKept(should_stop, greatest, considered);
  }

  // Hands over what was found, except for what has lower log-odds.
  void HandOver(double least, ScoredEnds* ends,
                std::vector<ShapeMatch>* matches,
                std::vector<double>* odds_by_scale) {
    const auto older = [](const Found& a, const Found& b) {
      return a.end.node < b.end.node;
    };
    // Where all blocks are searched, from the last to the first, this sorts.
    std::reverse(found_.begin(), found_.end());
    if (!std::is_sorted(found_.begin(), found_.end(), older)) {
      std::sort(found_.begin(), found_.end(), older);
    }
    ends->reserve(found_.size());
    matches->reserve(found_.size());
    for (const Found& found : found_) {
      if (!(found.end.score >= least)) continue;
      ends->push_back(found.end);
      matches->push_back(found.match);
      const auto scales = by_scale_.begin() + found.first_scale;
      odds_by_scale->insert(odds_by_scale->end(), scales,
                            scales + (model_.tell_scales ? Scales() : 0));
    }
  }

 private:
  static constexpr std::size_t kNodes = NodeBlock::kSize;

  struct Found {
    ScoredEnd end;
    ShapeMatch match;
    // Where its log-odds under each scale begin.
    std::ptrdiff_t first_scale = 0;
  };
  // An end that is to be looked at by itself.
  struct Kept {
    NodeIndex node = 0;
    // The most that the log-likelihood ratio of its path can come to.
    float ratio = 0.0F;
    // The most that its log-odds can come to, and in how many whole steps of
    // kAboutAsGood.
    double most = 0.0;
    double step = 0.0;
    // For how many nodes it stands.
    double nodes = 1.0;
    // DriftsInto() its block.
    std::size_t drifts = 0;
  };

  std::ptrdiff_t Scales() const {
    return std::max<std::ptrdiff_t>(
        1, static_cast<std::ptrdiff_t>(model_.scales.size()));
  }

  // Which drifts reach into a block, as bits.
  std::size_t DriftsInto(std::size_t k) const {
    std::size_t drifts = 0;
    for (std::size_t i = 0; i < model_.drifts.size(); ++i) {
      drifts |=
          static_cast<std::size_t>(Reaches(
              model_.drifts[i], static_cast<NodeIndex>(k * NodeBlock::kSize)))
          << i;
    }
    return drifts;
  }

  // Makes copies of these nodes the nodes at hand.
  void Gather(const NodeIndex* nodes, std::size_t count) {
    count_ = count;
    for (std::size_t i = 0; i < count; ++i) {
      nodes_[i] = nodes[i];
      indices_[i] = static_cast<double>(nodes[i]);
      gathered_.Copy(graph_.block(BlockOf(nodes[i])), PlaceInBlock(nodes[i]),
                     i);
    }
    of_each_.fill(1.0);
    anchors_.FindAmong(gathered_, indices_, count,
                       static_cast<NodeIndex>(BlockOf(nodes[0]) * kNodes));
  }

  void FindSought(std::size_t k, BlockNodes* sought) const {
    const auto first = static_cast<NodeIndex>(k * NodeBlock::kSize);
    const NodeIndex count =
        std::min<NodeIndex>(static_cast<NodeIndex>(kNodes), size_ - first);
    sought->set();
    for (const NodeRange& nodes : model_.not_sought) {
      const NodeIndex last = std::min(nodes.last - first, count);
      for (NodeIndex i = std::max<NodeIndex>(nodes.first - first, 0); i < last;
           ++i) {
        sought->reset(static_cast<std::size_t>(i));
      }
    }
  }

  // Samples the ends in these blocks, into which the same drifts reach, and
  // keeps for later those that are to be looked at one by one.
  void Sample(const std::size_t* blocks, std::size_t count, double least,
              Considered* considered) {
    BlockRatios ratios;
    samples_.clear();
    for (std::size_t b = 0; b < count; ++b) {
      for (std::size_t i = 0; i < samples_of_block_; ++i) {
        samples_.push_back(static_cast<NodeIndex>(blocks[b] * NodeBlock::kSize +
                                                  i * stride_ + stride_ / 2));
      }
    }
    Gather(samples_.data(), samples_.size());
    anchors_.Bound(bounds_, BoundOf::kEndsAround, &most_);
    for (std::size_t b = 0; b < count; ++b) {
      FindSought(blocks[b], &sought_of_block_);
      headings_->Bound(blocks[b], direction_, &ratios);
      for (std::size_t i = 0; i < samples_of_block_; ++i) {
        SampleAround(blocks[b], i, b * samples_of_block_ + i, ratios, least,
                     considered);
      }
    }
  }

  // Finds the ends that were kept, those first that may be the best. Once the
  // others can only be so much less probable than the best that was found, they
  // are sampled. Returns false if told to stop.
  bool SearchKept(const ShouldStop& should_stop, double* greatest,
                  Considered* considered) {
    // Ends that may be about as good keep the order of the graph, so that a
    // block that is read for one end is at hand for the next.
    const auto likelier = [](const Kept& a, const Kept& b) {
      if (a.drifts != b.drifts) return a.drifts > b.drifts;
      return a.step != b.step ? a.step > b.step : a.node < b.node;
    };
    std::sort(kept_.begin(), kept_.end(), likelier);
    std::vector<Kept> others;
    std::size_t last = 0;
    for (std::size_t first = 0; first < kept_.size(); first = last) {
      if (should_stop && should_stop()) return false;
      const double sampled = kMostLogShareSampled + *greatest;
      if (kAboutAsGood * (kept_[first].step + 1.0) < sampled) {
        last = first;
        while (last < kept_.size() &&
               kept_[last].drifts == kept_[first].drifts) {
          others.push_back(kept_[last++]);
        }
        continue;
      }
      last = FindKept(kept_, first, greatest, considered);
    }
    kept_ = Sampled(std::move(others), model_.least_log_share + *greatest,
                    considered);
    for (std::size_t first = 0; first < kept_.size(); first = last) {
      if (should_stop && should_stop()) return false;
      last = FindKept(kept_, first, greatest, considered);
    }
    return true;
  }

  // Finds those ends of some that were kept which begin at `first` and have the
  // same drifts, as many as can be at hand. Returns where the next ones begin.
  std::size_t FindKept(const std::vector<Kept>& kept, std::size_t first,
                       double* greatest, Considered* considered) {
    batch_.clear();
    std::size_t last = first;
    for (; last < kept.size() && last - first < kNodes &&
           kept[last].drifts == kept[first].drifts;
         ++last) {
      batch_.push_back(kept[last].node);
    }
    Gather(batch_.data(), batch_.size());
    for (std::size_t i = 0; i < batch_.size(); ++i) {
      gains_[i] = kept[first + i].ratio;
      of_each_[i] = kept[first + i].nodes;
    }
    sought_.set();
    FindEnds(greatest, considered);
    return last;
  }

  // One of every kLeastStride of these that may come to the least log-odds.
  static std::vector<Kept> Sampled(std::vector<Kept> kept, double least,
                                   Considered* considered) {
    kept.erase(std::remove_if(kept.begin(), kept.end(),
                              [&](const Kept& k) { return k.most < least; }),
               kept.end());
    std::sort(kept.begin(), kept.end(), [](const Kept& a, const Kept& b) {
      return a.drifts != b.drifts ? a.drifts > b.drifts : a.node < b.node;
    });
    std::vector<Kept> samples;
    std::size_t last = 0;
    for (std::size_t first = 0; first < kept.size(); first = last) {
      double nodes = 0.0;
      for (; last < kept.size() && last - first < kLeastStride &&
             kept[last].drifts == kept[first].drifts;
           ++last) {
        considered->Add(kept[last].node);
        nodes += kept[last].nodes;
      }
      samples.push_back(kept[first + (last - first) / 2]);
      samples.back().nodes = nodes;
    }
    return samples;
  }

  // Whether the covariances of neighbouring samples of a block are about as
  // great, and so those of what lies between.
  bool IsEven(std::size_t sample, std::size_t at) const {
    return (sample == 0 || anchors_.AreAlike(at - 1, at)) &&
           (sample + 1 == samples_of_block_ || anchors_.AreAlike(at, at + 1));
  }

  // Decides about the nodes around a sample of block k, which stands at `at`
  // among the nodes at hand.
  void SampleAround(std::size_t k, std::size_t sample, std::size_t at,
                    const BlockRatios& ratios, double least,
                    Considered* considered) {
    const auto first = static_cast<NodeIndex>(k * kNodes);
    const std::size_t begin = sample * stride_;
    const double weight = recent_.weight();
    // Nodes of which the ratio is so much may come to the least log-odds, or
    // to more than is sampled.
    const bool possible = anchors_.IsPossible(at) && IsEven(sample, at);
    const auto ratio_for = [&](double log_odds) {
      return possible ? (log_odds - most_[at]) / weight : kImpossible;
    };
    const double may_be = ratio_for(least);
    const double kept = ratio_for(model_.most_log_odds_sampled);
    const std::size_t drifts = DriftsInto(k);
    const auto keep = [&](std::size_t i, double nodes) {
      const double most = possible ? most_[at] + weight * ratios[i]
                                   : std::numeric_limits<double>::infinity();
      kept_.push_back({first + static_cast<NodeIndex>(i), ratios[i], most,
                       std::floor(most / kAboutAsGood), nodes, drifts});
    };
    // One stands for all that cannot: the sample, unless that can itself.
    double stands_for = 0.0;
    std::size_t standing = kNodes;
    for (std::size_t i = begin; i < begin + stride_; ++i) {
      const NodeIndex node = first + static_cast<NodeIndex>(i);
      if (!sought_of_block_[i]) {
        considered->Add(node);
      } else if (!possible || ratios[i] > kept) {
        keep(i, 1.0);
      } else if (!(ratios[i] < may_be)) {
        considered->Add(node);
        stands_for += 1.0;
        if (standing == kNodes || i == begin + stride_ / 2) standing = i;
      }
    }
    if (standing != kNodes) keep(standing, stands_for);
  }

  // Finds the ends among the nodes at hand that are sought.
  void FindEnds(double* greatest, Considered* considered) {
    const double least = model_.least_log_share + *greatest;
    const BlockNodes useful = FindUseful(least, considered);
    if (useful.none()) return;
    const BestPaths& paths = WalkBack(useful, least);
    anchors_.Change(paths.change);
    Collect(useful, least, paths, greatest);
  }

  // The ends that may come to the least log-odds.
  BlockNodes FindUseful(double least, Considered* considered) {
    anchors_.Bound(bounds_, BoundOf::kEnd, &most_);
    BlockNodes useful;
    for (std::size_t i = 0; i < count_; ++i) {
      most_[i] += recent_.weight() * gains_[i];
      if (!sought_[i] || !anchors_.IsPossible(i)) {
        considered->Add(nodes_[i]);
      } else if (!(most_[i] < least)) {
        useful.set(i);
        considered->Add(nodes_[i]);
      }
    }
    return useful;
  }

  const BestPaths& WalkBack(const BlockNodes& useful, double least) {
    starts_.clear();
    for (std::size_t i = 0; i < count_; ++i) {
      if (!useful[i]) continue;
      // The ratio of a path without any innovation, less the ratio by which the
      // end's bound exceeds the least log-odds.
      starts_.push_back(
          {nodes_[i], gains_[i] - (most_[i] - least) / recent_.weight(), i});
    }
    return walk_.Walk(
        starts_, model_.least_log_share == kImpossible
                     ? typename PathWalk<D>::IsUseless()
                     : [this, least](const PathSoFar<D>& path) {
                         return IsUseless(path, least);
                       });
  }

  // Whether a path comes to less than the least log-odds, as it was when it was
  // best and however it goes on.
  bool IsUseless(const PathSoFar<D>& path, double least) {
    if (further_after_ != path.steps) {
      PackLower<D>(recent_.FurtherShift(path.steps), further_);
      further_after_ = path.steps;
    }
    static constexpr double kNoFurther[kMostEntries] = {};
    const double beside = constant_ + kBoundSlack;
    const auto falls_short = [&](const StateVector<D>& shift,
                                 const double* further, double ratio) {
      return anchors_.BoundShifted(path.slot, recent_.ShiftToFrame(shift),
                                   further) +
                 recent_.weight() * ratio + beside <
             least;
    };
    return falls_short(path.shift, further_, path.most_ratio) &&
           falls_short(path.best_shift, kNoFurther, path.best_ratio);
  }

  // Keeps the useful ends that have come to the least log-odds.
  void Collect(const BlockNodes& useful, double least, const BestPaths& paths,
               double* greatest) {
    for (std::size_t i = count_; i-- > 0;) {
      if (!useful[i]) continue;
      const auto anchor = anchors_.At(i);
      const double beside =
          recent_.weight() * paths.log_likelihood_ratios[i] + constant_;
      const double score = anchor.log_similarity + beside;
      if (!(score >= least)) continue;
      *greatest = std::max(*greatest, score);
      found_.push_back(
          {{nodes_[i], score, of_each_[i]},
           {paths.log_likelihood_ratios[i], paths.squared_innovations[i],
            anchor.squared_mahalanobis, anchor.scale, paths.change.row[i]},
           static_cast<std::ptrdiff_t>(by_scale_.size())});
      if (!model_.tell_scales) continue;
      anchors_.AppendScales(i, &by_scale_);
      std::for_each(by_scale_.end() - Scales(), by_scale_.end(),
                    [beside](double& odds) { odds += beside; });
    }
  }

  const PoseGraph& graph_;
  const RelativeModel& model_;
  const RecentPath<D>& recent_;
  const SearchBounds<D>& bounds_;
  const NodeIndex size_;
  const Direction direction_;
  const double constant_;
  // One end in so many is a sample.
  const std::size_t stride_;
  const std::size_t samples_of_block_;
  const std::size_t blocks_at_a_time_;
  const HeadingMatch* const headings_;
  Anchors<D> anchors_;
  PathWalk<D> walk_;
  // The nodes at hand, how many each stands for, and the most that the
  // log-likelihood ratio of its path can come to.
  std::size_t count_ = 0;
  std::array<NodeIndex, kNodes> nodes_;
  BlockColumn of_each_;
  BlockColumn gains_;
  // The nodes at hand that may be ends.
  BlockNodes sought_;
  // The most that the log-odds of each end can come to.
  BlockColumn most_;
  std::vector<WalkStart> starts_;
  // RecentPath::FurtherShift() after so many steps.
  std::int64_t further_after_ = -1;
  double further_[kMostEntries] = {};
  // Copies of nodes, where these are no block of the graph.
  NodeBlock gathered_;
  alignas(64) BlockColumn indices_;
  std::vector<NodeIndex> samples_;
  std::vector<NodeIndex> batch_;
  BlockNodes sought_of_block_;
  std::vector<Kept> kept_;
  // In the order in which they were found.
  std::vector<Found> found_;
  std::vector<double> by_scale_;
};

// AlignmentParts.
template <int D>
struct Parts {
  Parts(const PoseGraph& graph, const RelativeModel& model, NodeIndex query,
        std::int64_t steps, NodeIndex history_size)
      : recent(graph, model, query, steps),
        poses(graph, history_size),
        headings(HeadingsOf(graph, model, recent, query, history_size)) {}

  static std::optional<HeadingMatch> HeadingsOf(const PoseGraph& graph,
                                                const RelativeModel& model,
                                                const RecentPath<D>& recent,
                                                NodeIndex query,
                                                NodeIndex history_size) {
    if (model.motion_history == nullptr) return std::nullopt;
    const HeadingBins& bins = model.motion_history->heading_bins();
    if (bins.size() < history_size) return std::nullopt;
    return HeadingMatch::Make<D>(graph, bins, recent, query, history_size);
  }

  const RecentPath<D> recent;
  // Filled in on the way.
  mutable PoseTable poses;
  // Nothing where these tell nothing.
  const std::optional<HeadingMatch> headings;
};

}  // namespace

template <int D>
std::optional<RelativeAlignment> AlignRelativeIn(
    const PoseGraph& graph, const RelativeModel& model, NodeIndex query,
    std::int64_t steps, NodeIndex history_size, const ShouldStop& should_stop,
    AlignmentParts* shared) {
  AlignmentParts own;
  if (shared == nullptr) shared = &own;
  if (shared->parts == nullptr) {
    shared->parts = std::make_shared<const Parts<D>>(graph, model, query, steps,
                                                     history_size);
  }
  const auto parts = std::static_pointer_cast<const Parts<D>>(shared->parts);
  // Where paths may cross loop closures, headings do not tell how far these can
  // go. Closures beyond the history may have been confirmed since, and the
  // answer does not depend on them.
  const HeadingMatch* const headings =
      parts->headings && model.most_log_odds_sampled != kImpossible &&
              !(model.over_loops && graph.HasLoopEdgeAmong(history_size))
          ? &*parts->headings
          : nullptr;
  const SearchBounds<D> bounds(graph, model, parts->recent, query,
                               history_size);
  std::vector<DirectionSearch<D>> searches;
  searches.reserve(2);
  const auto search_in = [&](Direction direction) {
    searches.emplace_back(graph, model, parts->recent, bounds, query,
                          history_size, direction, headings, &parts->poses);
  };
  if (model.same_direction) search_in(Direction::kSame);
  if (model.opposite_direction) search_in(Direction::kOpposite);

  RelativeAlignment alignment;
  double greatest = 0.0;
  Considered considered(history_size);
  typename SearchBounds<D>::Blocks blocks = bounds.BlocksToSearch();
  if (headings == nullptr) {
    blocks.all.insert(blocks.all.end(), blocks.sampled.begin(),
                      blocks.sampled.end());
    blocks.sampled.clear();
  }
  for (std::size_t i = 0; i < blocks.all.size(); ++i) {
    if (should_stop && should_stop()) return std::nullopt;
    const std::size_t next = blocks.all[i + 1 < blocks.all.size() ? i + 1 : 0];
    for (DirectionSearch<D>& search : searches) {
      search.Search(blocks.all[i], next, &greatest, &considered);
    }
  }
  for (DirectionSearch<D>& search : searches) {
    if (!search.SampleAll(blocks.sampled, should_stop, &greatest,
                          &considered)) {
      return std::nullopt;
    }
  }
  alignment.considered_ = considered.count();
  for (DirectionSearch<D>& search : searches) {
    RelativeAlignment::Found& found =
        alignment.found_[IndexOf(search.direction())];
    search.HandOver(model.least_log_share + greatest, &found.ends,
                    &found.matches, &found.odds_by_scale);
  }
  alignment.trace_ = [&graph, parts, history_size,
                      over_loops = model.over_loops](Direction direction,
                                                     NodeIndex j) {
    return PathWalk<D>(graph, parts->recent, history_size, direction,
                       over_loops, &parts->poses)
        .Trace(j);
  };
  return alignment;
}

const ShapeMatch& RelativeAlignment::match(Direction direction,
                                           NodeIndex j) const {
  const Found& found = found_[IndexOf(direction)];
  const auto end = std::lower_bound(
      found.ends.begin(), found.ends.end(), j,
      [](const ScoredEnd& e, NodeIndex node) { return e.node < node; });
  assert(end != found.ends.end() && end->node == j);
  return found.matches[static_cast<std::size_t>(end - found.ends.begin())];
}

std::optional<RelativeAlignment> AlignRelative(
    const PoseGraph& graph, const RelativeModel& model, NodeIndex query,
    std::int64_t steps, NodeIndex history_size, const ShouldStop& should_stop,
    AlignmentParts* parts) {
  assert(1 <= steps && steps <= query + 1);
  assert(history_size <= query);
  if (model.similarity.state_space == StateSpace::kPlanar) {
    return AlignRelativeIn<3>(graph, model, query, steps, history_size,
                              should_stop, parts);
  }
  return AlignRelativeIn<4>(graph, model, query, steps, history_size,
                            should_stop, parts);
}

}  // namespace revisit::core
