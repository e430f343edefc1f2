// How far the shape of a path may stray from the shape it is compared with.
#ifndef REVISIT_CORE_ALIGNMENT_SHAPE_FILTER_H_
#define REVISIT_CORE_ALIGNMENT_SHAPE_FILTER_H_

#include "core/alignment/log_similarity.h"

namespace revisit::core {

struct ShapeModel {
  // At each node, beside the drift: position [0.01, 1000] m, heading
  // [0.001, 3] rad.
  PlaceTolerance tolerance{1.0, 0.06};
  // Distance over which that straying is one and the same, [0.01, 1e6] m.
  double correlation_meters = 10.0;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_ALIGNMENT_SHAPE_FILTER_H_
