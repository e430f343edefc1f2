// Where else a search looks: in the drives of other vehicles.
#ifndef REVISIT_CORE_SEARCH_SEARCH_SCOPE_H_
#define REVISIT_CORE_SEARCH_SEARCH_SCOPE_H_

#include <cstddef>
#include <memory>
#include <optional>
#include <vector>

#include "core/drive/joined_drives.h"

namespace revisit::core {

struct SearchScope {
  // Never null. A search looks in those that are searched, but for the one that
  // asks and those that cannot be compared with it (UnsearchedDrive).
  std::shared_ptr<const JoinedDrives> drives;
  // Which of them asks; nothing where it is none of them, and so without links.
  std::optional<std::size_t> asking = std::nullopt;
  // Whether the asking drive's own history is left out.
  bool exclude_own = false;
  // By drive, whether it is searched; empty: all are. The others tie frames all
  // the same.
  std::vector<bool> searched = {};

  bool Searches(std::size_t drive) const {
    return searched.empty() || searched[drive];
  }
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_SEARCH_SCOPE_H_
