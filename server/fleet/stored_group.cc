#include "server/fleet/stored_group.h"

#include <algorithm>
#include <tuple>
#include <utility>

#include "absl/strings/str_cat.h"
#include "server/base/status.h"
#include "server/groups/group_reads.h"
#include "server/records/group_content.h"

namespace revisit::server {
namespace {

constexpr int kMostTries = 5;

absl::Status ReadMembers(GroupStorage* groups, StoredGroup* group) {
  return VisitMembers(groups, group->id, [group](GroupMemberRecord& member) {
    group->members.push_back(std::move(member));
    return true;
  });
}

absl::Status ReadLinks(GroupStorage* groups, StoredGroup* group) {
  return VisitLinks(groups, group->id, [group](GroupLinkRecord& link) {
    if (link.damage.ok() && link.state == LinkState::kRejected) {
      group->rejected.push_back(std::move(link));
      return true;
    }
    if (!link.damage.ok() || link.state != LinkState::kConfirmed) return true;
    std::int64_t create_time_ns = 0;
    const absl::Status read =
        ReadLinkContent(link.payload, [&](const LinkContent& content) {
          create_time_ns = content.create_time_ns;
        });
    if (read.ok()) group->links.push_back({create_time_ns, std::move(link)});
    return true;
  });
}

void SortLinks(std::vector<StoredLink>* links) {
  std::sort(links->begin(), links->end(),
            [](const StoredLink& a, const StoredLink& b) {
              return std::tie(a.create_time_ns, a.record.id) <
                     std::tie(b.create_time_ns, b.record.id);
            });
}

}  // namespace

absl::StatusOr<StoredGroup> ReadStoredGroup(GroupStorage* groups,
                                            const std::string& id) {
  for (int tries = 0; tries < kMostTries; ++tries) {
    const absl::StatusOr<GroupRecord> record = groups->GetGroup(id);
    if (!record.ok()) return record.status();
    if (!record->damage.ok()) return record->damage;
    const absl::StatusOr<GroupContent> content =
        DecodeGroupContent(record->payload);
    if (!content.ok()) return content.status();
    StoredGroup group;
    group.id = id;
    group.version = record->version;
    group.settings = content->settings;
    if (absl::Status read = ReadMembers(groups, &group); !read.ok()) {
      return read;
    }
    if (absl::Status read = ReadLinks(groups, &group); !read.ok()) return read;
    SortLinks(&group.links);
    // Pages are of several moments.
    const absl::StatusOr<GroupRecord> again = groups->GetGroup(id);
    if (!again.ok()) return again.status();
    if (again->version == group.version) return group;
  }
  return Error(absl::StatusCode::kUnavailable, "STORE_UNAVAILABLE",
               absl::StrCat("group '", id,
                            "' changes faster than it can be read; try again"));
}

}  // namespace revisit::server
