#include "core/search/alignment/heading_match.h"

#include <algorithm>
#include <cmath>

namespace revisit::core {
namespace {

// Steps from one heading that is looked at to the next: where all ends are
// bounded, and where it pays to look closer.
constexpr std::int64_t kHeadingsApart = 5;
constexpr std::int64_t kHeadingsAround = 1;

// Error of a ratio due to rounding.
constexpr float kRounding = 1e-3F;

// How much more a path may gain than the filter of headings that are looked at
// closely says: what bins and slips leave open is taken for what costs least at
// each heading, which later ones may not bear out. In 60 towns of bends, 90 of
// 33 million paths gained more than this, by up to 2.1 nats, each of which
// counts for a twentieth of one of evidence.
constexpr float kNotBorneOut = 3.0F;

// The variances of a filter that looks at every `apart`-th heading, in squared
// bins.
template <int D>
HeadingVariances VariancesOf(const RecentPath<D>& recent, std::int64_t apart) {
  const double bins = InHeadingBins(1.0);
  const auto in_bins = [bins](double variance) {
    return static_cast<float>(bins * bins * variance);
  };
  const auto& headings = recent.filter().headings();
  return {in_bins(headings.end),
          in_bins(static_cast<double>(apart) * headings.noise),
          in_bins(headings.straying)};
}

// The steps of a filter that looks at every `apart`-th heading, and the most
// ratio of a path that ends before the first one. `to_spare`: by how much more
// these ratios are than the filter says.
template <int D>
float MakeSteps(const Query& query, const RecentPath<D>& recent,
                std::int64_t apart, float to_spare,
                std::array<std::vector<HeadingStep>, 2>* steps) {
  const HeadingVariances variances = VariancesOf(recent, apart);
  const double end = query.graph.pose(query.node).heading;
  float variance = variances.end;
  // Sum of the surprises up to step t, and up to the step before the next.
  double ratio = 0.0;
  std::int64_t t = 0;
  const auto add_up_to = [&](std::int64_t last) {
    for (; t < last; ++t) ratio += recent.step(t + 1).surprise;
  };
  add_up_to(std::min(apart, recent.size()) - 1);
  const float least = static_cast<float>(ratio) + to_spare;
  for (std::int64_t k = apart; k < recent.size(); k += apart) {
    variance += variances.noise;
    HeadingStep step;
    const double turn =
        InHeadingBins(query.graph.pose(query.node - k).heading - end);
    step.turn = static_cast<std::uint8_t>(std::lround(turn));
    step.rest = static_cast<float>(turn - std::round(turn));
    step.information = 1.0F / (variance + variances.straying);
    step.gain = variance * step.information;
    variance *= variances.straying * step.information;
    add_up_to(std::min(k + apart, recent.size()) - 1);
    step.most_ratio = static_cast<float>(ratio) + to_spare;
    for (const Direction direction : {Direction::kSame, Direction::kOpposite}) {
      step.offset = direction == Direction::kSame ? -k : k;
      (*steps)[IndexOf(direction)].push_back(step);
    }
  }
  return least;
}

}  // namespace

template <int D>
std::optional<HeadingMatch> HeadingMatch::Make(const Query& query,
                                               const History& history,
                                               const RecentPath<D>& recent) {
  if (history.heading_bins == nullptr ||
      history.heading_bins->size() < history.end ||
      recent.size() <= kHeadingsApart) {
    return std::nullopt;
  }
  HeadingMatch match(*history.heading_bins, history.end);
  match.least_ =
      MakeSteps(query, recent, kHeadingsApart, kRounding, &match.steps_);
  match.least_around_ =
      MakeSteps(query, recent, kHeadingsAround, kRounding + kNotBorneOut,
                &match.steps_around_);
  match.variances_around_ = VariancesOf(recent, kHeadingsAround);
  match.reach_ = recent.size() - 1;
  return match;
}

void HeadingMatch::Bound(std::size_t block, Direction direction,
                         BlockRatios* most) const {
  *most = Known(block, direction).most;
}

void HeadingMatch::Bound(std::size_t block, Direction direction, float enough,
                         BlockRatios* most) const {
  Bounds& known = Known(block, direction);
  if (enough < known.enough) {
    const auto first = static_cast<NodeIndex>(block * NodeBlock::kSize);
    WithBins(first, direction, [&](const std::uint8_t* bins) {
      known.lower = known.most;
      LowerRatios(bins, steps_around_[IndexOf(direction)], variances_around_,
                  least_around_, kMostSlips, enough, &known.lower);
    });
    known.enough = enough;
  }
  // The same whether lower ones were enough before or not.
  for (std::size_t i = 0; i < most->size(); ++i) {
    (*most)[i] = known.most[i] > enough ? std::max(known.lower[i], enough)
                                        : known.most[i];
  }
}

auto HeadingMatch::Known(std::size_t block, Direction direction) const
    -> Bounds& {
  auto& known = known_[IndexOf(direction)];
  if (known.empty()) known.resize(BlocksOf(size_));
  if (known[block] == nullptr) {
    known[block] = std::make_unique<Bounds>();
    const auto first = static_cast<NodeIndex>(block * NodeBlock::kSize);
    WithBins(first, direction, [&](const std::uint8_t* bins) {
      BoundRatios(bins, steps_[IndexOf(direction)], least_, kMostSlips,
                  &known[block]->most);
    });
  }
  return *known[block];
}

// Calls use(bins of the nodes from the first of a block on). Nodes that are
// none of the history have any heading: no path leads there.
template <typename Use>
void HeadingMatch::WithBins(NodeIndex first, Direction direction,
                            const Use& use) const {
  const NodeIndex aside = reach_ + kMostSlips;
  const NodeIndex begin =
      first - (direction == Direction::kSame ? aside : kMostSlips);
  const NodeIndex end = first + static_cast<NodeIndex>(NodeBlock::kSize) +
                        (direction == Direction::kSame ? kMostSlips : aside);
  if (begin >= 0 && end <= size_) {
    use(bins_.bins().data() + first);
    return;
  }
  std::vector<std::uint8_t> near(static_cast<std::size_t>(end - begin), 0);
  const NodeIndex from = std::max<NodeIndex>(begin, 0);
  const NodeIndex to = std::min(size_, end);
  std::copy(bins_.bins().begin() + from, bins_.bins().begin() + to,
            near.begin() + (from - begin));
  use(near.data() + (first - begin));
}

template std::optional<HeadingMatch> HeadingMatch::Make<3>(
    const Query&, const History&, const RecentPath<3>&);
template std::optional<HeadingMatch> HeadingMatch::Make<4>(
    const Query&, const History&, const RecentPath<4>&);

}  // namespace revisit::core
