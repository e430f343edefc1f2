// How fast this machine does, one after the other, what the similarity kernel
// does: with the same vectors, chosen at run time by the same rule.
#ifndef REVISIT_TESTS_BENCH_MACHINE_LIMITS_H_
#define REVISIT_TESTS_BENCH_MACHINE_LIMITS_H_

#include <cstddef>
#include <string>

#include "core/drive/pose_graph.h"

namespace revisit::bench {

// Name of the vectors in use, "AVX3" for AVX-512.
std::string VectorTarget();

// Independent multiplications and additions, as many of each, not fused, all in
// registers. Returns how many operations on doubles it did.
std::size_t MultiplyAndAdd(std::size_t rounds, double* sink);

// Independent divisions. Returns how many.
std::size_t Divide(std::size_t rounds, double* sink);

// Reads what the kernel reads of the first `count` nodes of a planar vehicle:
// 9 doubles a node.
double ReadNodes(const core::PoseGraph& graph, std::size_t count);

// Operations on doubles that the kernel needs for one pair in PLANAR with dead
// reckoning, counted in its source: additions, multiplications, comparisons and
// selections, of which the logarithm takes 30 (fused ones count once); and
// divisions, one of them the logarithm's.
inline constexpr double kPlanarOperations = 84.0 + 30.0;
inline constexpr double kPlanarDivisions = 3.0 + 1.0;

}  // namespace revisit::bench

#endif  // REVISIT_TESTS_BENCH_MACHINE_LIMITS_H_
