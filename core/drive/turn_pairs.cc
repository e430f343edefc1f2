#include "core/drive/turn_pairs.h"

#include <algorithm>
#include <cassert>
#include <cmath>

#include "core/geometry/heading.h"

namespace revisit::core {
namespace {

// Shares below this count as this much: rarer turns are hardly measured.
constexpr double kLeastShare = 1e-3;

constexpr int Beside(int bin, int by) {
  return (bin + by + kTurnBins) % kTurnBins;
}

}  // namespace

int TurnBin(double turn) {
  const double bins = kTurnBins;
  const auto bin = static_cast<int>(std::lround(turn / (2.0 * kPi) * bins));
  return (bin % kTurnBins + kTurnBins) % kTurnBins;
}

void TurnBins::Extend(const PoseGraph& graph) {
  const auto size = static_cast<std::size_t>(graph.size());
  // Doubling would leave too much memory unused.
  if (size > bins_.capacity()) bins_.reserve(size + size / 8);
  for (auto i = static_cast<NodeIndex>(bins_.size()); i < graph.size(); ++i) {
    if (i - stretch_nodes_ < graph.SegmentStart(i)) {
      bins_.push_back(kNoTurn);
      continue;
    }
    bins_.push_back(static_cast<std::uint8_t>(TurnBin(WrapHeading(
        graph.pose(i).heading - graph.pose(i - stretch_nodes_).heading))));
  }
}

void TurnBins::SaveNodes(std::size_t first, std::size_t end,
                         ByteWriter* writer) const {
  writer->PutArray(bins_.data() + first, end - first);
}

bool TurnBins::LoadNodes(std::size_t count, ByteReader* reader) {
  if (count > reader->rest().size()) return false;
  const std::size_t before = bins_.size();
  const std::size_t size = before + count;
  if (size > bins_.capacity()) bins_.reserve(size + size / 8);
  bins_.resize(size);
  if (!reader->GetArray(bins_.data() + before, count)) return false;
  bool valid = true;
  for (std::size_t i = before; i < size; ++i) {
    valid &= bins_[i] < kTurnBins || bins_[i] == kNoTurn;
  }
  return valid;
}

TurnPairs::TurnPairs() : counts_(kTurnBins * kTurnBins), later_(kTurnBins) {}

TurnPairs::TurnPairs(const TurnBins& bins, NodeIndex last) : TurnPairs() {
  Add(bins, last);
}

void TurnPairs::Add(const TurnPairs& more) {
  for (std::size_t i = 0; i < counts_.size(); ++i)
    counts_[i] += more.counts_[i];
  for (std::size_t i = 0; i < later_.size(); ++i) later_[i] += more.later_[i];
}

void TurnPairs::Add(const TurnBins& bins, NodeIndex last, std::int32_t times) {
  const std::vector<std::uint8_t>& all = bins.bins();
  assert(last < bins.size());
  const auto stretch = static_cast<std::size_t>(bins.stretch_nodes());
  for (std::size_t i = stretch; i <= static_cast<std::size_t>(last); ++i) {
    // Where the later stretch lies in one segment but the one before it does
    // not, this is no pair.
    if (all[i] == kNoTurn || all[i - stretch] == kNoTurn) continue;
    counts_[static_cast<std::size_t>(all[i] * kTurnBins + all[i - stretch])] +=
        times;
    later_[all[i]] += times;
  }
}

double TurnPairs::Share(double turn, double later, double share) const {
  const int turn_bin = TurnBin(turn);
  const int later_bin = TurnBin(later);
  std::int64_t both = 0;
  std::int64_t with_later = 0;
  for (int b = -1; b <= 1; ++b) {
    const int beside = Beside(later_bin, b);
    with_later += later_[static_cast<std::size_t>(beside)];
    for (int a = -1; a <= 1; ++a) {
      both += Count(Beside(turn_bin, a), beside);
    }
  }
  return (1.0 + static_cast<double>(both)) /
         (1.0 / std::max(kLeastShare, share) + static_cast<double>(with_later));
}

}  // namespace revisit::core
