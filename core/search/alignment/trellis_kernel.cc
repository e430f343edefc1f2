#include "core/search/alignment/trellis_kernel.h"

#include <cstring>

// Highway includes this file once per instruction set.
#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "core/search/alignment/trellis_kernel.cc"
#include <hwy/foreach_target.h>
// After foreach_target.h.
#include <hwy/highway.h>

HWY_BEFORE_NAMESPACE();
namespace revisit::core::HWY_NAMESPACE {

namespace hn = hwy::HWY_NAMESPACE;

void StepBlock(const double* leaving, const double* emission, double cost,
               double* next, std::uint8_t* from_after) {
  const hn::ScalableTag<double> tag;
  using Vector = hn::Vec<decltype(tag)>;
  const std::size_t lanes = hn::Lanes(tag);
  const Vector costs = hn::Set(tag, cost);
  unsigned bits = 0;
  for (std::size_t k = 0; k < NodeBlock::kSize; k += lanes) {
    const Vector before = hn::LoadU(tag, leaving + k - 1);
    const Vector after = hn::LoadU(tag, leaving + k + 1);
    const auto is_after = hn::Gt(after, before);
    const Vector best = hn::IfThenElse(is_after, after, before);
    const Vector score = hn::Add(best, hn::LoadU(tag, emission + k));
    hn::StoreU(hn::Sub(score, costs), tag, next + k);
    std::uint8_t mask[8] = {};
    hn::StoreMaskBits(tag, is_after, mask);
    if (lanes >= 8) {
      std::memcpy(from_after + k / 8, mask, lanes / 8);
    } else {
      bits |= static_cast<unsigned>(mask[0]) << (k % 8);
      if ((k + lanes) % 8 == 0) {
        from_after[k / 8] = static_cast<std::uint8_t>(bits);
        bits = 0;
      }
    }
  }
}

}  // namespace revisit::core::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace revisit::core {

HWY_EXPORT(StepBlock);

void StepBlock(const double* leaving, const double* emission, double cost,
               double* next, std::uint8_t* from_after) {
  HWY_DYNAMIC_DISPATCH(StepBlock)(leaving, emission, cost, next, from_after);
}

}  // namespace revisit::core
#endif  // HWY_ONCE
