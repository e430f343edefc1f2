#include "core/search/belief/mark_bytes.h"

#include <algorithm>
#include <cstdint>
#include <map>
#include <utility>

#include "core/base/byte_stream.h"
#include "core/drive/pose_graph.h"
#include "core/search/alignment/log_similarity.h"
#include "core/settings_table.h"

namespace revisit::core {
namespace {

// Changes whenever anything does that the bytes hold, or that a mark shows:
// mark_bytes_test.cc has what marks showed.
constexpr std::uint64_t kMarksVersion = 1;

// No logarithm of odds that poses can show comes near this.
constexpr double kMostLogOdds = 1e9;

// The bytes begin with this, and are for drives of the same beginning.
std::string Beginning(const DriveSettings& settings) {
  ByteWriter writer;
  writer.Put(kMarksVersion);
  VisitSettings(settings, [&](const SettingRow& row, const auto& get) {
    if ((row.remade & kRemadeMarks) != 0) writer.Put(get(settings));
  });
  return writer.Take();
}

// Tells a node from those that other poses make.
std::string IdentityOf(const PoseGraph& graph, NodeIndex index) {
  const Node node = graph.node(index);
  ByteWriter writer;
  writer.Put(node.sequence);
  writer.Put(node.fraction);
  writer.Put(node.travelled_meters);
  writer.Put(node.pose);
  return writer.Take();
}

// The last mark that the graph has; 0 if it has none.
std::int64_t LastMark(const MarkLine& line) {
  const NodeIndex size = line.graph.size();
  return size == 0 ? 0 : line.LastBefore(size - 1) + 1;
}

bool AreLogOdds(const ByScale& values, double least) {
  return std::all_of(values.begin(), values.end(), [least](double value) {
    return value >= least && value <= kMostLogOdds;
  });
}

bool IsSound(const MarkEvidence& evidence) {
  return AreLogOdds(evidence.log_evidence, 0.0) &&
         AreLogOdds(evidence.log_all_evidence, 0.0) &&
         AreLogOdds(evidence.log_matched_odds, kImpossible) &&
         (!evidence.matched ||
          (*evidence.matched >= 0 && *evidence.matched < evidence.node));
}

bool GetMark(const MarkLine& line, std::int64_t last_mark, ByteReader* reader,
             std::int64_t* mark, MarkEvidence* evidence) {
  if (!reader->Get(mark) || *mark < 1 || *mark > last_mark) return false;
  evidence->node = line.NodeOf(*mark);
  const std::string expected = IdentityOf(line.graph, evidence->node);
  std::string identity(expected.size(), '\0');
  return reader->GetArray(identity.data(), identity.size()) &&
         identity == expected && reader->Get(&evidence->log_evidence) &&
         reader->Get(&evidence->log_all_evidence) &&
         reader->GetOptional(&evidence->matched) &&
         reader->Get(&evidence->log_matched_odds) && IsSound(*evidence);
}

}  // namespace

std::string SaveMarks(const MarkMemory& marks, const MarkLine& line,
                      const DriveSettings& settings) {
  ByteWriter writer;
  const std::string beginning = Beginning(settings);
  writer.PutArray(beginning.data(), beginning.size());
  writer.Put(static_cast<std::uint64_t>(marks.size()));
  for (const auto& [mark, evidence] : marks.all()) {
    const std::string identity = IdentityOf(line.graph, evidence.node);
    writer.Put(mark);
    writer.PutArray(identity.data(), identity.size());
    writer.Put(evidence.log_evidence);
    writer.Put(evidence.log_all_evidence);
    writer.PutOptional(evidence.matched);
    writer.Put(evidence.log_matched_odds);
  }
  return writer.Take();
}

bool LoadMarks(absl::string_view bytes, const MarkLine& line,
               const DriveSettings& settings, MarkMemory* marks) {
  ByteReader reader(bytes);
  const std::string expected = Beginning(settings);
  std::string beginning(expected.size(), '\0');
  std::uint64_t count = 0;
  if (!reader.GetArray(beginning.data(), beginning.size()) ||
      beginning != expected || !reader.Get(&count)) {
    return false;
  }
  const std::int64_t last_mark = LastMark(line);
  std::map<std::int64_t, MarkEvidence> loaded;
  for (std::uint64_t i = 0; i < count; ++i) {
    std::int64_t mark = 0;
    MarkEvidence evidence;
    if (!GetMark(line, last_mark, &reader, &mark, &evidence) ||
        !loaded.emplace(mark, evidence).second) {
      return false;
    }
  }
  if (!reader.rest().empty()) return false;
  marks->Replace(std::move(loaded));
  return true;
}

}  // namespace revisit::core
