// Marks lie at even distances along the path of a drive, and each has evidence
// of the claimed covariances and of the drift. It is searched by itself with
// nothing known but the poses up to it, so its evidence never changes.
#ifndef REVISIT_CORE_SEARCH_BELIEF_MARK_H_
#define REVISIT_CORE_SEARCH_BELIEF_MARK_H_

#include <array>
#include <cstddef>
#include <cstdint>
#include <iterator>
#include <map>
#include <optional>
#include <utility>

#include "core/drive/pose_graph.h"

namespace revisit::core {

// Logarithms of the scales that the true standard deviations may have to the
// claimed ones: a sixteenth to eight times, in even steps of a factor of two.
inline constexpr std::size_t kScales = 8;
inline constexpr double kLeastLogScale = -2.8;
inline constexpr double kLogScaleStep = 0.7;

constexpr double LogScale(std::size_t k) {
  return kLeastLogScale + kLogScaleStep * static_cast<double>(k);
}

// One number per scale.
using ByScale = std::array<double, kScales>;

struct MarkEvidence {
  NodeIndex node = 0;
  // ln(1 + odds of all places against a new place): of the mark's own
  // recording, which shows the scale, and of all recordings.
  ByScale log_evidence = {};
  ByScale log_all_evidence = {};
  // The most probable place, if any, and ln of the odds of the nodes within
  // kMatchRadiusMeters of it.
  std::optional<NodeIndex> matched;
  ByScale log_matched_odds = {};
};

inline constexpr double kMatchRadiusMeters = 20.0;

// The evidence of marks that were searched, by number. It is worth keeping
// between the searches of one graph: a search needs that of some tens of marks,
// most of which the search before has needed too. Forgets it where settings
// changed that marks depend on. Takes some 260 bytes a mark. Not thread-safe.
class MarkMemory {
 public:
  // Forgets all evidence that was found under other settings than these. Their
  // versions are above 0.
  void Enter(std::uint64_t settings_version) {
    if (settings_version == settings_version_) return;
    marks_.clear();
    settings_version_ = settings_version;
  }

  // Null if there is none.
  const MarkEvidence* Find(std::int64_t mark) const {
    const auto found = marks_.find(mark);
    return found == marks_.end() ? nullptr : &found->second;
  }
  // The evidence stays where it is until it is forgotten.
  const MarkEvidence& Keep(std::int64_t mark, const MarkEvidence& evidence) {
    ++version_;
    return marks_.insert_or_assign(mark, evidence).first->second;
  }

  // Forgets marks of which needed(mark) is false, once there are more than
  // `most`.
  template <typename Needed>
  void Tidy(std::size_t most, const Needed& needed) {
    if (marks_.size() <= most) return;
    for (auto mark = marks_.begin(); mark != marks_.end();) {
      mark = needed(mark->first) ? std::next(mark) : marks_.erase(mark);
    }
  }

  const std::map<std::int64_t, MarkEvidence>& all() const { return marks_; }
  // In the place of what is known.
  void Replace(std::map<std::int64_t, MarkEvidence> marks) {
    ++version_;
    marks_ = std::move(marks);
  }

  std::size_t size() const { return marks_.size(); }
  // Grows whenever evidence is kept; 0 before.
  std::uint64_t version() const { return version_; }

 private:
  std::map<std::int64_t, MarkEvidence> marks_;
  std::uint64_t version_ = 0;
  std::uint64_t settings_version_ = 0;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_BELIEF_MARK_H_
