#include "core/search/alignment/heading_kernel.h"

// Highway includes this file once per instruction set.
#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "core/search/alignment/heading_kernel.cc"
#include <hwy/foreach_target.h>
// After foreach_target.h.
#include <hwy/highway.h>

HWY_BEFORE_NAMESPACE();
namespace revisit::core::HWY_NAMESPACE {

namespace hn = hwy::HWY_NAMESPACE;

// Turns are rounded three times: each node's heading, its end's, and that of
// the recent path.
constexpr float kRounded = 1.5F;

void BoundRatios(const std::uint8_t* bins,
                 const std::vector<HeadingStep>& steps, float least,
                 std::ptrdiff_t slips, BlockRatios* most) {
  const hn::CappedTag<float, NodeBlock::kSize> tag;
  const hn::Rebind<std::int32_t, decltype(tag)> wide;
  const hn::Rebind<std::int8_t, decltype(tag)> narrow;
  const hn::Rebind<std::uint8_t, decltype(tag)> bytes;
  const std::size_t lanes = hn::Lanes(tag);
  const auto zero = hn::Zero(tag);
  const auto rounded = hn::Set(tag, kRounded);
  const auto half = hn::Set(tag, 0.5F);
  const auto all = hn::Set(tag, steps.back().most_ratio);
  for (std::size_t i = 0; i < NodeBlock::kSize; i += lanes) {
    const auto end = hn::LoadU(bytes, bins + i);
    auto drift = zero;
    auto squares = zero;
    auto best = hn::Set(tag, least);
    for (const HeadingStep& step : steps) {
      const auto wanted = hn::Add(end, hn::Set(bytes, step.turn));
      // Wraps as headings do.
      const auto mismatch = [&](std::ptrdiff_t slip) HWY_ATTR {
        return hn::BitCast(
            narrow,
            hn::Sub(wanted, hn::LoadU(bytes, bins + i + step.offset + slip)));
      };
      const auto early = mismatch(-slips);
      const auto on_time = mismatch(0);
      const auto late = mismatch(slips);
      const auto to_float = [&](hn::Vec<decltype(narrow)> value) HWY_ATTR {
        return hn::ConvertTo(tag, hn::PromoteTo(wide, value));
      };
      const auto low =
          hn::Sub(to_float(hn::Min(hn::Min(early, late), on_time)), rounded);
      const auto high =
          hn::Add(to_float(hn::Max(hn::Max(early, late), on_time)), rounded);
      const auto innovation =
          hn::Sub(hn::Min(hn::Max(drift, low), high), drift);
      squares = hn::Add(squares, hn::Mul(hn::Mul(innovation, innovation),
                                         hn::Set(tag, step.information)));
      drift = hn::Add(drift, hn::Mul(hn::Set(tag, step.gain), innovation));
      const auto cost = hn::Mul(half, squares);
      best = hn::Max(best, hn::Sub(hn::Set(tag, step.most_ratio), cost));
      // No later step can gain more.
      if (hn::AllFalse(tag, hn::Gt(hn::Sub(all, cost), best))) break;
    }
    hn::StoreU(best, tag, most->data() + i);
  }
}

}  // namespace revisit::core::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace revisit::core {

HWY_EXPORT(BoundRatios);

void BoundRatios(const std::uint8_t* bins,
                 const std::vector<HeadingStep>& steps, float least,
                 std::ptrdiff_t slips, BlockRatios* most) {
  HWY_DYNAMIC_DISPATCH(BoundRatios)(bins, steps, least, slips, most);
}

}  // namespace revisit::core
#endif  // HWY_ONCE
