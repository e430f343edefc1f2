// The two kinds of what was found of two poses of a group's members: loop
// closures, and rejected candidates. Both are links in the store.
#ifndef REVISIT_SERVER_GROUPS_LINK_KIND_H_
#define REVISIT_SERVER_GROUPS_LINK_KIND_H_

#include <string>

#include "server/storage/group_records.h"
#include "server/storage/records.h"

namespace revisit::server {

// Begins the ids of rejected candidates' rows: no id of a caller has it, so
// that each kind has ids of its own, and it comes behind all of them.
inline constexpr char kRejectedMark = '~';

// The id of a row, from the one that a caller knows, and back; the kind of a
// row, also of a damaged one.
inline std::string LinkRowId(PairKind kind, const std::string& id) {
  return kind == PairKind::kLoopClosure ? id : kRejectedMark + id;
}
inline PairKind KindOf(const GroupLinkRecord& link) {
  return !link.id.empty() && link.id.front() == kRejectedMark
             ? PairKind::kRejectedCandidate
             : PairKind::kLoopClosure;
}
inline std::string LinkIdOf(const GroupLinkRecord& link) {
  return KindOf(link) == PairKind::kLoopClosure ? link.id : link.id.substr(1);
}

}  // namespace revisit::server

#endif  // REVISIT_SERVER_GROUPS_LINK_KIND_H_
