#include "core/alignment/similarity_kernel.h"

#include <limits>

#include "core/alignment/log_similarity.h"
#include "core/geometry/heading.h"

// Highway includes this file once for each kind of vectors.
#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "core/alignment/similarity_kernel.cc"
#include <hwy/foreach_target.h>
// After foreach_target.h.
#include <hwy/cache_control.h>
#include <hwy/contrib/math/math-inl.h>
#include <hwy/highway.h>

HWY_BEFORE_NAMESPACE();
namespace revisit::core::HWY_NAMESPACE {

namespace hn = hwy::HWY_NAMESPACE;

// No wider than a row.
using Tag = hn::CappedTag<double, NodeBlock::kGroupSize>;
using Vector = hn::Vec<Tag>;
using Mask = hn::Mask<Tag>;

// The same angle in (-pi, pi], of one in (-3 pi, 3 pi): exact there.
HWY_INLINE Vector Wrap(Tag tag, Vector angle) {
  const Vector pi = hn::Set(tag, kPi);
  const Vector turn = hn::Set(tag, 2.0 * kPi);
  const Vector down = hn::IfThenElseZero(hn::Gt(angle, pi), turn);
  const Vector up = hn::IfThenElseZero(hn::Le(angle, hn::Set(tag, -kPi)), turn);
  return hn::Add(hn::Sub(angle, down), up);
}

// One row of LDL^T less what the rows before it explain, as Evaluate() has it.
struct Sum {
  Mask possible;
  Vector determinant;
  Vector squared;
};

HWY_INLINE void AddPivot(Tag tag, Vector diagonal, Vector pivot, Vector solved,
                         Vector* inverse, Sum* sum) {
  const Vector least = hn::Mul(hn::Set(tag, kPivotTolerance), diagonal);
  const Mask valid =
      hn::And(hn::Gt(pivot, least),
              hn::Lt(pivot, hn::Set(tag, hwy::HighestValue<double>())));
  sum->possible = hn::And(sum->possible, valid);
  *inverse = hn::Div(hn::Set(tag, 1.0), pivot);
  sum->determinant = hn::Mul(sum->determinant, pivot);
  sum->squared =
      hn::Add(sum->squared, hn::Mul(hn::Mul(solved, solved), *inverse));
}

template <int D, bool kDeadReckoning>
HWY_INLINE void EvaluateAll(const KernelQuery& query, const NodeBlock& block,
                            const NodeBlock& next,
                            BlockSimilarity* similarity) {
  const Tag tag;
  const auto set = [tag](double value) HWY_ATTR { return hn::Set(tag, value); };
  const Vector scale = set(query.variance_scale);
  const Vector position_variance = set(query.position_variance);
  const Vector heading_variance = set(query.heading_variance);
  const Vector exponent = set(query.exponent);
  const Vector minus_half = set(-0.5);
  const Vector least_normal = set(std::numeric_limits<double>::min());
  const Vector largest = set(std::numeric_limits<double>::max());
  const bool opposite = query.opposite;
  const Vector query_x = set(query.pose.x);
  const Vector query_y = set(query.pose.y);
  const Vector query_z = set(query.pose.z);
  const Vector query_heading = set(query.pose.heading);

  // What is asked for next lies elsewhere if it is not laid out alike.
  const bool alike =
      next.groups() >= block.groups() && next.spatial() == block.spatial();
  const bool spatial = block.spatial();
  const double* const rows = block.group(0);
  const double* const next_rows = alike ? next.group(0) : rows;
  const std::size_t group_entries = block.rows() * NodeBlock::kGroupSize;
  const std::size_t entries = block.groups() * NodeBlock::kGroupSize;
  for (std::size_t i = 0; i < entries; i += hn::Lanes(tag)) {
    const std::size_t offset =
        i / NodeBlock::kGroupSize * group_entries + i % NodeBlock::kGroupSize;
    const auto load = [tag, rows, next_rows,
                       offset](NodeBlock::Row row) HWY_ATTR {
      const std::size_t at = offset + row * NodeBlock::kGroupSize;
      hwy::Prefetch(next_rows + at);
      return hn::Load(tag, rows + at);
    };
    // Rows that are there only if the block is spatial.
    const auto load_z = [tag, spatial, load](NodeBlock::Row row) HWY_ATTR {
      return spatial ? load(row) : hn::Zero(tag);
    };
    const Vector dx = hn::Sub(query_x, load(NodeBlock::kX));
    const Vector dy = hn::Sub(query_y, load(NodeBlock::kY));
    Vector dh = Wrap(tag, hn::Sub(query_heading, load(NodeBlock::kHeading)));
    if (opposite) dh = Wrap(tag, hn::Add(dh, set(kPi)));

    // Of Gamma without the lever arm.
    const auto base = [&](int r, int c, Vector node) HWY_ATTR {
      const Vector mine = set(query.covariance(r, c));
      return kDeadReckoning ? hn::Sub(mine, node) : hn::Add(mine, node);
    };
    const Vector node_xh = load(NodeBlock::kXH);
    const Vector node_yh = load(NodeBlock::kYH);
    const Vector node_hh = load(NodeBlock::kHH);
    Vector xx = base(0, 0, load(NodeBlock::kXX));
    Vector yx = base(0, 1, load(NodeBlock::kXY));
    Vector yy = base(1, 1, load(NodeBlock::kYY));
    Vector hx = base(0, 3, node_xh);
    Vector hy = base(1, 3, node_yh);
    Vector hh = base(3, 3, node_hh);
    const Vector lever_x = hn::Neg(dy);
    const Vector lever_y = dx;
    if constexpr (kDeadReckoning) {
      const Vector xx_carried = hn::Mul(lever_x, node_xh);
      const Vector yy_carried = hn::Mul(lever_y, node_yh);
      xx = hn::Sub(xx, hn::Add(xx_carried, xx_carried));
      yx = hn::Sub(
          yx, hn::Add(hn::Mul(lever_y, node_xh), hn::Mul(lever_x, node_yh)));
      yy = hn::Sub(yy, hn::Add(yy_carried, yy_carried));
      hx = hn::Sub(hx, hn::Mul(lever_x, node_hh));
      hy = hn::Sub(hy, hn::Mul(lever_y, node_hh));
    }
    xx = hn::Add(hn::Mul(scale, xx), position_variance);
    yx = hn::Mul(scale, yx);
    yy = hn::Add(hn::Mul(scale, yy), position_variance);
    hx = hn::Mul(scale, hx);
    hy = hn::Mul(scale, hy);
    hh = hn::Add(hn::Mul(scale, hh), heading_variance);

    // LDL^T, row by row: of x, y, z if spatial, heading.
    Sum sum = {hn::Eq(minus_half, minus_half), set(1.0), hn::Zero(tag)};
    Vector inverse_x;
    AddPivot(tag, xx, xx, dx, &inverse_x, &sum);

    const Vector lower_yx = hn::Mul(yx, inverse_x);
    const Vector pivot_y = hn::Sub(yy, hn::Mul(lower_yx, yx));
    const Vector solved_y = hn::Sub(dy, hn::Mul(lower_yx, dx));
    Vector inverse_y;
    AddPivot(tag, yy, pivot_y, solved_y, &inverse_y, &sum);

    const Vector lower_hx = hn::Mul(hx, inverse_x);
    Vector pivot_h = hn::Sub(hh, hn::Mul(lower_hx, hx));
    Vector solved_h = hn::Sub(dh, hn::Mul(lower_hx, dx));
    const Vector scaled_hy = hn::Sub(hy, hn::Mul(hx, lower_yx));
    const Vector lower_hy = hn::Mul(scaled_hy, inverse_y);
    pivot_h = hn::Sub(pivot_h, hn::Mul(lower_hy, scaled_hy));
    solved_h = hn::Sub(solved_h, hn::Mul(lower_hy, solved_y));
    Vector pivot_z = pivot_y;
    if constexpr (D == 4) {
      const Vector node_zh = load_z(NodeBlock::kZH);
      Vector zx = base(0, 2, load_z(NodeBlock::kXZ));
      Vector zy = base(1, 2, load_z(NodeBlock::kYZ));
      Vector zz = base(2, 2, load_z(NodeBlock::kZZ));
      Vector hz = base(2, 3, node_zh);
      if constexpr (kDeadReckoning) {
        zx = hn::Sub(zx, hn::Mul(lever_x, node_zh));
        zy = hn::Sub(zy, hn::Mul(lever_y, node_zh));
      }
      zx = hn::Mul(scale, zx);
      zy = hn::Mul(scale, zy);
      zz = hn::Add(hn::Mul(scale, zz), position_variance);
      hz = hn::Mul(scale, hz);

      const Vector dz = hn::Sub(query_z, load_z(NodeBlock::kZ));
      const Vector lower_zx = hn::Mul(zx, inverse_x);
      pivot_z = hn::Sub(zz, hn::Mul(lower_zx, zx));
      Vector solved_z = hn::Sub(dz, hn::Mul(lower_zx, dx));
      const Vector scaled_zy = hn::Sub(zy, hn::Mul(zx, lower_yx));
      const Vector lower_zy = hn::Mul(scaled_zy, inverse_y);
      pivot_z = hn::Sub(pivot_z, hn::Mul(lower_zy, scaled_zy));
      solved_z = hn::Sub(solved_z, hn::Mul(lower_zy, solved_y));
      Vector inverse_z;
      AddPivot(tag, zz, pivot_z, solved_z, &inverse_z, &sum);

      const Vector scaled_hz = hn::Sub(hn::Sub(hz, hn::Mul(hx, lower_zx)),
                                       hn::Mul(scaled_hy, lower_zy));
      const Vector lower_hz = hn::Mul(scaled_hz, inverse_z);
      pivot_h = hn::Sub(pivot_h, hn::Mul(lower_hz, scaled_hz));
      solved_h = hn::Sub(solved_h, hn::Mul(lower_hz, solved_z));
    }
    Vector inverse_h;
    AddPivot(tag, hh, pivot_h, solved_h, &inverse_h, &sum);

    const Mask normal = hn::And(hn::Ge(sum.determinant, least_normal),
                                hn::Le(sum.determinant, largest));
    Vector log_determinant = hn::Log(tag, sum.determinant);
    // As Evaluate(): beyond the range of double, a logarithm a pivot.
    const Mask beyond = hn::AndNot(normal, sum.possible);
    if (HWY_UNLIKELY(!hn::AllFalse(tag, beyond))) {
      Vector logs = hn::Add(hn::Log(tag, xx), hn::Log(tag, pivot_y));
      if constexpr (D == 4) logs = hn::Add(logs, hn::Log(tag, pivot_z));
      logs = hn::Add(logs, hn::Log(tag, pivot_h));
      log_determinant = hn::IfThenElse(normal, log_determinant, logs);
    }
    const Mask possible = hn::And(sum.possible, hn::Le(sum.squared, largest));
    const Vector value = hn::Sub(hn::Mul(minus_half, log_determinant),
                                 hn::Mul(exponent, sum.squared));
    hn::Store(hn::IfThenElse(possible, value, set(kImpossible)), tag,
              similarity->log_similarity.data() + i);
    hn::Store(sum.squared, tag, similarity->squared_mahalanobis.data() + i);
  }
  // Of nodes that there are not.
  for (std::size_t i = entries; i < NodeBlock::kSize; ++i) {
    similarity->log_similarity[i] = kImpossible;
    similarity->squared_mahalanobis[i] = 0.0;
  }
}

void EvaluateBlock(const KernelQuery& query, const NodeBlock& block,
                   const NodeBlock& next, BlockSimilarity* similarity) {
  if (query.state_space == StateSpace::kPlanar) {
    if (query.dead_reckoning) {
      EvaluateAll<3, true>(query, block, next, similarity);
    } else {
      EvaluateAll<3, false>(query, block, next, similarity);
    }
  } else if (query.dead_reckoning) {
    EvaluateAll<4, true>(query, block, next, similarity);
  } else {
    EvaluateAll<4, false>(query, block, next, similarity);
  }
}

}  // namespace revisit::core::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace revisit::core {

HWY_EXPORT(EvaluateBlock);

void EvaluateBlock(const KernelQuery& query, const NodeBlock& block,
                   const NodeBlock& next, BlockSimilarity* similarity) {
  HWY_DYNAMIC_DISPATCH(EvaluateBlock)(query, block, next, similarity);
}

}  // namespace revisit::core
#endif  // HWY_ONCE
