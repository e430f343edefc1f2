#ifndef REVISIT_CORE_DRIVE_NODE_INDEX_H_
#define REVISIT_CORE_DRIVE_NODE_INDEX_H_

#include <cstdint>

namespace revisit::core {

// Number of a node in the graph of its drive, from 0 on along the path.
using NodeIndex = std::int64_t;

}  // namespace revisit::core

#endif  // REVISIT_CORE_DRIVE_NODE_INDEX_H_
