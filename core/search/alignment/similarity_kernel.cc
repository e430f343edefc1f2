#include "core/search/alignment/similarity_kernel.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "core/geometry/heading.h"
#include "core/geometry/quadratic_form.h"
#include "core/geometry/state_matrix.h"
#include "core/search/alignment/log_similarity.h"

// Highway includes this file once per instruction set.
#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "core/search/alignment/similarity_kernel.cc"
#include <hwy/foreach_target.h>
// After foreach_target.h.
#include <hwy/cache_control.h>
#include <hwy/contrib/math/math-inl.h>
#include <hwy/highway.h>

HWY_BEFORE_NAMESPACE();
namespace revisit::core::HWY_NAMESPACE {

namespace hn = hwy::HWY_NAMESPACE;

// Vectors no wider than a row.
using Tag = hn::CappedTag<double, NodeBlock::kGroupSize>;
using Vector = hn::Vec<Tag>;
using Mask = hn::Mask<Tag>;

// The same angle in (-pi, pi]. Exact for angles in (-3 pi, 3 pi).
HWY_INLINE Vector Wrap(Tag tag, Vector angle) {
  const Vector pi = hn::Set(tag, kPi);
  const Vector turn = hn::Set(tag, 2.0 * kPi);
  const Vector down = hn::IfThenElseZero(hn::Gt(angle, pi), turn);
  const Vector up = hn::IfThenElseZero(hn::Le(angle, hn::Set(tag, -kPi)), turn);
  return hn::Add(hn::Sub(angle, down), up);
}

// The sums over the rows of LDL^T, as in Evaluate().
struct Sum {
  Mask possible;
  Vector determinant;
  Vector squared;
};

// Adds one row: `pivot` is its diagonal entry less what the rows before
// explain.
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

// Differences and their covariances, in the order of the state.
template <int D>
struct State {
  // It leaves the vectors as they are. A constructor that the compiler makes by
  // itself lacks the attributes of the instruction set.
  HWY_INLINE State() {}  // NOLINT(modernize-use-equals-default)

  Vector difference[D];
  // (r, c) with c <= r.
  Vector covariance[D][D];
};

// Reads a block, and on the way fetches the one that will be read next.
class Rows {
 public:
  Rows(const NodeBlock& block, const NodeBlock& next)
      : rows_(block.group(0)),
        // A block of another layout cannot be fetched by the same offsets.
        next_rows_(next.groups() >= block.groups() &&
                           next.spatial() == block.spatial()
                       ? next.group(0)
                       : rows_),
        group_entries_(block.rows() * NodeBlock::kGroupSize),
        spatial_(block.spatial()) {}

  // A row's entries for the nodes from i on.
  HWY_INLINE Vector Load(NodeBlock::Row row, std::size_t i) const {
    const std::size_t at = i / NodeBlock::kGroupSize * group_entries_ +
                           i % NodeBlock::kGroupSize +
                           row * NodeBlock::kGroupSize;
    hwy::Prefetch(next_rows_ + at);
    return hn::Load(Tag(), rows_ + at);
  }
  // Loads a row that only spatial blocks have; for planar ones it returns 0.
  HWY_INLINE Vector LoadZ(NodeBlock::Row row, std::size_t i) const {
    return spatial_ ? Load(row, i) : hn::Zero(Tag());
  }

 private:
  const double* rows_;
  const double* next_rows_;
  std::size_t group_entries_;
  bool spatial_;
};

HWY_INLINE std::size_t EntriesOf(const NodeBlock& block) {
  return block.groups() * NodeBlock::kGroupSize;
}

// How Gamma is made (DifferenceForm), where it is a sum in whole or in a share
// that differs from node to node, or over two frames (TiedTerms).
enum class Form { kGrown, kSummed, kSharesSummed, kTied };

// The differences of the nodes from i on, and their covariances: Gamma,
// inflated, plus R.
template <int D, Form kForm>
HWY_INLINE State<D> FindState(const KernelQuery& query, const Rows& rows,
                              const BlockShares* shares, std::size_t i) {
  const Tag tag;
  constexpr int h = D - 1;
  const auto set = [tag](double value) HWY_ATTR { return hn::Set(tag, value); };
  const auto load = [&rows, i](NodeBlock::Row row)
                        HWY_ATTR { return rows.Load(row, i); };
  const auto load_z = [&rows, i](NodeBlock::Row row)
                          HWY_ATTR { return rows.LoadZ(row, i); };
  constexpr bool kIsGrown = kForm == Form::kGrown;
  constexpr bool kIsTied = kForm == Form::kTied;
  const Vector scale = set(kIsTied ? 1.0 : query.variance_scale);
  const Vector position_variance = set(query.position_variance);
  State<D> state;
  const Vector dx = hn::Sub(set(query.pose.x), load(NodeBlock::kX));
  const Vector dy = hn::Sub(set(query.pose.y), load(NodeBlock::kY));
  Vector dh =
      Wrap(tag, hn::Sub(set(query.pose.heading), load(NodeBlock::kHeading)));
  if (query.opposite) dh = Wrap(tag, hn::Add(dh, set(kPi)));
  state.difference[0] = dx;
  state.difference[1] = dy;
  state.difference[h] = dh;

  // An entry of Gamma without the lever arm.
  const auto base = [&](int r, int c, Vector node) HWY_ATTR {
    const Vector mine = set(query.covariance(r, c));
    if constexpr (kForm == Form::kSharesSummed) {
      return hn::Mul(hn::Load(tag, shares->data() + i), hn::Add(mine, node));
    }
    if constexpr (kIsTied) {
      return hn::Add(mine, hn::Mul(set(query.tied->node_scale), node));
    }
    return kIsGrown ? hn::Sub(mine, node) : hn::Add(mine, node);
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
  if constexpr (kIsTied) {
    // L M L^T, with the lever arm J (p_j - p).
    const auto m = [&](int r, int c)
                       HWY_ATTR { return set(query.tied->swung[r][c]); };
    const Vector arm_x = hn::Sub(set(query.tied->y), load(NodeBlock::kY));
    const Vector arm_y = hn::Sub(load(NodeBlock::kX), set(query.tied->x));
    const Vector swung_xh = hn::Add(m(0, h), hn::Mul(arm_x, m(h, h)));
    const Vector swung_yh = hn::Add(m(1, h), hn::Mul(arm_y, m(h, h)));
    const Vector both_x = hn::Add(swung_xh, m(0, h));
    const Vector both_y = hn::Add(swung_yh, m(1, h));
    xx = hn::Add(xx, hn::Add(m(0, 0), hn::Mul(arm_x, both_x)));
    yy = hn::Add(yy, hn::Add(m(1, 1), hn::Mul(arm_y, both_y)));
    yx = hn::Add(yx, hn::Add(m(0, 1), hn::Add(hn::Mul(arm_y, swung_xh),
                                              hn::Mul(arm_x, m(1, h)))));
    hx = hn::Add(hx, swung_xh);
    hy = hn::Add(hy, swung_yh);
    hh = hn::Add(hh, m(h, h));
  }
  if constexpr (kIsGrown) {
    const Vector xx_carried = hn::Mul(lever_x, node_xh);
    const Vector yy_carried = hn::Mul(lever_y, node_yh);
    xx = hn::Sub(xx, hn::Add(xx_carried, xx_carried));
    yx = hn::Sub(yx,
                 hn::Add(hn::Mul(lever_y, node_xh), hn::Mul(lever_x, node_yh)));
    yy = hn::Sub(yy, hn::Add(yy_carried, yy_carried));
    hx = hn::Sub(hx, hn::Mul(lever_x, node_hh));
    hy = hn::Sub(hy, hn::Mul(lever_y, node_hh));
  }
  state.covariance[0][0] = hn::Add(hn::Mul(scale, xx), position_variance);
  state.covariance[1][0] = hn::Mul(scale, yx);
  state.covariance[1][1] = hn::Add(hn::Mul(scale, yy), position_variance);
  state.covariance[h][0] = hn::Mul(scale, hx);
  state.covariance[h][1] = hn::Mul(scale, hy);
  state.covariance[h][h] =
      hn::Add(hn::Mul(scale, hh), set(query.heading_variance));
  if constexpr (D == 4) {
    const Vector node_zh = load_z(NodeBlock::kZH);
    Vector zx = base(0, 2, load_z(NodeBlock::kXZ));
    Vector zy = base(1, 2, load_z(NodeBlock::kYZ));
    Vector zz = base(2, 2, load_z(NodeBlock::kZZ));
    Vector hz = base(2, 3, node_zh);
    if constexpr (kIsGrown) {
      zx = hn::Sub(zx, hn::Mul(lever_x, node_zh));
      zy = hn::Sub(zy, hn::Mul(lever_y, node_zh));
    }
    if constexpr (kIsTied) {
      const auto m = [&](int r, int c)
                         HWY_ATTR { return set(query.tied->swung[r][c]); };
      const Vector arm_x = hn::Sub(set(query.tied->y), load(NodeBlock::kY));
      const Vector arm_y = hn::Sub(load(NodeBlock::kX), set(query.tied->x));
      zx = hn::Add(zx, hn::Add(m(2, 0), hn::Mul(arm_x, m(2, h))));
      zy = hn::Add(zy, hn::Add(m(2, 1), hn::Mul(arm_y, m(2, h))));
      zz = hn::Add(zz, m(2, 2));
      hz = hn::Add(hz, m(2, h));
    }
    state.difference[2] = hn::Sub(set(query.pose.z), load_z(NodeBlock::kZ));
    state.covariance[2][0] = hn::Mul(scale, zx);
    state.covariance[2][1] = hn::Mul(scale, zy);
    state.covariance[2][2] = hn::Add(hn::Mul(scale, zz), position_variance);
    state.covariance[3][2] = hn::Mul(scale, hz);
  }
  return state;
}

// The results of Evaluate().
struct Terms {
  HWY_INLINE Terms() {}  // NOLINT(modernize-use-equals-default): as for State.

  Mask possible;
  Vector log_determinant;
  Vector squared;
};

template <int D>
HWY_INLINE Terms Evaluate(const State<D>& state) {
  const Tag tag;
  constexpr int h = D - 1;
  const auto set = [tag](double value) HWY_ATTR { return hn::Set(tag, value); };
  const Vector least_normal = set(std::numeric_limits<double>::min());
  const Vector largest = set(std::numeric_limits<double>::max());
  const Vector(&d)[D] = state.difference;
  const Vector(&covariance)[D][D] = state.covariance;
  const Vector xx = covariance[0][0];
  const Vector yx = covariance[1][0];
  const Vector yy = covariance[1][1];
  const Vector hx = covariance[h][0];
  const Vector hy = covariance[h][1];
  const Vector hh = covariance[h][h];

  // LDL^T, row by row: x, y, z if spatial, heading.
  const Vector one = set(1.0);
  Sum sum = {hn::Eq(one, one), one, hn::Zero(tag)};
  Vector inverse_x;
  AddPivot(tag, xx, xx, d[0], &inverse_x, &sum);

  const Vector lower_yx = hn::Mul(yx, inverse_x);
  const Vector pivot_y = hn::Sub(yy, hn::Mul(lower_yx, yx));
  const Vector solved_y = hn::Sub(d[1], hn::Mul(lower_yx, d[0]));
  Vector inverse_y;
  AddPivot(tag, yy, pivot_y, solved_y, &inverse_y, &sum);

  const Vector lower_hx = hn::Mul(hx, inverse_x);
  Vector pivot_h = hn::Sub(hh, hn::Mul(lower_hx, hx));
  Vector solved_h = hn::Sub(d[h], hn::Mul(lower_hx, d[0]));
  const Vector scaled_hy = hn::Sub(hy, hn::Mul(hx, lower_yx));
  const Vector lower_hy = hn::Mul(scaled_hy, inverse_y);
  pivot_h = hn::Sub(pivot_h, hn::Mul(lower_hy, scaled_hy));
  solved_h = hn::Sub(solved_h, hn::Mul(lower_hy, solved_y));
  Vector pivot_z = pivot_y;
  if constexpr (D == 4) {
    const Vector zx = covariance[2][0];
    const Vector zy = covariance[2][1];
    const Vector zz = covariance[2][2];
    const Vector hz = covariance[3][2];
    const Vector lower_zx = hn::Mul(zx, inverse_x);
    pivot_z = hn::Sub(zz, hn::Mul(lower_zx, zx));
    Vector solved_z = hn::Sub(d[2], hn::Mul(lower_zx, d[0]));
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
  Terms terms;
  terms.log_determinant = hn::Log(tag, sum.determinant);
  // Beyond the range of double, one logarithm per pivot, as in Evaluate().
  const Mask beyond = hn::AndNot(normal, sum.possible);
  if (HWY_UNLIKELY(!hn::AllFalse(tag, beyond))) {
    Vector logs = hn::Add(hn::Log(tag, xx), hn::Log(tag, pivot_y));
    if constexpr (D == 4) logs = hn::Add(logs, hn::Log(tag, pivot_z));
    logs = hn::Add(logs, hn::Log(tag, pivot_h));
    terms.log_determinant = hn::IfThenElse(normal, terms.log_determinant, logs);
  }
  terms.possible = hn::And(sum.possible, hn::Le(sum.squared, largest));
  terms.squared = sum.squared;
  return terms;
}

template <int D, Form kForm>
HWY_INLINE void EvaluateAll(const KernelQuery& query, const NodeBlock& block,
                            const NodeBlock& next, const BlockShares* shares,
                            BlockSimilarity* similarity) {
  const Tag tag;
  const Vector minus_half = hn::Set(tag, -0.5);
  const Vector exponent = hn::Set(tag, query.exponent);
  const Vector impossible = hn::Set(tag, kImpossible);
  const Rows rows(block, next);
  const std::size_t entries = EntriesOf(block);
  for (std::size_t i = 0; i < entries; i += hn::Lanes(tag)) {
    const Terms terms =
        Evaluate<D>(FindState<D, kForm>(query, rows, shares, i));
    const Vector value = hn::Sub(hn::Mul(minus_half, terms.log_determinant),
                                 hn::Mul(exponent, terms.squared));
    hn::Store(hn::IfThenElse(terms.possible, value, impossible), tag,
              similarity->log_similarity.data() + i);
    hn::Store(terms.squared, tag, similarity->squared_mahalanobis.data() + i);
  }
  // Entries without a node.
  for (std::size_t i = entries; i < NodeBlock::kSize; ++i) {
    similarity->log_similarity[i] = kImpossible;
    similarity->squared_mahalanobis[i] = 0.0;
  }
}

template <int D>
HWY_INLINE void EvaluateBlockIn(const KernelQuery& query,
                                const NodeBlock& block, const NodeBlock& next,
                                const BlockShares* shares,
                                BlockSimilarity* similarity) {
  if (query.form == DifferenceForm::kGrown) {
    EvaluateAll<D, Form::kGrown>(query, block, next, shares, similarity);
  } else if (shares == nullptr) {
    EvaluateAll<D, Form::kSummed>(query, block, next, shares, similarity);
  } else {
    EvaluateAll<D, Form::kSharesSummed>(query, block, next, shares, similarity);
  }
}

void EvaluateBlock(const KernelQuery& query, const NodeBlock& block,
                   const NodeBlock& next, const BlockShares* shares,
                   BlockSimilarity* similarity) {
  if (query.state_space == StateSpace::kPlanar) {
    EvaluateBlockIn<3>(query, block, next, shares, similarity);
  } else {
    EvaluateBlockIn<4>(query, block, next, shares, similarity);
  }
}

HWY_INLINE std::size_t Packed(int r, int c) {
  return static_cast<std::size_t>(r * (r + 1) / 2 + c);
}

template <int D>
HWY_INLINE State<D> LoadState(const DifferenceBlock& differences,
                              std::size_t i) {
  const Tag tag;
  State<D> state;
  for (int r = 0; r < D; ++r) {
    state.difference[r] = hn::Load(
        tag, differences.difference[static_cast<std::size_t>(r)].data() + i);
    for (int c = 0; c <= r; ++c) {
      state.covariance[r][c] =
          hn::Load(tag, differences.covariance[Packed(r, c)].data() + i);
    }
  }
  return state;
}

template <int D>
HWY_INLINE void StoreState(const State<D>& state, std::size_t i,
                           DifferenceBlock* differences) {
  const Tag tag;
  for (int r = 0; r < D; ++r) {
    hn::Store(state.difference[r], tag,
              differences->difference[static_cast<std::size_t>(r)].data() + i);
    for (int c = 0; c <= r; ++c) {
      hn::Store(state.covariance[r][c], tag,
                differences->covariance[Packed(r, c)].data() + i);
    }
  }
}

template <int D, Form kForm>
HWY_INLINE void FindAll(const KernelQuery& query, const NodeBlock& block,
                        const NodeBlock& next, const BlockShares* shares,
                        DifferenceBlock* differences, const EntryRange& range) {
  const Rows rows(block, next);
  const std::size_t entries =
      std::min({EntriesOf(block), differences->count, range.last});
  for (std::size_t i = range.first; i < entries; i += hn::Lanes(Tag())) {
    StoreState<D>(FindState<D, kForm>(query, rows, shares, i), i, differences);
  }
}

template <int D>
HWY_INLINE void FindDifferencesIn(const KernelQuery& query,
                                  const NodeBlock& block, const NodeBlock& next,
                                  const BlockShares* shares,
                                  DifferenceBlock* differences,
                                  const EntryRange& range) {
  if (query.tied != nullptr) {
    FindAll<D, Form::kTied>(query, block, next, shares, differences, range);
  } else if (query.form == DifferenceForm::kGrown) {
    FindAll<D, Form::kGrown>(query, block, next, shares, differences, range);
  } else if (shares == nullptr) {
    FindAll<D, Form::kSummed>(query, block, next, shares, differences, range);
  } else {
    FindAll<D, Form::kSharesSummed>(query, block, next, shares, differences,
                                    range);
  }
}

void FindDifferences(const KernelQuery& query, const NodeBlock& block,
                     const NodeBlock& next, const BlockShares* shares,
                     DifferenceBlock* differences, const EntryRange& range) {
  if (query.state_space == StateSpace::kPlanar) {
    FindDifferencesIn<3>(query, block, next, shares, differences, range);
  } else {
    FindDifferencesIn<4>(query, block, next, shares, differences, range);
  }
}

// Adds S_ja, times `sign`, to x for nodes j of a block and a node a of the
// loop: S_jj Psi(a, j)^T where j is the earlier node, else Psi(j, a) S_aa.
template <int D>
HWY_INLINE void AddCross(const KnownDriftTerms::LoopNode& a, double sign,
                         const Vector (&node)[D][D], Vector node_x,
                         Vector node_y, Mask earlier, Vector (&x)[D][D]) {
  const Tag tag;
  constexpr int h = D - 1;
  // J (p_a - p_j).
  const Vector lever[2] = {hn::Sub(node_y, hn::Set(tag, a.y)),
                           hn::Sub(hn::Set(tag, a.x), node_x)};
  const Vector signs = hn::Set(tag, sign);
  for (int r = 0; r < D; ++r) {
    for (int c = 0; c < D; ++c) {
      Vector of_node = node[r][c];
      if (c < 2) of_node = hn::Add(of_node, hn::Mul(node[r][h], lever[c]));
      Vector of_loop = hn::Set(tag, a.covariance[r][c]);
      if (r < 2) {
        of_loop = hn::Sub(of_loop,
                          hn::Mul(lever[r], hn::Set(tag, a.covariance[h][c])));
      }
      x[r][c] = hn::Add(
          x[r][c], hn::Mul(signs, hn::IfThenElse(earlier, of_node, of_loop)));
    }
  }
}

template <int D>
HWY_INLINE void TakeAll(const KnownDriftTerms& terms, const NodeBlock& block,
                        const BlockColumn& indices,
                        DifferenceBlock* differences, const EntryRange& range) {
  const Tag tag;
  constexpr int h = D - 1;
  const Rows rows(block, block);
  const std::size_t entries =
      std::min({EntriesOf(block), differences->count, range.last});
  for (std::size_t i = range.first; i < entries; i += hn::Lanes(tag)) {
    const Vector index = hn::LoadU(tag, indices.data() + i);
    const auto earlier = [&](const KnownDriftTerms::LoopNode& a) HWY_ATTR {
      return hn::Le(index, hn::Set(tag, static_cast<double>(a.index)));
    };
    const Vector node_x = rows.Load(NodeBlock::kX, i);
    const Vector node_y = rows.Load(NodeBlock::kY, i);
    Vector node[D][D];
    Vector x[D][D];
    for (int r = 0; r < D; ++r) {
      for (int c = 0; c < D; ++c) {
        const NodeBlock::Row row = NodeBlock::CovarianceRow(
            std::min(StateIndex<D>(r), StateIndex<D>(c)),
            std::max(StateIndex<D>(r), StateIndex<D>(c)));
        node[r][c] = row < NodeBlock::kPlanarRows ? rows.Load(row, i)
                                                  : rows.LoadZ(row, i);
        x[r][c] = hn::Set(tag, terms.query_part[r][c]);
      }
    }
    AddCross<D>(terms.query, -1.0, node, node_x, node_y, earlier(terms.query),
                x);
    AddCross<D>(terms.matched, 1.0, node, node_x, node_y,
                earlier(terms.matched), x);
    State<D> state = LoadState<D>(*differences, i);
    const State<D> before = state;
    const Vector scale = hn::Set(tag, terms.variance_scale);
    Vector gain[D][D];
    for (int r = 0; r < D; ++r) {
      for (int c = 0; c < D; ++c) x[r][c] = hn::Mul(scale, x[r][c]);
      for (int c = 0; c < D; ++c) {
        gain[r][c] = hn::Zero(tag);
        for (int k = 0; k < D; ++k) {
          gain[r][c] =
              hn::Add(gain[r][c],
                      hn::Mul(x[r][k], hn::Set(tag, terms.information[k][c])));
        }
      }
    }
    for (int r = 0; r < D; ++r) {
      for (int k = 0; k < D; ++k) {
        state.difference[r] = hn::Sub(
            state.difference[r],
            hn::Mul(gain[r][k], hn::Set(tag, terms.loop_difference[k])));
        for (int c = 0; c <= r; ++c) {
          state.covariance[r][c] =
              hn::Sub(state.covariance[r][c], hn::Mul(gain[r][k], x[c][k]));
        }
      }
    }
    const Vector turns = hn::Round(
        hn::Mul(state.difference[h], hn::Set(tag, 1.0 / (2.0 * kPi))));
    state.difference[h] =
        hn::Sub(state.difference[h], hn::Mul(turns, hn::Set(tag, 2.0 * kPi)));
    const Mask possible = Evaluate<D>(state).possible;
    for (int r = 0; r < D; ++r) {
      state.difference[r] =
          hn::IfThenElse(possible, state.difference[r], before.difference[r]);
      for (int c = 0; c <= r; ++c) {
        state.covariance[r][c] = hn::IfThenElse(
            possible, state.covariance[r][c], before.covariance[r][c]);
      }
    }
    StoreState<D>(state, i, differences);
  }
}

void TakeKnownDrift(const KnownDriftTerms& terms, StateSpace state_space,
                    const NodeBlock& block, const BlockColumn& indices,
                    DifferenceBlock* differences, const EntryRange& range) {
  if (state_space == StateSpace::kPlanar) {
    TakeAll<3>(terms, block, indices, differences, range);
  } else {
    TakeAll<4>(terms, block, indices, differences, range);
  }
}

HWY_INLINE Vector LogSimilarityOf(const Terms& terms) {
  const Tag tag;
  return hn::Mul(hn::Set(tag, -0.5),
                 hn::Add(terms.log_determinant, terms.squared));
}

template <int D>
HWY_INLINE void EvaluateAsTheyAre(const DifferenceBlock& differences,
                                  BlockSimilarity* similarity) {
  const Tag tag;
  for (std::size_t i = 0; i < differences.count; i += hn::Lanes(tag)) {
    const Terms terms = Evaluate<D>(LoadState<D>(differences, i));
    hn::Store(hn::IfThenElse(terms.possible, LogSimilarityOf(terms),
                             hn::Set(tag, kImpossible)),
              tag, similarity->log_similarity.data() + i);
    hn::Store(terms.squared, tag, similarity->squared_mahalanobis.data() + i);
  }
}

void EvaluateDifferences(StateSpace state_space,
                         const DifferenceBlock& differences,
                         BlockSimilarity* similarity) {
  if (state_space == StateSpace::kPlanar) {
    EvaluateAsTheyAre<3>(differences, similarity);
  } else {
    EvaluateAsTheyAre<4>(differences, similarity);
  }
}

template <int D>
HWY_INLINE void EvaluateAllChanged(const DifferenceBlock& differences,
                                   const DifferenceChange& change,
                                   BlockSimilarity* similarity) {
  const Tag tag;
  const hn::RebindToSigned<Tag> index_tag;
  const Vector cosine = hn::Set(tag, change.cosine);
  const Vector sine = hn::Set(tag, change.sine);
  const Vector kept = hn::Set(tag, 1.0 - change.least_left);
  for (std::size_t i = 0; i < differences.count; i += hn::Lanes(tag)) {
    if (change.left_out[i / NodeBlock::kGroupSize]) continue;
    const auto row = hn::Load(index_tag, change.row.data() + i);
    // The row's first entry: row times kMostEntries.
    const auto at = hn::Add(hn::ShiftLeft<3>(row), hn::ShiftLeft<1>(row));
    State<D> state = LoadState<D>(differences, i);
    State<D> left;
    for (int r = 0; r < D; ++r) {
      left.difference[r] = hn::Zero(tag);
      for (int c = 0; c <= r; ++c) {
        const Vector certainty =
            hn::GatherIndex(tag, change.certainty + Packed(r, c), at);
        left.covariance[r][c] =
            hn::Sub(hn::Mul(kept, state.covariance[r][c]), certainty);
        state.covariance[r][c] = hn::Sub(state.covariance[r][c], certainty);
      }
    }
    const auto shift = [&](std::size_t r) HWY_ATTR {
      return hn::Load(tag, change.shift[r].data() + i);
    };
    const Vector forward = shift(0);
    const Vector left_of = shift(1);
    state.difference[0] =
        hn::Add(state.difference[0],
                hn::Sub(hn::Mul(cosine, forward), hn::Mul(sine, left_of)));
    state.difference[1] =
        hn::Add(state.difference[1],
                hn::Add(hn::Mul(sine, forward), hn::Mul(cosine, left_of)));
    for (int r = 2; r < D; ++r) {
      state.difference[r] =
          hn::Add(state.difference[r], shift(static_cast<std::size_t>(r)));
    }
    const Terms terms = Evaluate<D>(state);
    const Mask possible = hn::And(terms.possible, Evaluate<D>(left).possible);
    double* const similarities = similarity->log_similarity.data() + i;
    double* const squares = similarity->squared_mahalanobis.data() + i;
    hn::Store(hn::IfThenElse(possible, LogSimilarityOf(terms),
                             hn::Load(tag, similarities)),
              tag, similarities);
    hn::Store(hn::IfThenElse(possible, terms.squared, hn::Load(tag, squares)),
              tag, squares);
  }
}

void EvaluateChanged(StateSpace state_space, const DifferenceBlock& differences,
                     const DifferenceChange& change,
                     BlockSimilarity* similarity) {
  if (state_space == StateSpace::kPlanar) {
    EvaluateAllChanged<3>(differences, change, similarity);
  } else {
    EvaluateAllChanged<4>(differences, change, similarity);
  }
}

template <int D>
HWY_INLINE void BoundAllChanged(const DifferenceBlock& differences,
                                const ChangeBound& bound,
                                const BlockSimilarity& similarity,
                                BlockColumn* most, BlockColumn* unshifted) {
  const Tag tag;
  const Vector half = hn::Set(tag, 0.5);
  const Vector kept = hn::Set(tag, 1.0 - bound.least_left);
  const Vector if_least_is_left =
      hn::Set(tag, -0.5 * D * std::log(bound.least_left));
  const Vector infinite = hn::Set(tag, std::numeric_limits<double>::infinity());
  for (std::size_t i = 0; i < differences.count; i += hn::Lanes(tag)) {
    // (d + s)^T G^-1 (d + s) + s^T B^-1 s is at least d^T (G + B)^-1 d.
    State<D> shifted = LoadState<D>(differences, i);
    State<D> left;
    for (int r = 0; r < D; ++r) {
      left.difference[r] = hn::Zero(tag);
      for (int c = 0; c <= r; ++c) {
        const Vector entry = shifted.covariance[r][c];
        left.covariance[r][c] = hn::Sub(
            hn::Mul(kept, entry), hn::Set(tag, bound.certainty[Packed(r, c)]));
        shifted.covariance[r][c] =
            hn::Add(entry, hn::Set(tag, bound.shift[Packed(r, c)]));
      }
    }
    const Terms of_shifted = Evaluate<D>(shifted);
    const Terms of_left = Evaluate<D>(left);
    // -1/2 ln|G|
    const Vector plain = hn::Add(
        hn::Mul(half, hn::Load(tag, similarity.squared_mahalanobis.data() + i)),
        hn::Load(tag, similarity.log_similarity.data() + i));
    const Vector of_certain = hn::Neg(hn::Mul(half, of_left.log_determinant));
    const Vector constant = hn::IfThenElse(of_left.possible, of_certain,
                                           hn::Add(plain, if_least_is_left));
    if (unshifted != nullptr) {
      hn::StoreU(hn::IfThenElse(of_left.possible, of_certain, infinite), tag,
                 unshifted->data() + i);
    }
    const Vector squared =
        hn::IfThenElseZero(of_shifted.possible, of_shifted.squared);
    hn::StoreU(hn::Sub(constant, hn::Mul(half, squared)), tag,
               most->data() + i);
  }
}

void BoundChanged(StateSpace state_space, const DifferenceBlock& differences,
                  const ChangeBound& bound, const BlockSimilarity& similarity,
                  BlockColumn* most, BlockColumn* unshifted) {
  if (state_space == StateSpace::kPlanar) {
    BoundAllChanged<3>(differences, bound, similarity, most, unshifted);
  } else {
    BoundAllChanged<4>(differences, bound, similarity, most, unshifted);
  }
}

bool HoldsNear(const NodeRegion& region, const NodeBlock& block) {
  const Tag tag;
  const auto set = [tag](double value) HWY_ATTR { return hn::Set(tag, value); };
  const Rows rows(block, block);
  const Vector scale = set(region.node_scale);
  const auto entry = [&](double query, NodeBlock::Row row,
                         std::size_t i) HWY_ATTR {
    return hn::Add(set(query), hn::Mul(scale, rows.Load(row, i)));
  };
  for (std::size_t i = 0; i < NodeBlock::kSize; i += hn::Lanes(tag)) {
    const Vector dx = hn::Sub(set(region.x), rows.Load(NodeBlock::kX, i));
    const Vector dy = hn::Sub(set(region.y), rows.Load(NodeBlock::kY, i));
    const Vector squared = hn::Add(hn::Mul(dx, dx), hn::Mul(dy, dy));
    const Vector of_x =
        hn::Add(hn::Mul(entry(region.xx, NodeBlock::kXX, i), dx),
                hn::Mul(entry(region.xy, NodeBlock::kXY, i), dy));
    const Vector of_y =
        hn::Add(hn::Mul(entry(region.xy, NodeBlock::kXY, i), dx),
                hn::Mul(entry(region.yy, NodeBlock::kYY, i), dy));
    const Vector varies = hn::Add(hn::Add(hn::Mul(dx, of_x), hn::Mul(dy, of_y)),
                                  hn::Mul(set(region.variance), squared));
    // Written so that NaN is near.
    const Mask far = hn::Gt(hn::Mul(squared, squared),
                            hn::Mul(set(region.squared_per_variance), varies));
    if (!hn::AllTrue(tag, far)) return true;
  }
  return false;
}

}  // namespace revisit::core::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace revisit::core {

HWY_EXPORT(EvaluateBlock);
HWY_EXPORT(FindDifferences);
HWY_EXPORT(TakeKnownDrift);
HWY_EXPORT(EvaluateDifferences);
HWY_EXPORT(EvaluateChanged);
HWY_EXPORT(BoundChanged);
HWY_EXPORT(HoldsNear);

void EvaluateBlock(const KernelQuery& query, const NodeBlock& block,
                   const NodeBlock& next, const BlockShares* shares,
                   BlockSimilarity* similarity) {
  HWY_DYNAMIC_DISPATCH(EvaluateBlock)(query, block, next, shares, similarity);
}

void FindDifferences(const KernelQuery& query, const NodeBlock& block,
                     const NodeBlock& next, const BlockShares* shares,
                     DifferenceBlock* differences, const EntryRange& range) {
  HWY_DYNAMIC_DISPATCH(FindDifferences)
  (query, block, next, shares, differences, range);
}

void TakeKnownDrift(const KnownDriftTerms& terms, StateSpace state_space,
                    const NodeBlock& block, const BlockColumn& indices,
                    DifferenceBlock* differences, const EntryRange& range) {
  HWY_DYNAMIC_DISPATCH(TakeKnownDrift)
  (terms, state_space, block, indices, differences, range);
}

void EvaluateDifferences(StateSpace state_space,
                         const DifferenceBlock& differences,
                         BlockSimilarity* similarity) {
  HWY_DYNAMIC_DISPATCH(EvaluateDifferences)
  (state_space, differences, similarity);
}

void EvaluateChanged(StateSpace state_space, const DifferenceBlock& differences,
                     const DifferenceChange& change,
                     BlockSimilarity* similarity) {
  HWY_DYNAMIC_DISPATCH(EvaluateChanged)
  (state_space, differences, change, similarity);
}

void BoundChanged(StateSpace state_space, const DifferenceBlock& differences,
                  const ChangeBound& bound, const BlockSimilarity& similarity,
                  BlockColumn* most, BlockColumn* unshifted) {
  HWY_DYNAMIC_DISPATCH(BoundChanged)
  (state_space, differences, bound, similarity, most, unshifted);
}

bool HoldsNear(const NodeRegion& region, const NodeBlock& block) {
  return HWY_DYNAMIC_DISPATCH(HoldsNear)(region, block);
}

}  // namespace revisit::core
#endif  // HWY_ONCE
