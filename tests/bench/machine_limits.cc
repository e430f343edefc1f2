#include "tests/bench/machine_limits.h"

#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "tests/bench/machine_limits.cc"
#include <hwy/foreach_target.h>
// After foreach_target.h.
#include <hwy/highway.h>

HWY_BEFORE_NAMESPACE();
namespace revisit::bench::HWY_NAMESPACE {

namespace hn = hwy::HWY_NAMESPACE;

using Tag = hn::ScalableTag<double>;
using Vector = hn::Vec<Tag>;

const char* VectorTarget() { return hwy::TargetName(HWY_TARGET); }

std::size_t MultiplyAndAdd(std::size_t rounds, double* sink) {
  const Tag tag;
  const Vector factor = hn::Set(tag, 1.0 + 1e-9);
  const Vector term = hn::Set(tag, 1e-9);
  // Chains enough to hide the latency of each, and no two the same.
  const auto start = [tag](double value)
                         HWY_ATTR { return hn::Set(tag, value); };
  Vector a = start(1.0), b = start(2.0), c = start(3.0), d = start(4.0);
  Vector e = start(5.0), f = start(6.0), p = start(1.0), q = start(2.0);
  Vector r = start(3.0), s = start(4.0), t = start(5.0), u = start(6.0);
  for (std::size_t i = 0; i < rounds; ++i) {
    a = hn::Mul(a, factor);
    p = hn::Add(p, term);
    b = hn::Mul(b, factor);
    q = hn::Add(q, term);
    c = hn::Mul(c, factor);
    r = hn::Add(r, term);
    d = hn::Mul(d, factor);
    s = hn::Add(s, term);
    e = hn::Mul(e, factor);
    t = hn::Add(t, term);
    f = hn::Mul(f, factor);
    u = hn::Add(u, term);
  }
  a = hn::Add(hn::Add(hn::Add(a, b), hn::Add(c, d)), hn::Add(e, f));
  p = hn::Add(hn::Add(hn::Add(p, q), hn::Add(r, s)), hn::Add(t, u));
  *sink = hn::GetLane(hn::SumOfLanes(tag, hn::Add(a, p)));
  return rounds * 12 * hn::Lanes(tag);
}

std::size_t Divide(std::size_t rounds, double* sink) {
  const Tag tag;
  const Vector divisor = hn::Set(tag, 1.0 + 1e-9);
  Vector a = hn::Set(tag, 1.0), b = hn::Set(tag, 2.0);
  Vector c = hn::Set(tag, 3.0), d = hn::Set(tag, 4.0);
  for (std::size_t i = 0; i < rounds; ++i) {
    a = hn::Div(a, divisor);
    b = hn::Div(b, divisor);
    c = hn::Div(c, divisor);
    d = hn::Div(d, divisor);
  }
  *sink =
      hn::GetLane(hn::SumOfLanes(tag, hn::Add(hn::Add(a, b), hn::Add(c, d))));
  return rounds * 4 * hn::Lanes(tag);
}

double ReadNodes(const core::PoseGraph& graph, std::size_t count) {
  const Tag tag;
  Vector sum = hn::Zero(tag);
  using Block = core::NodeBlock;
  for (std::size_t first = 0; first < count; first += Block::kSize) {
    const Block& block = graph.block(first / Block::kSize);
    for (std::size_t g = 0; g < block.groups(); ++g) {
      const double* const rows = block.group(g);
      const std::size_t planar = Block::kPlanarRows * Block::kGroupSize;
      for (std::size_t i = 0; i < planar; i += hn::Lanes(tag)) {
        sum = hn::Or(sum, hn::Load(tag, rows + i));
      }
    }
  }
  return hn::GetLane(sum);
}

}  // namespace revisit::bench::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace revisit::bench {

HWY_EXPORT(VectorTarget);
HWY_EXPORT(MultiplyAndAdd);
HWY_EXPORT(Divide);
HWY_EXPORT(ReadNodes);

std::string VectorTarget() { return HWY_DYNAMIC_DISPATCH(VectorTarget)(); }

std::size_t MultiplyAndAdd(std::size_t rounds, double* sink) {
  return HWY_DYNAMIC_DISPATCH(MultiplyAndAdd)(rounds, sink);
}

std::size_t Divide(std::size_t rounds, double* sink) {
  return HWY_DYNAMIC_DISPATCH(Divide)(rounds, sink);
}

double ReadNodes(const core::PoseGraph& graph, std::size_t count) {
  return HWY_DYNAMIC_DISPATCH(ReadNodes)(graph, count);
}

}  // namespace revisit::bench
#endif  // HWY_ONCE
