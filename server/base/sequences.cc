#include "server/base/sequences.h"

#include "absl/strings/str_cat.h"

namespace revisit::server {

std::optional<std::string> FindSequenceGap(std::uint64_t before,
                                           std::uint64_t sequence) {
  if (sequence == before + 1) return std::nullopt;
  return absl::StrCat("got ", sequence,
                      "; the poses of a batch have consecutive sequences, and "
                      "after the pose before comes ",
                      before + 1);
}

}  // namespace revisit::server
