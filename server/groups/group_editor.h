// Writes groups of vehicles: what a caller asks for becomes a write of the
// store that fits the group as it is, whoever else writes it, also on other
// servers.
#ifndef REVISIT_SERVER_GROUPS_GROUP_EDITOR_H_
#define REVISIT_SERVER_GROUPS_GROUP_EDITOR_H_

#include <cstdint>
#include <functional>
#include <memory>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/sessions/executor.h"
#include "server/storage/storage.h"

namespace revisit::server {

// What a change of a group is to write.
struct GroupEdit {
  // None: the group is already as it is to be, and nothing is written.
  std::vector<GroupChange> changes;
  // Whether they are right whatever becomes of the group meanwhile.
  bool fits_any_revision = false;
};

// Makes the edit of a group as it is now, which may be damaged. It may block on
// the storage, and is called again where others have changed the group since.
using GroupPlan =
    std::function<absl::StatusOr<GroupEdit>(const GroupRecord& group)>;

struct GroupOrder {
  std::string group_id;
  // The only revision at which the group is changed; 0 means any.
  std::uint64_t expected_revision = 0;
  // Asked before each attempt: not OK once nobody waits for the outcome, which
  // then is this status.
  std::function<absl::Status()> given_up;
};

// Orders for one group are carried out one after the other, in the order in
// which they come. Errors are those of GroupStorage and of the plan. Where
// other servers change the group at the same time, an order for any revision is
// tried again; once it has lost to them too often, it ends with ABORTED
// (REVISION_MISMATCH). Outcomes are given on threads of the executor.
//
// Thread-safe.
class GroupEditor {
 public:
  // The version that the group has then.
  using Done = std::function<void(absl::StatusOr<GroupVersion>)>;
  using Created = std::function<void(absl::StatusOr<GroupRecord>)>;

  // The executor runs what blocks on the storage. Both outlive this.
  GroupEditor(Storage* storage, Executor* executor);
  // Waits for all orders.
  ~GroupEditor();

  GroupEditor(const GroupEditor&) = delete;
  GroupEditor& operator=(const GroupEditor&) = delete;

  // Answers the group with this id: the one that is given, or the one that was
  // there before, which has another uid. Reads id, uid and payload.
  void Create(GroupRecord group, std::function<absl::Status()> given_up,
              Created done);
  void Change(GroupOrder order, GroupPlan plan, Done done);
  void Delete(GroupOrder order, Done done);

 private:
  struct State;

  const std::shared_ptr<State> state_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_GROUPS_GROUP_EDITOR_H_
