#include "core/drive/pose_graph.h"

#include <algorithm>
#include <cassert>
#include <cmath>
#include <iterator>
#include <limits>
#include <utility>

namespace revisit::core {

namespace {

// Makes room for `size` entries in whole steps. Doubling, as vectors do, would
// leave a quarter of the memory unused.
template <typename T>
void ReserveInSteps(std::size_t size, std::size_t step, std::size_t most,
                    std::vector<T>* vector) {
  if (vector->capacity() >= size) return;
  vector->reserve(std::min(most, (size + step - 1) / step * step));
}

bool HasBits(double value) { return value != 0.0 || std::signbit(value); }

}  // namespace

void NodeBlock::Add(std::size_t at, const Pose& pose,
                    const Covariance& covariance,
                    std::size_t groups_at_a_time) {
  bool spatial = HasBits(pose.z);
  for (int i = 0; i < 4; ++i) spatial = spatial || HasBits(covariance(2, i));
  if (spatial && !spatial_) BecomeSpatial();
  const std::size_t first_line = at / kGroupSize * rows();
  if (first_line == lines_.size()) {
    ReserveInSteps(lines_.size() + rows(), rows() * groups_at_a_time,
                   rows() * kSize / kGroupSize, &lines_);
    lines_.resize(lines_.size() + rows());
  }
  double* const entry = lines_[first_line].entries.data() + at % kGroupSize;
  const auto set = [entry](Row row, double value) {
    entry[row * kGroupSize] = value;
  };
  set(kX, pose.x);
  set(kY, pose.y);
  set(kHeading, pose.heading);
  set(kXX, covariance(0, 0));
  set(kXY, covariance(0, 1));
  set(kXH, covariance(0, 3));
  set(kYY, covariance(1, 1));
  set(kYH, covariance(1, 3));
  set(kHH, covariance(3, 3));
  if (!spatial_) return;
  set(kZ, pose.z);
  set(kXZ, covariance(0, 2));
  set(kYZ, covariance(1, 2));
  set(kZZ, covariance(2, 2));
  set(kZH, covariance(2, 3));
}

void NodeBlock::Copy(const NodeBlock& from, std::size_t from_at,
                     std::size_t at) {
  if (from.spatial_ && !spatial_) BecomeSpatial();
  const std::size_t group = at / kGroupSize;
  if (group == groups()) lines_.resize(lines_.size() + rows());
  const double* const entry =
      from.group(from_at / kGroupSize) + from_at % kGroupSize;
  Line* const lines = lines_.data() + group * rows();
  for (std::size_t row = 0; row < rows(); ++row) {
    lines[row].entries[at % kGroupSize] =
        row < from.rows() ? entry[row * kGroupSize] : 0.0;
  }
}

void NodeBlock::BecomeSpatial() {
  const std::size_t count = groups();
  std::vector<Line> lines(count * kSpatialRows);
  for (std::size_t g = 0; g < count; ++g) {
    std::copy_n(lines_.begin() + static_cast<std::ptrdiff_t>(g * kPlanarRows),
                kPlanarRows,
                lines.begin() + static_cast<std::ptrdiff_t>(g * kSpatialRows));
  }
  lines_ = std::move(lines);
  spatial_ = true;
}

void PoseGraph::ReadTransitions(
    std::size_t k, std::vector<ErrorTransition>* transitions) const {
  transitions->assign(NodeBlock::kSize, ErrorTransition{});
  if (!has_transitions_) return;
  if (k >= full_.size()) {
    std::copy(transitions_.begin(), transitions_.end(), transitions->begin());
    return;
  }
  for (std::size_t entry = 0; entry < ErrorTransition{}.values.size();
       ++entry) {
    full_[k]->packed.Visit(kTransition + entry, NodeBlock::kSize,
                           [&](std::size_t row, std::uint64_t packable) {
                             (*transitions)[row].values[entry] =
                                 FromPackable(packable);
                           });
  }
}

NodeIndex PoseGraph::SegmentStart(NodeIndex i) const {
  return *std::prev(
      std::upper_bound(segment_starts_.begin(), segment_starts_.end(), i));
}

NodeIndex PoseGraph::SegmentEnd(NodeIndex i) const {
  const auto next =
      std::upper_bound(segment_starts_.begin(), segment_starts_.end(), i);
  return next == segment_starts_.end() ? size() : *next;
}

std::optional<NodeIndex> PoseGraph::NodeAtOrBefore(
    std::uint64_t sequence) const {
  // A node with this sequence and a fraction lies after the pose.
  NodeIndex low = 0;
  NodeIndex high = size();
  while (low < high) {
    const NodeIndex middle = low + (high - low) / 2;
    const Node candidate = node(middle);
    if (candidate.sequence < sequence ||
        (candidate.sequence == sequence && candidate.fraction == 0.0)) {
      low = middle + 1;
    } else {
      high = middle;
    }
  }
  if (low == 0) return std::nullopt;
  return low - 1;
}

const std::vector<NodeIndex>& PoseGraph::LoopNeighbours(NodeIndex i) const {
  static const std::vector<NodeIndex> kNone;
  const auto found = loop_neighbours_.find(i);
  return found == loop_neighbours_.end() ? kNone : found->second;
}

bool PoseGraph::HasLoopEdgeAmong(NodeIndex first, NodeIndex end) const {
  for (const auto& [node, neighbours] : loop_neighbours_) {
    if (node < first || node >= end) continue;
    for (const NodeIndex other : neighbours) {
      if (other >= first && other < end) return true;
    }
  }
  return false;
}

std::vector<std::pair<NodeIndex, NodeIndex>> PoseGraph::LoopEdges() const {
  std::vector<std::pair<NodeIndex, NodeIndex>> edges;
  for (const auto& [from, neighbours] : loop_neighbours_) {
    for (NodeIndex to : neighbours) {
      if (from < to) edges.emplace_back(from, to);
    }
  }
  std::sort(edges.begin(), edges.end());
  return edges;
}

void PoseGraph::AddNode(const Node& node, bool starts_segment,
                        const std::optional<ErrorTransition>& transition) {
  assert(size_ == 0 || transition.has_value() == has_transitions_);
  if (starts_segment) segment_starts_.push_back(size());
  const std::size_t at = Position(size_) % NodeBlock::kSize;
  if (at == 0 && size_ > 0) Pack();
  const std::size_t nodes_at_a_time = NodesAtATime();
  last_.Add(at, node.pose, node.covariance,
            nodes_at_a_time / NodeBlock::kGroupSize);
  ReserveInSteps(at + 1, nodes_at_a_time, NodeBlock::kSize, &records_);
  // A node without a stamp repeats the one before, which packs to nothing.
  const std::int64_t before = records_.empty() ? 0 : records_.back().stamp_ns;
  has_stamp_[at] = node.stamp_ns.has_value();
  records_.push_back({node.sequence, node.fraction, node.travelled_meters,
                      node.stamp_ns.value_or(before)});
  if (transition) {
    has_transitions_ = true;
    ReserveInSteps(at + 1, nodes_at_a_time, NodeBlock::kSize, &transitions_);
    transitions_.push_back(*transition);
  }
  ++size_;
}

// A fleet has many small graphs, which must not hold much unused memory; but
// growing by little, again and again, fragments the heap. So a graph grows by a
// 128th of its size, and from 16384 nodes on by a block.
std::size_t PoseGraph::NodesAtATime() const {
  const std::size_t groups = Position(size_) / 128 / NodeBlock::kGroupSize;
  return std::clamp<std::size_t>(groups, 1,
                                 NodeBlock::kSize / NodeBlock::kGroupSize) *
         NodeBlock::kGroupSize;
}

void PoseGraph::Pack() {
  std::vector<std::uint64_t> columns(NodeBlock::kSize *
                                     PackedColumnCount(has_transitions_));
  std::uint64_t* next = columns.data();
  const auto add = [&next](const auto& rows, const auto& packable) {
    for (const auto& row : rows) *next++ = packable(row);
  };
  add(records_, [](const Record& record) { return record.sequence; });
  add(records_,
      [](const Record& record) { return ToPackable(record.fraction); });
  add(records_,
      [](const Record& record) { return ToPackable(record.travelled_meters); });
  for (std::size_t at = 0; at < records_.size(); ++at) {
    *next++ = has_stamp_[at] ? 1 : 0;
  }
  add(records_, [](const Record& record) {
    return static_cast<std::uint64_t>(record.stamp_ns);
  });
  if (has_transitions_) {
    for (std::size_t k = 0; k < ErrorTransition{}.values.size(); ++k) {
      add(transitions_, [k](const ErrorTransition& transition) {
        return ToPackable(transition.values[k]);
      });
    }
  }
  assert(next == columns.data() + columns.size());
  AddFullBlock(std::exchange(last_, NodeBlock()),
               PackedColumns(columns, NodeBlock::kSize));
  records_.clear();
  transitions_.clear();
  if (NodesAtATime() < NodeBlock::kSize) {
    records_.shrink_to_fit();
    transitions_.shrink_to_fit();
  }
}

void PoseGraph::AddFullBlock(NodeBlock nodes, PackedColumns packed) {
  full_bytes_ += sizeof(FullBlock) + nodes.bytes() + packed.bytes();
  full_.push_back(std::make_shared<const FullBlock>(
      FullBlock{std::move(nodes), std::move(packed)}));
}

std::size_t PoseGraph::bytes() const {
  const auto bytes_of = [](const auto& vector) {
    return vector.capacity() * sizeof(vector[0]);
  };
  // Most nodes with loop closures have one.
  const std::size_t loop_end =
      sizeof(*loop_neighbours_.begin()) + sizeof(NodeIndex);
  return full_bytes_ + bytes_of(full_) + last_.bytes() + bytes_of(records_) +
         bytes_of(transitions_) + bytes_of(segment_starts_) +
         loop_neighbours_.size() * loop_end;
}

void NodeBlock::Save(ByteWriter* writer) const {
  writer->Put(static_cast<std::uint8_t>(spatial_ ? 1 : 0));
  writer->PutArray(lines_.data(), lines_.size());
}

bool NodeBlock::Load(std::size_t nodes, ByteReader* reader) {
  std::uint8_t spatial = 0;
  if (!reader->Get(&spatial) || spatial > 1) return false;
  spatial_ = spatial == 1;
  const std::size_t lines = (nodes + kGroupSize - 1) / kGroupSize * rows();
  if (lines > reader->rest().size() / sizeof(Line)) return false;
  lines_.resize(lines);
  return reader->GetArray(lines_.data(), lines) &&
         AreFinite(lines_.front().entries.data(), lines * kGroupSize);
}

void PoseGraph::SaveSegmentStarts(std::size_t first, std::size_t end,
                                  ByteWriter* writer) const {
  const auto at = [this](std::size_t block) {
    return std::lower_bound(segment_starts_.begin(), segment_starts_.end(),
                            static_cast<NodeIndex>(block * NodeBlock::kSize));
  };
  const auto from = at(first);
  writer->PutCounted(segment_starts_.data() + (from - segment_starts_.begin()),
                     static_cast<std::size_t>(at(end) - from));
}

bool PoseGraph::LoadSegmentStarts(NodeIndex end, ByteReader* reader) {
  const std::size_t before = segment_starts_.size();
  if (!reader->GetCounted(static_cast<std::size_t>(end - size_),
                          &segment_starts_)) {
    return false;
  }
  NodeIndex least = size_;
  for (std::size_t i = before; i < segment_starts_.size(); ++i) {
    if (segment_starts_[i] < least || segment_starts_[i] >= end) return false;
    least = segment_starts_[i] + 1;
  }
  return end == 0 || (!segment_starts_.empty() && segment_starts_[0] == 0);
}

void PoseGraph::SaveBlocks(std::size_t first, std::size_t end,
                           ByteWriter* writer) const {
  assert(first <= end && end <= full_blocks());
  SaveSegmentStarts(first, end, writer);
  for (std::size_t k = first; k < end; ++k) {
    full_[k]->nodes.Save(writer);
    full_[k]->packed.Save(writer);
  }
}

bool PoseGraph::LoadBlocks(std::size_t count, bool transitions,
                           ByteReader* reader) {
  const NodeIndex first = size_;
  const std::size_t blocks = full_.size() + count;
  const auto end = static_cast<NodeIndex>(blocks * NodeBlock::kSize);
  if (!LoadSegmentStarts(end, reader)) return false;
  has_transitions_ = transitions;
  for (std::size_t k = 0; k < count; ++k) {
    NodeBlock block;
    PackedColumns packed;
    if (!block.Load(NodeBlock::kSize, reader) ||
        !packed.Load(PackedColumnCount(transitions), NodeBlock::kSize,
                     reader)) {
      return false;
    }
    AddFullBlock(std::move(block), std::move(packed));
  }
  size_ = end;
  return IsOrdered(first);
}

void PoseGraph::SaveRest(std::size_t first, ByteWriter* writer) const {
  const std::size_t full = full_blocks();
  assert(first <= full);
  writer->Put(static_cast<std::uint64_t>(full - first));
  SaveBlocks(first, full, writer);
  writer->Put(static_cast<std::uint64_t>(records_.size()));
  SaveSegmentStarts(full, full + 1, writer);
  if (records_.empty()) return;
  last_.Save(writer);
  writer->PutArray(records_.data(), records_.size());
  for (std::size_t at = 0; at < records_.size(); ++at) {
    writer->Put(static_cast<std::uint8_t>(has_stamp_[at] ? 1 : 0));
  }
  writer->PutArray(transitions_.data(), transitions_.size());
}

bool PoseGraph::LoadRest(bool transitions, ByteReader* reader) {
  std::uint64_t full = 0;
  std::uint64_t nodes = 0;
  if (!reader->Get(&full) || full > reader->rest().size() ||
      !LoadBlocks(static_cast<std::size_t>(full), transitions, reader) ||
      !reader->Get(&nodes) || nodes > NodeBlock::kSize ||
      (nodes == 0 && size_ > 0)) {
    return false;
  }
  const NodeIndex first = size_;
  const auto count = static_cast<std::size_t>(nodes);
  const auto end = first + static_cast<NodeIndex>(count);
  if (!LoadSegmentStarts(end, reader)) return false;
  has_transitions_ = transitions && end > 0;
  if (end == 0) return true;
  records_.resize(count);
  if (!last_.Load(count, reader) || !reader->GetArray(records_.data(), count)) {
    return false;
  }
  for (std::size_t at = 0; at < count; ++at) {
    std::uint8_t has_stamp = 0;
    if (!reader->Get(&has_stamp) || has_stamp > 1) return false;
    has_stamp_[at] = has_stamp == 1;
  }
  if (transitions) {
    transitions_.resize(count);
    if (!reader->GetArray(transitions_.data(), count)) return false;
  }
  size_ = end;
  return IsOrdered(first);
}

bool PoseGraph::IsOrdered(NodeIndex first) const {
  std::uint64_t sequence = 0;
  double travelled = 0.0;
  const auto follows = [&](std::uint64_t next, double fraction, double meters) {
    // Written so that NaN is not in order.
    const bool ordered = next >= sequence && fraction >= 0.0 &&
                         fraction < 1.0 && meters >= travelled &&
                         meters <= std::numeric_limits<double>::max();
    sequence = next;
    travelled = meters;
    return ordered;
  };
  if (first > 0) {
    const Node before = node(first - 1);
    sequence = before.sequence;
    travelled = before.travelled_meters;
  }
  for (std::size_t k = Position(first) / NodeBlock::kSize; k < full_.size();
       ++k) {
    const PackedColumns& packed = full_[k]->packed;
    std::array<double, NodeBlock::kSize> meters;
    std::array<double, NodeBlock::kSize> fractions;
    packed.Visit(kTravelled, NodeBlock::kSize,
                 [&](std::size_t row, std::uint64_t packable) {
                   meters[row] = FromPackable(packable);
                 });
    packed.Visit(kFraction, NodeBlock::kSize,
                 [&](std::size_t row, std::uint64_t packable) {
                   fractions[row] = FromPackable(packable);
                 });
    bool ordered = true;
    packed.Visit(kSequence, NodeBlock::kSize,
                 [&](std::size_t row, std::uint64_t next) {
                   ordered &= follows(next, fractions[row], meters[row]);
                 });
    if (!ordered) return false;
  }
  return std::all_of(records_.begin(), records_.end(),
                     [&](const Record& record) {
                       return follows(record.sequence, record.fraction,
                                      record.travelled_meters);
                     });
}

void PoseGraph::AddLoopEdge(NodeIndex a, NodeIndex b) {
  assert(a != b);
  loop_neighbours_[a].push_back(b);
  loop_neighbours_[b].push_back(a);
}

bool PoseGraph::RemoveLoopEdge(NodeIndex a, NodeIndex b) {
  const auto remove = [this](NodeIndex from, NodeIndex to) {
    const auto found = loop_neighbours_.find(from);
    if (found == loop_neighbours_.end()) return false;
    auto& neighbours = found->second;
    const auto edge = std::find(neighbours.begin(), neighbours.end(), to);
    if (edge == neighbours.end()) return false;
    neighbours.erase(edge);
    if (neighbours.empty()) loop_neighbours_.erase(found);
    return true;
  };
  return remove(a, b) && remove(b, a);
}

}  // namespace revisit::core
