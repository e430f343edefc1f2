#include "core/alignment/walk_kernel.h"

#include "core/geometry/heading.h"

// Highway includes this file once for each kind of vectors.
#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "core/alignment/walk_kernel.cc"
#include <hwy/foreach_target.h>
// After foreach_target.h.
#include <hwy/highway.h>

HWY_BEFORE_NAMESPACE();
namespace revisit::core::HWY_NAMESPACE {

namespace hn = hwy::HWY_NAMESPACE;

template <int D>
HWY_INLINE void WalkAllOn(const WalkStep& step, const double* poses,
                          std::size_t count, Walkers* walkers,
                          std::vector<Unsettled>* unsettled) {
  const hn::ScalableTag<double> tag;
  const hn::RebindToSigned<decltype(tag)> index_tag;
  using Vector = hn::Vec<decltype(tag)>;
  constexpr int h = D - 1;
  constexpr std::size_t kPoseColumns[] = {0, 1, 2, 3};
  const auto set = [tag](double value) HWY_ATTR { return hn::Set(tag, value); };
  const std::size_t lanes = hn::Lanes(tag);
  std::int64_t* const nodes = walkers->indices(Walkers::kNode);
  for (std::size_t i = 0; i < count; i += lanes) {
    const auto load = [&](std::size_t column) HWY_ATTR {
      return hn::LoadU(tag, walkers->column(column) + i);
    };
    const auto store = [&](std::size_t column, Vector value) HWY_ATTR {
      hn::StoreU(value, tag, walkers->column(column) + i);
    };
    const auto node = hn::LoadU(index_tag, nodes + i);
    const auto stride =
        hn::LoadU(index_tag, walkers->indices(Walkers::kStride) + i);
    const auto last =
        hn::LoadU(index_tag, walkers->indices(Walkers::kLast) + i);
    const auto at_last = hn::Eq(node, last);
    const auto next = hn::IfThenElse(at_last, node, hn::Add(node, stride));
    const auto at = hn::ShiftLeft<2>(next);
    const auto of_pose = [&](std::size_t k) HWY_ATTR {
      return hn::GatherIndex(tag, poses + kPoseColumns[k], at);
    };

    // Seen from the end.
    const Vector x = hn::Sub(of_pose(0), load(Walkers::kX));
    const Vector y = hn::Sub(of_pose(1), load(Walkers::kY));
    const Vector cosine = load(Walkers::kCosine);
    const Vector sine = load(Walkers::kSine);
    Vector seen[D];
    seen[0] = hn::Add(hn::Mul(cosine, x), hn::Mul(sine, y));
    seen[1] = hn::Sub(hn::Mul(cosine, y), hn::Mul(sine, x));
    if constexpr (D == 4) seen[2] = hn::Sub(of_pose(2), load(Walkers::kZ));
    seen[h] = hn::Sub(of_pose(3), load(Walkers::kHeading));

    Vector now[D];
    for (std::size_t r = 0; r < D; ++r) now[r] = load(Walkers::kNow + r);
    now[0] = hn::Sub(now[0], hn::Mul(set(step.step_y), now[h]));
    now[1] = hn::Add(now[1], hn::Mul(set(step.step_x), now[h]));
    Vector innovation[D];
    for (int r = 0; r < D; ++r) {
      innovation[r] = hn::Sub(hn::Sub(set(step.path[r]), seen[r]), now[r]);
    }
    const Vector turns =
        hn::Round(hn::Mul(innovation[h], set(1.0 / (2.0 * kPi))));
    innovation[h] = hn::Sub(innovation[h], hn::Mul(turns, set(2.0 * kPi)));

    const auto times = [&](const double(&matrix)[4][4], int r) HWY_ATTR {
      Vector sum = hn::Mul(set(matrix[r][0]), innovation[0]);
      for (int c = 1; c < D; ++c) {
        sum = hn::Add(sum, hn::Mul(set(matrix[r][c]), innovation[c]));
      }
      return sum;
    };
    Vector squared = hn::Mul(innovation[0], times(step.information, 0));
    for (int r = 1; r < D; ++r) {
      squared =
          hn::Add(squared, hn::Mul(innovation[r], times(step.information, r)));
    }
    const Vector gained =
        hn::Sub(set(step.surprise), hn::Mul(set(0.5), squared));
    // Written so that NaN does not walk on.
    const auto on = hn::AndNot(hn::RebindMask(tag, at_last),
                               hn::Le(squared, set(step.settled)));

    const Vector ratio =
        hn::Add(load(Walkers::kRatio), hn::IfThenElseZero(on, gained));
    const Vector squares =
        hn::Add(load(Walkers::kSquared), hn::IfThenElseZero(on, squared));
    Vector best_ratio = load(Walkers::kBestRatio);
    const auto better = hn::And(on, hn::Gt(ratio, best_ratio));
    best_ratio = hn::IfThenElse(better, ratio, best_ratio);
    store(Walkers::kRatio, ratio);
    store(Walkers::kSquared, squares);
    store(Walkers::kBestRatio, best_ratio);
    store(Walkers::kBestSquared,
          hn::IfThenElse(better, squares, load(Walkers::kBestSquared)));
    store(Walkers::kBestSteps,
          hn::IfThenElse(better, set(step.number), load(Walkers::kBestSteps)));
    for (std::size_t r = 0; r < D; ++r) {
      const int row = static_cast<int>(r);
      store(Walkers::kNow + r,
            hn::IfThenElse(on, hn::Add(now[r], times(step.gain, row)),
                           load(Walkers::kNow + r)));
      const Vector before = load(Walkers::kAtEnd + r);
      const Vector at_end =
          hn::Add(before, hn::IfThenElseZero(on, times(step.end_gain, row)));
      store(Walkers::kAtEnd + r, at_end);
      store(Walkers::kBestAtEnd + r,
            hn::IfThenElse(better, at_end, load(Walkers::kBestAtEnd + r)));
    }
    hn::StoreU(hn::IfThenElse(hn::RebindMask(index_tag, on), next, node),
               index_tag, nodes + i);

    const Vector most = hn::Add(ratio, set(step.to_come));
    const auto useful =
        hn::And(hn::Gt(most, best_ratio),
                hn::Ge(hn::Add(most, hn::Mul(set(0.25), squares)),
                       load(Walkers::kNeeded)));
    const auto settled = hn::And(on, useful);
    if (HWY_LIKELY(hn::AllTrue(tag, settled))) continue;
    std::uint8_t on_bits[8] = {};
    std::uint8_t settled_bits[8] = {};
    hn::StoreMaskBits(tag, on, on_bits);
    hn::StoreMaskBits(tag, settled, settled_bits);
    for (std::size_t k = 0; k < lanes && i + k < count; ++k) {
      const auto bit = [k](const std::uint8_t* bits) {
        return (bits[k / 8] >> (k % 8) & 1) != 0;
      };
      if (!bit(settled_bits)) unsettled->push_back({i + k, bit(on_bits)});
    }
  }
}

void WalkOn(StateSpace state_space, const WalkStep& step, const double* poses,
            std::size_t count, Walkers* walkers,
            std::vector<Unsettled>* unsettled) {
  unsettled->clear();
  if (state_space == StateSpace::kPlanar) {
    WalkAllOn<3>(step, poses, count, walkers, unsettled);
  } else {
    WalkAllOn<4>(step, poses, count, walkers, unsettled);
  }
}

}  // namespace revisit::core::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace revisit::core {

namespace {

// Whole vectors of any machine, for this many and one more.
std::size_t RoomFor(std::size_t count) {
  constexpr std::size_t kMostLanes = 8;
  return (count / kMostLanes + 1) * kMostLanes;
}

}  // namespace

HWY_EXPORT(WalkOn);

void WalkOn(StateSpace state_space, const WalkStep& step, const double* poses,
            std::size_t count, Walkers* walkers,
            std::vector<Unsettled>* unsettled) {
  HWY_DYNAMIC_DISPATCH(WalkOn)
  (state_space, step, poses, count, walkers, unsettled);
}

std::size_t Walkers::Add() {
  const std::size_t i = size_++;
  if (i >= columns_[0].size()) {
    // Entries beyond the last are read but mean nothing: node 0 is one.
    const std::size_t room = RoomFor(2 * i);
    for (std::vector<double>& column : columns_) column.resize(room);
    for (std::vector<std::int64_t>& column : indices_) column.resize(room);
  }
  return i;
}

void Walkers::Copy(std::size_t from, std::size_t to) {
  for (std::vector<double>& column : columns_) column[to] = column[from];
  for (std::vector<std::int64_t>& column : indices_) column[to] = column[from];
}

void Walkers::Remove(std::size_t i) { Copy(--size_, i); }

}  // namespace revisit::core
#endif  // HWY_ONCE
