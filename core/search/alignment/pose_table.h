// Poses of the history as the walk kernel reads them: x, y, z and heading of
// node after node. Blocks are filled in when they are first needed, so that a
// search that looks at few nodes touches few.
#ifndef REVISIT_CORE_SEARCH_ALIGNMENT_POSE_TABLE_H_
#define REVISIT_CORE_SEARCH_ALIGNMENT_POSE_TABLE_H_

#include <cstddef>
#include <memory>
#include <vector>

#include "core/drive/pose_graph.h"

namespace revisit::core {

class PoseTable {
 public:
  // Nodes [0, size) of the graph, which must outlive this.
  PoseTable(const PoseGraph& graph, NodeIndex size);

  // Four numbers per node; undefined for nodes that Need() has not named.
  const double* poses() const { return poses_.get(); }

  // Fills in those nodes of [first, last] that are in the table.
  void Need(NodeIndex first, NodeIndex last);

 private:
  void Fill(NodeIndex block);

  const PoseGraph& graph_;
  const NodeIndex size_;
  const std::unique_ptr<double[]> poses_;
  // One per block.
  std::vector<char> filled_;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_ALIGNMENT_POSE_TABLE_H_
