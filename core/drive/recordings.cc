#include "core/drive/recordings.h"

#include <algorithm>
#include <cassert>
#include <cmath>
#include <iterator>
#include <string>
#include <utility>

namespace revisit::core {
namespace {

void PutText(const std::string& text, ByteWriter* writer) {
  writer->PutCounted(text.data(), text.size());
}

bool GetText(ByteReader* reader, std::string* text) {
  std::vector<char> bytes;
  if (!reader->GetCounted(reader->rest().size(), &bytes)) return false;
  text->assign(bytes.begin(), bytes.end());
  return true;
}

bool IsInRange(const Pose& pose) {
  // Written so that NaN is not.
  return std::abs(pose.x) <= kMaxCoordinateMeters &&
         std::abs(pose.y) <= kMaxCoordinateMeters &&
         std::abs(pose.z) <= kMaxCoordinateMeters &&
         std::abs(pose.heading) <= kMaxHeadingRadians;
}

}  // namespace

const Recording Recordings::kOnly;

std::size_t Recordings::Of(NodeIndex node) const {
  if (begun_.empty()) return 0;
  const auto next =
      std::upper_bound(begun_.begin() + 1, begun_.end(), node,
                       [](NodeIndex i, const Recording& recording) {
                         return i < recording.first_node;
                       });
  return static_cast<std::size_t>(next - begun_.begin()) - 1;
}

std::size_t Recordings::OfSequence(std::uint64_t sequence) const {
  if (begun_.empty()) return 0;
  const auto next =
      std::upper_bound(begun_.begin() + 1, begun_.end(), sequence,
                       [](std::uint64_t of, const Recording& recording) {
                         return of < recording.first_sequence;
                       });
  return static_cast<std::size_t>(next - begun_.begin()) - 1;
}

NodeRange Recordings::NodesOf(std::size_t k, NodeIndex graph_size) const {
  assert(k < size());
  if (begun_.empty()) return {0, graph_size};
  return {begun_[k].first_node,
          k + 1 < begun_.size() ? begun_[k + 1].first_node : graph_size};
}

void Recordings::Begin(std::uint64_t sequence, NodeIndex graph_size,
                       std::shared_ptr<const RecordingStart> start,
                       const Pose& end_before) {
  assert(start != nullptr && size() < kMostRecordings);
  if (begun_.empty() && graph_size > 0) begun_.push_back(kOnly);
  assert(begun_.empty() || sequence > begun_.back().first_sequence);
  begun_.push_back({sequence, graph_size, std::move(start), end_before});
}

std::size_t Recordings::bytes() const {
  return begun_.capacity() * sizeof(Recording) +
         begun_.size() * sizeof(RecordingStart);
}

void Recordings::Save(ByteWriter* writer) const {
  if (begun_.empty()) return;
  writer->Put(static_cast<std::uint64_t>(begun_.size()));
  for (const Recording& recording : begun_) {
    writer->Put(recording.first_sequence);
    writer->Put(recording.first_node);
    writer->Put(recording.end_before);
    writer->Put(static_cast<std::uint8_t>(recording.start ? 1 : 0));
    if (!recording.start) continue;
    const RecordingStart& start = *recording.start;
    writer->Put(static_cast<std::uint32_t>(start.relation));
    writer->Put(start.covariance);
    writer->Put(start.datum);
    PutText(start.datum_id, writer);
    PutText(start.label, writer);
  }
}

bool Recordings::Load(StateSpace space, NodeIndex nodes,
                      std::uint64_t last_sequence, ByteReader* reader) {
  begun_.clear();
  if (reader->rest().empty()) return true;
  std::uint64_t count = 0;
  if (!reader->Get(&count) || count == 0 || count > kMostRecordings) {
    return false;
  }
  for (std::uint64_t k = 0; k < count; ++k) {
    Recording recording;
    std::uint8_t has_start = 0;
    if (!reader->Get(&recording.first_sequence) ||
        !reader->Get(&recording.first_node) ||
        !reader->Get(&recording.end_before) ||
        !IsInRange(recording.end_before) || !reader->Get(&has_start) ||
        has_start > 1 || (has_start == 0 && (k > 0 || count == 1))) {
      return false;
    }
    const bool follows =
        k == 0 ? recording.first_node == 0
               : recording.first_node > begun_.back().first_node &&
                     recording.first_sequence > begun_.back().first_sequence;
    if (!follows || recording.first_node >= nodes ||
        recording.first_sequence > last_sequence) {
      return false;
    }
    if (has_start == 1) {
      RecordingStart start;
      std::uint32_t relation = 0;
      if (!reader->Get(&relation) ||
          relation > static_cast<std::uint32_t>(RecordingRelation::kUnknown) ||
          !reader->Get(&start.covariance) || !reader->Get(&start.datum) ||
          !GetText(reader, &start.datum_id) || !GetText(reader, &start.label)) {
        return false;
      }
      start.relation = static_cast<RecordingRelation>(relation);
      if (FindDefect(start, space)) return false;
      recording.start =
          std::make_shared<const RecordingStart>(std::move(start));
    }
    begun_.push_back(std::move(recording));
  }
  return true;
}

}  // namespace revisit::core
