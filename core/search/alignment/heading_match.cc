#include "core/search/alignment/heading_match.h"

#include <algorithm>
#include <cmath>

namespace revisit::core {
namespace {

// Steps from one heading that is looked at to the next.
constexpr std::int64_t kHeadingsApart = 5;

// Error of a ratio due to rounding.
constexpr float kRounding = 1e-3F;

}  // namespace

template <int D>
std::optional<HeadingMatch> HeadingMatch::Make(const Query& query,
                                               const History& history,
                                               const RecentPath<D>& recent) {
  if (history.heading_bins == nullptr ||
      history.heading_bins->size() < history.end) {
    return std::nullopt;
  }
  HeadingMatch match(*history.heading_bins, history.end);
  const ShapeFilter<D>& filter = recent.filter();
  const double end = query.graph.pose(query.node).heading;
  const double radians = InHeadingBins(1.0);
  const double straying = radians * radians * filter.headings().straying;
  double variance = radians * radians * filter.headings().end;
  const double noise = radians * radians * static_cast<double>(kHeadingsApart) *
                       filter.headings().noise;
  // Sum of the surprises up to step t, and up to the step before the next.
  double ratio = 0.0;
  std::int64_t t = 0;
  const auto add_up_to = [&](std::int64_t last) {
    for (; t < last; ++t) ratio += recent.step(t + 1).surprise;
  };
  add_up_to(std::min(kHeadingsApart, recent.size()) - 1);
  match.least_ = static_cast<float>(ratio) + kRounding;
  for (std::int64_t k = kHeadingsApart; k < recent.size();
       k += kHeadingsApart) {
    variance += noise;
    HeadingStep step;
    step.turn = static_cast<std::uint8_t>(std::lround(
        InHeadingBins(query.graph.pose(query.node - k).heading - end)));
    step.information = static_cast<float>(1.0 / (variance + straying));
    step.gain = static_cast<float>(variance / (variance + straying));
    variance *= straying / (variance + straying);
    add_up_to(std::min(k + kHeadingsApart, recent.size()) - 1);
    step.most_ratio = static_cast<float>(ratio) + kRounding;
    for (const Direction direction : {Direction::kSame, Direction::kOpposite}) {
      step.offset = direction == Direction::kSame ? -k : k;
      match.steps_[IndexOf(direction)].push_back(step);
    }
    match.reach_ = k;
  }
  if (match.reach_ == 0) return std::nullopt;
  return match;
}

void HeadingMatch::Bound(std::size_t block, Direction direction,
                         BlockRatios* most) const {
  auto& known = known_[IndexOf(direction)];
  if (known.empty()) known.resize(BlocksOf(size_));
  if (known[block] != nullptr) {
    *most = *known[block];
    return;
  }
  Find(block, direction, most);
  known[block] = std::make_unique<const BlockRatios>(*most);
}

// Nodes that are none of the history have any heading: no path leads there.
void HeadingMatch::Find(std::size_t block, Direction direction,
                        BlockRatios* most) const {
  const auto first = static_cast<NodeIndex>(block * NodeBlock::kSize);
  const NodeIndex aside = reach_ + kMostSlips;
  const NodeIndex begin =
      first - (direction == Direction::kSame ? aside : kMostSlips);
  const NodeIndex end = first + static_cast<NodeIndex>(NodeBlock::kSize) +
                        (direction == Direction::kSame ? kMostSlips : aside);
  const std::uint8_t* bins = bins_.bins().data() + first;
  std::vector<std::uint8_t> near;
  if (begin < 0 || end > size_) {
    near.assign(static_cast<std::size_t>(end - begin), 0);
    const NodeIndex from = std::max<NodeIndex>(begin, 0);
    const NodeIndex to = std::min(size_, end);
    std::copy(bins_.bins().begin() + from, bins_.bins().begin() + to,
              near.begin() + (from - begin));
    bins = near.data() + (first - begin);
  }
  BoundRatios(bins, steps_[IndexOf(direction)], least_, kMostSlips, most);
}

template std::optional<HeadingMatch> HeadingMatch::Make<3>(
    const Query&, const History&, const RecentPath<3>&);
template std::optional<HeadingMatch> HeadingMatch::Make<4>(
    const Query&, const History&, const RecentPath<4>&);

}  // namespace revisit::core
