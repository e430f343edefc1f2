#include "core/search/alignment/heading_kernel.h"

#include <algorithm>

// Highway includes this file once per instruction set.
#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "core/search/alignment/heading_kernel.cc"
#include <hwy/foreach_target.h>
// After foreach_target.h.
#include <hwy/highway.h>

HWY_BEFORE_NAMESPACE();
namespace revisit::core::HWY_NAMESPACE {

namespace hn = hwy::HWY_NAMESPACE;

// Two bins are rounded for each turn: the node's, and its end's.
constexpr float kRounded = 1.0F;

// Slips leave a heading open by so many bins where it counts closely.
constexpr float kMostOpen = 4.0F;

using Floats = hn::CappedTag<float, NodeBlock::kSize>;
using Vector = hn::Vec<Floats>;

// By how much an innovation moves the drift, and what its square costs.
struct Weights {
  Vector gain;
  Vector information;
};

// The ratios of the ends whose bins begin at `bins`, a vector of them; where
// all are below `enough`, that. weigh(step, open): the weights of a step whose
// heading slips leave open by so many bins.
template <typename Weigh>
HWY_INLINE Vector BoundAt(const std::uint8_t* bins,
                          const std::vector<HeadingStep>& steps, float enough,
                          std::ptrdiff_t slips, const Weigh& weigh) {
  const Floats tag;
  const hn::Rebind<std::int32_t, Floats> wide;
  const hn::Rebind<std::int8_t, Floats> narrow;
  const hn::Rebind<std::uint8_t, Floats> bytes;
  const auto half = hn::Set(tag, 0.5F);
  const auto all = hn::Set(tag, steps.back().most_ratio);
  const auto end = hn::LoadU(bytes, bins);
  auto drift = hn::Zero(tag);
  auto squares = hn::Zero(tag);
  auto best = hn::Set(tag, enough);
  for (const HeadingStep& step : steps) {
    const auto wanted = hn::Add(end, hn::Set(bytes, step.turn));
    // Wraps as headings do.
    const auto mismatch = [&](std::ptrdiff_t slip) HWY_ATTR {
      return hn::BitCast(
          narrow, hn::Sub(wanted, hn::LoadU(bytes, bins + step.offset + slip)));
    };
    const auto early = mismatch(-slips);
    const auto on_time = mismatch(0);
    const auto late = mismatch(slips);
    const auto to_float = [&](hn::Vec<decltype(narrow)> value) HWY_ATTR {
      return hn::ConvertTo(tag, hn::PromoteTo(wide, value));
    };
    const auto least = to_float(hn::Min(hn::Min(early, late), on_time));
    const auto most = to_float(hn::Max(hn::Max(early, late), on_time));
    const auto low = hn::Add(least, hn::Set(tag, step.rest - kRounded));
    const auto high = hn::Add(most, hn::Set(tag, step.rest + kRounded));
    const auto innovation = hn::Sub(hn::Min(hn::Max(drift, low), high), drift);
    const Weights weights = weigh(step, hn::Sub(most, least));
    squares = hn::Add(
        squares, hn::Mul(hn::Mul(innovation, innovation), weights.information));
    drift = hn::Add(drift, hn::Mul(weights.gain, innovation));
    const auto cost = hn::Mul(half, squares);
    best = hn::Max(best, hn::Sub(hn::Set(tag, step.most_ratio), cost));
    // No later step can gain more.
    if (hn::AllFalse(tag, hn::Gt(hn::Sub(all, cost), best))) break;
  }
  return best;
}

void BoundRatios(const std::uint8_t* bins,
                 const std::vector<HeadingStep>& steps, float least,
                 std::ptrdiff_t slips, BlockRatios* most) {
  const Floats tag;
  const auto weigh = [tag](const HeadingStep& step, Vector) HWY_ATTR {
    return Weights{hn::Set(tag, step.gain), hn::Set(tag, step.information)};
  };
  for (std::size_t i = 0; i < NodeBlock::kSize; i += hn::Lanes(tag)) {
    hn::StoreU(BoundAt(bins + i, steps, least, slips, weigh), tag,
               most->data() + i);
  }
}

void LowerRatios(const std::uint8_t* bins,
                 const std::vector<HeadingStep>& steps,
                 const HeadingVariances& variances, float least,
                 std::ptrdiff_t slips, float enough, BlockRatios* most) {
  const Floats tag;
  const auto noise = hn::Set(tag, variances.noise);
  const auto straying = hn::Set(tag, variances.straying);
  const auto open = hn::Set(tag, kMostOpen);
  for (std::size_t i = 0; i < NodeBlock::kSize; i += hn::Lanes(tag)) {
    const auto before = hn::LoadU(tag, most->data() + i);
    const auto may_fall = hn::Gt(before, hn::Set(tag, enough));
    if (hn::AllFalse(tag, may_fall)) continue;
    // The variance of the drift only grows where a heading does not count.
    auto variance = hn::Set(tag, variances.end);
    const auto weigh = [&](const HeadingStep&, Vector is_open) HWY_ATTR {
      variance = hn::Add(variance, noise);
      const auto information = hn::IfThenElseZero(
          hn::Le(is_open, open),
          hn::Div(hn::Set(tag, 1.0F), hn::Add(variance, straying)));
      const auto gain = hn::Mul(variance, information);
      variance = hn::Sub(variance, hn::Mul(gain, variance));
      return Weights{gain, information};
    };
    const auto lower = hn::Min(
        before,
        BoundAt(bins + i, steps, std::max(least, enough), slips, weigh));
    hn::StoreU(hn::IfThenElse(may_fall, lower, before), tag, most->data() + i);
  }
}

}  // namespace revisit::core::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace revisit::core {

HWY_EXPORT(BoundRatios);
HWY_EXPORT(LowerRatios);

void BoundRatios(const std::uint8_t* bins,
                 const std::vector<HeadingStep>& steps, float least,
                 std::ptrdiff_t slips, BlockRatios* most) {
  HWY_DYNAMIC_DISPATCH(BoundRatios)(bins, steps, least, slips, most);
}

void LowerRatios(const std::uint8_t* bins,
                 const std::vector<HeadingStep>& steps,
                 const HeadingVariances& variances, float least,
                 std::ptrdiff_t slips, float enough, BlockRatios* most) {
  HWY_DYNAMIC_DISPATCH(LowerRatios)
  (bins, steps, variances, least, slips, enough, most);
}

}  // namespace revisit::core
#endif  // HWY_ONCE
