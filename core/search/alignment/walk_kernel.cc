#include "core/search/alignment/walk_kernel.h"

#include <algorithm>
#include <limits>
#include <utility>

#include "core/geometry/heading.h"

// Highway includes this file once per instruction set.
#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "core/search/alignment/walk_kernel.cc"
#include <hwy/foreach_target.h>
// After foreach_target.h.
#include <hwy/highway.h>

HWY_BEFORE_NAMESPACE();
namespace revisit::core::HWY_NAMESPACE {

namespace hn = hwy::HWY_NAMESPACE;

// Copies the poses at which the walkers would be next into their columns, for
// all walkers in advance: gathering with vectors is slower on most machines.
void Fetch(const double* poses, std::size_t count, Walkers* walkers) {
  const std::int64_t* const nodes = walkers->indices(Walkers::kNode);
  const std::int64_t* const strides = walkers->indices(Walkers::kStride);
  const std::int64_t* const lasts = walkers->indices(Walkers::kLast);
  double* const x = walkers->column(Walkers::kThere);
  double* const y = walkers->column(Walkers::kThere + 1);
  double* const z = walkers->column(Walkers::kThere + 2);
  double* const heading = walkers->column(Walkers::kThere + 3);
  for (std::size_t i = 0; i < count; ++i) {
    const std::int64_t stride = nodes[i] == lasts[i] ? 0 : strides[i];
    const double* const pose = poses + 4 * (nodes[i] + stride);
    x[i] = pose[0];
    y[i] = pose[1];
    z[i] = pose[2];
    heading[i] = pose[3];
  }
}

template <int D>
HWY_INLINE void WalkAllOn(const WalkStep& step, std::size_t count,
                          Walkers* walkers, std::vector<Unsettled>* unsettled) {
  const hn::ScalableTag<double> tag;
  const hn::RebindToSigned<decltype(tag)> index_tag;
  using Vector = hn::Vec<decltype(tag)>;
  constexpr int h = D - 1;
  const auto set = [tag](double value) HWY_ATTR { return hn::Set(tag, value); };
  const std::size_t lanes = hn::Lanes(tag);
  // Local copies, which no store can change.
  const std::size_t room = walkers->room();
  double* const columns = walkers->column(0);
  std::int64_t* const nodes = walkers->indices(Walkers::kNode);
  const std::int64_t* const strides = walkers->indices(Walkers::kStride);
  const std::int64_t* const lasts = walkers->indices(Walkers::kLast);
  for (std::size_t i = 0; i < count; i += lanes) {
    double* const here = columns + i;
    const auto load = [tag, here, room](std::size_t column) HWY_ATTR {
      return hn::LoadU(tag, here + column * room);
    };
    const auto store =
        [tag, here, room](std::size_t column, Vector value)
            HWY_ATTR { hn::StoreU(value, tag, here + column * room); };
    const auto node = hn::LoadU(index_tag, nodes + i);
    const auto stride = hn::LoadU(index_tag, strides + i);
    const auto last = hn::LoadU(index_tag, lasts + i);
    const auto at_last = hn::Eq(node, last);
    const auto next = hn::IfThenElse(at_last, node, hn::Add(node, stride));
    const Vector end_x = load(Walkers::kX);
    const Vector end_y = load(Walkers::kY);
    const Vector end_heading = load(Walkers::kHeading);
    const Vector cosine = load(Walkers::kCosine);
    const Vector sine = load(Walkers::kSine);
    Vector now[D];
    for (std::size_t r = 0; r < D; ++r) now[r] = load(Walkers::kNow + r);
    now[0] = hn::Sub(now[0], hn::Mul(set(step.step_y), now[h]));
    now[1] = hn::Add(now[1], hn::Mul(set(step.step_x), now[h]));
    Vector innovation[D];
    // The next pose, seen from the end.
    const Vector x = hn::Sub(load(Walkers::kThere), end_x);
    const Vector y = hn::Sub(load(Walkers::kThere + 1), end_y);
    innovation[0] = hn::Add(hn::Mul(cosine, x), hn::Mul(sine, y));
    innovation[1] = hn::Sub(hn::Mul(cosine, y), hn::Mul(sine, x));
    if constexpr (D == 4) {
      innovation[2] = hn::Sub(load(Walkers::kThere + 2), load(Walkers::kZ));
    }
    innovation[h] = hn::Sub(load(Walkers::kThere + 3), end_heading);
    for (int r = 0; r < D; ++r) {
      innovation[r] =
          hn::Sub(hn::Sub(set(step.path[r]), innovation[r]), now[r]);
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
    Vector squared = hn::Zero(tag);
    for (int r = 0; r < D; ++r) {
      Vector whitened = hn::Mul(set(step.whitening[r][r]), innovation[r]);
      for (int c = r + 1; c < D; ++c) {
        whitened = hn::Add(whitened,
                           hn::Mul(set(step.whitening[r][c]), innovation[c]));
      }
      squared = hn::Add(squared, hn::Mul(whitened, whitened));
    }
    const Vector gained =
        hn::Sub(set(step.surprise), hn::Mul(set(0.5), squared));
    // Written so that NaN does not walk on.
    const auto on = hn::And(hn::FirstN(tag, count - i),
                            hn::AndNot(hn::RebindMask(tag, at_last),
                                       hn::Le(squared, set(step.settled))));

    const Vector ratio =
        hn::Add(load(Walkers::kRatio), hn::IfThenElseZero(on, gained));
    const Vector squares =
        hn::Add(load(Walkers::kSquared), hn::IfThenElseZero(on, squared));
    Vector best_ratio = load(Walkers::kBestRatio);
    const auto better = hn::And(on, hn::Gt(ratio, best_ratio));
    best_ratio = hn::IfThenElse(better, ratio, best_ratio);
    store(Walkers::kRatio, ratio);
    store(Walkers::kSquared, squares);
    const bool any_better = !hn::AllFalse(tag, better);
    const auto keep_if_better = [&](std::size_t column, Vector value) HWY_ATTR {
      store(column, hn::IfThenElse(better, value, load(column)));
    };
    if (any_better) {
      store(Walkers::kBestRatio, best_ratio);
      keep_if_better(Walkers::kBestSquared, squares);
      keep_if_better(Walkers::kBestSteps, set(step.number));
    }
    for (std::size_t r = 0; r < D; ++r) {
      const int row = static_cast<int>(r);
      store(Walkers::kNow + r,
            hn::IfThenElse(on, hn::Add(now[r], times(step.gain, row)),
                           load(Walkers::kNow + r)));
      const Vector before = load(Walkers::kAtEnd + r);
      const Vector at_end =
          hn::Add(before, hn::IfThenElseZero(on, times(step.end_gain, row)));
      store(Walkers::kAtEnd + r, at_end);
      if (any_better) keep_if_better(Walkers::kBestAtEnd + r, at_end);
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
    HWY_ALIGN double squares_of[hn::MaxLanes(tag)];
    hn::Store(
        hn::IfThenElse(hn::RebindMask(tag, at_last),
                       set(std::numeric_limits<double>::infinity()), squared),
        tag, squares_of);
    for (std::size_t k = 0; k < lanes && i + k < count; ++k) {
      const auto bit = [k](const std::uint8_t* bits) {
        return (bits[k / 8] >> (k % 8) & 1) != 0;
      };
      if (bit(settled_bits)) continue;
      unsettled->push_back({i + k, bit(on_bits), squares_of[k]});
    }
  }
}

void WalkOn(StateSpace state_space, const WalkStep& step, const double* poses,
            std::size_t count, Walkers* walkers,
            std::vector<Unsettled>* unsettled) {
  unsettled->clear();
  Fetch(poses, count, walkers);
  if (state_space == StateSpace::kPlanar) {
    WalkAllOn<3>(step, count, walkers, unsettled);
  } else {
    WalkAllOn<4>(step, count, walkers, unsettled);
  }
}

}  // namespace revisit::core::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace revisit::core {

HWY_EXPORT(WalkOn);

void WalkOn(StateSpace state_space, const WalkStep& step, const double* poses,
            std::size_t count, Walkers* walkers,
            std::vector<Unsettled>* unsettled) {
  HWY_DYNAMIC_DISPATCH(WalkOn)
  (state_space, step, poses, count, walkers, unsettled);
}

std::size_t Walkers::Add() {
  if (size_ == room_) Grow(size_ + 1);
  return size_++;
}

void Walkers::Begin(std::size_t count) {
  size_ = 0;
  if (count > room_) Grow(count);
  size_ = count;
  for (std::size_t c = 0; c < kColumns; ++c) {
    std::fill_n(column(c), count, 0.0);
  }
  for (std::size_t c = 0; c < kIndices; ++c) {
    std::fill_n(indices(static_cast<Index>(c)), count, 0);
  }
}

void Walkers::Grow(std::size_t least) {
  // Whole vectors of any machine. Entries beyond the last walker are read but
  // not used; they name node 0, which exists.
  std::size_t room = std::max<std::size_t>(64, 2 * room_);
  while (room < least) room *= 2;
  std::vector<double> columns(kColumns * room);
  std::vector<std::int64_t> indices(kIndices * room);
  for (std::size_t i = 0; i < size_; ++i) {
    for (std::size_t c = 0; c < kColumns; ++c) {
      columns[c * room + i] = columns_[c * room_ + i];
    }
    for (std::size_t c = 0; c < kIndices; ++c) {
      indices[c * room + i] = indices_[c * room_ + i];
    }
  }
  columns_ = std::move(columns);
  indices_ = std::move(indices);
  room_ = room;
}

void Walkers::Copy(std::size_t from, std::size_t to) {
  for (std::size_t c = 0; c < kColumns; ++c) {
    columns_[c * room_ + to] = columns_[c * room_ + from];
  }
  for (std::size_t c = 0; c < kIndices; ++c) {
    indices_[c * room_ + to] = indices_[c * room_ + from];
  }
}

void Walkers::Remove(std::size_t i) {
  --size_;
  if (i != size_) Copy(size_, i);
}

}  // namespace revisit::core
#endif  // HWY_ONCE
