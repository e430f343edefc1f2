// Rules for the sequences that number a vehicle's poses.
#ifndef REVISIT_SERVER_BASE_SEQUENCES_H_
#define REVISIT_SERVER_BASE_SEQUENCES_H_

#include <cstdint>
#include <limits>
#include <optional>
#include <string>

namespace revisit::server {

// Sequences are stored as signed numbers.
inline constexpr std::uint64_t kMaxSequence =
    std::numeric_limits<std::int64_t>::max();

// Within a batch, each pose has the sequence of the pose before plus 1: the
// description of the violation if `sequence` does not follow `before`.
std::optional<std::string> FindSequenceGap(std::uint64_t before,
                                           std::uint64_t sequence);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_BASE_SEQUENCES_H_
