#include "server/storage/group_records.h"

#include <algorithm>

namespace revisit::server {
namespace {

struct PayloadBytes {
  std::size_t operator()(const SetGroupPayload& change) const {
    return change.payload.size();
  }
  std::size_t operator()(const AddGroupMember& change) const {
    return change.member.payload.size();
  }
  std::size_t operator()(const SetGroupMember& change) const {
    return change.member.payload.size();
  }
  std::size_t operator()(const AddGroupLink& change) const {
    return change.link.payload.size();
  }
  std::size_t operator()(const SetGroupLink& change) const {
    return change.payload.size();
  }
  std::size_t operator()(const RemoveGroupMember&) const { return 0; }
  std::size_t operator()(const RemoveGroupLink&) const { return 0; }
};

}  // namespace

std::size_t BytesOf(const std::vector<GroupChange>& changes) {
  std::size_t bytes = 0;
  for (const GroupChange& change : changes) {
    bytes += std::visit(PayloadBytes(), change);
  }
  return bytes;
}

bool OnlyRemove(const std::vector<GroupChange>& changes) {
  return std::all_of(
      changes.begin(), changes.end(), [](const GroupChange& change) {
        return std::holds_alternative<RemoveGroupMember>(change) ||
               std::holds_alternative<RemoveGroupLink>(change);
      });
}

}  // namespace revisit::server
