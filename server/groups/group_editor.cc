#include "server/groups/group_editor.h"

#include <deque>
#include <map>
#include <optional>
#include <utility>

#include "core/base/mutex.h"
#include "server/storage/group_check.h"

namespace revisit::server {
namespace {

// How often an order is tried before it has lost to other servers too often.
constexpr int kMostAttempts = 100;

struct Creation {
  GroupRecord group;
  std::function<absl::Status()> given_up;
  GroupEditor::Created done;
};

struct Editing {
  GroupOrder order;
  // Null: the group is deleted.
  GroupPlan plan;
  GroupEditor::Done done;
  int attempts = 0;
};

}  // namespace

// All but Take() and Pass() runs on threads of the executor.
struct GroupEditor::State : std::enable_shared_from_this<State> {
  State(Storage* store, Executor* runs) : storage(store), executor(runs) {}

  // Has `task` run once all that was taken before for this group has passed.
  void Take(const std::string& group, std::function<void()> task);
  void Pass(const std::string& group);

  // Continues off the writer's thread with the answer to a write.
  template <typename Next>
  GroupStorage::Done Then(Next next) {
    return [self = shared_from_this(),
            next = std::move(next)](absl::StatusOr<std::uint64_t> revision) {
      self->executor->Post(
          [next, revision = std::move(revision)] { next(revision); });
    };
  }

  void Create(const std::shared_ptr<Creation>& creation);
  void FindCreated(const std::shared_ptr<Creation>& creation,
                   const absl::StatusOr<std::uint64_t>& revision);

  void Attempt(const std::shared_ptr<Editing>& editing);
  // Submits the write; an error where there is none to submit. Nothing is
  // written where the answer is a version.
  absl::StatusOr<std::optional<GroupVersion>> Submit(
      const std::shared_ptr<Editing>& editing);
  void Settle(const std::shared_ptr<Editing>& editing, const std::string& uid,
              const absl::StatusOr<std::uint64_t>& revision);

  template <typename Order, typename Outcome>
  void Finish(const std::string& group, const Order& order, Outcome outcome) {
    order->done(std::move(outcome));
    Pass(group);
  }

  Storage* const storage;
  Executor* const executor;

  Mutex mutex;
  CondVar idle;
  // What waits, by group, behind the task that runs.
  std::map<std::string, std::deque<std::function<void()>>> turns
      ABSL_GUARDED_BY(mutex);
};

void GroupEditor::State::Take(const std::string& group,
                              std::function<void()> task) {
  const MutexLock lock(&mutex);
  const auto [turn, is_first] = turns.try_emplace(group);
  if (is_first) {
    executor->Post(std::move(task));
  } else {
    turn->second.push_back(std::move(task));
  }
}

void GroupEditor::State::Pass(const std::string& group) {
  const MutexLock lock(&mutex);
  const auto turn = turns.find(group);
  if (turn->second.empty()) {
    turns.erase(turn);
    idle.NotifyAll();
    return;
  }
  executor->Post(std::move(turn->second.front()));
  turn->second.pop_front();
}

void GroupEditor::State::Create(const std::shared_ptr<Creation>& creation) {
  if (absl::Status status = creation->given_up(); !status.ok()) {
    Finish(creation->group.id, creation, status);
    return;
  }
  storage->Groups().CreateGroup(
      creation->group, Then([self = shared_from_this(), creation](
                                const absl::StatusOr<std::uint64_t>& revision) {
        self->FindCreated(creation, revision);
      }));
}

void GroupEditor::State::FindCreated(
    const std::shared_ptr<Creation>& creation,
    const absl::StatusOr<std::uint64_t>& revision) {
  GroupRecord& group = creation->group;
  if (revision.ok()) {
    group.version.revision = *revision;
    Finish(group.id, creation, group);
  } else if (absl::IsAlreadyExists(revision.status())) {
    const absl::StatusOr<GroupRecord> found =
        storage->Groups().GetGroup(group.id);
    // A group that was deleted between the two is created anew: a creation
    // never finds nothing.
    if (absl::IsNotFound(found.status())) {
      Create(creation);
    } else {
      Finish(group.id, creation, found);
    }
  } else {
    Finish(group.id, creation, revision.status());
  }
}

void GroupEditor::State::Attempt(const std::shared_ptr<Editing>& editing) {
  absl::StatusOr<std::optional<GroupVersion>> submitted = Submit(editing);
  const std::string& group = editing->order.group_id;
  if (!submitted.ok()) {
    Finish(group, editing, submitted.status());
  } else if (*submitted) {
    Finish(group, editing, **std::move(submitted));
  }
}

absl::StatusOr<std::optional<GroupVersion>> GroupEditor::State::Submit(
    const std::shared_ptr<Editing>& editing) {
  const GroupOrder& order = editing->order;
  if (absl::Status status = order.given_up(); !status.ok()) return status;
  const absl::StatusOr<GroupRecord> group =
      storage->Groups().GetGroup(order.group_id);
  if (!group.ok()) return group.status();
  const std::uint64_t any = group->version.revision;
  const GroupVersion expected = {
      group->version.uid,
      order.expected_revision == 0 ? any : order.expected_revision};
  if (absl::Status status = CheckVersion(*group, expected); !status.ok()) {
    return status;
  }
  GroupEdit edit;
  // Who deletes a group of any revision deletes it.
  edit.fits_any_revision = true;
  if (editing->plan != nullptr) {
    absl::StatusOr<GroupEdit> planned = editing->plan(*group);
    if (!planned.ok()) return planned.status();
    edit = *std::move(planned);
    if (edit.changes.empty()) return std::optional<GroupVersion>(expected);
  }
  std::optional<GroupVersion> version;
  if (order.expected_revision != 0 || !edit.fits_any_revision) {
    version = expected;
  }
  const auto settle =
      Then([self = shared_from_this(), editing,
            uid = expected.uid](const absl::StatusOr<std::uint64_t>& revision) {
        self->Settle(editing, uid, revision);
      });
  if (editing->plan == nullptr) {
    storage->Groups().DeleteGroup(order.group_id, version, settle);
  } else {
    storage->Groups().ChangeGroup(order.group_id, version,
                                  std::move(edit.changes), settle);
  }
  return std::optional<GroupVersion>();
}

void GroupEditor::State::Settle(const std::shared_ptr<Editing>& editing,
                                const std::string& uid,
                                const absl::StatusOr<std::uint64_t>& revision) {
  const GroupOrder& order = editing->order;
  if (revision.ok()) {
    Finish(order.group_id, editing, GroupVersion{uid, *revision});
  } else if (absl::IsAborted(revision.status()) &&
             order.expected_revision == 0 &&
             ++editing->attempts < kMostAttempts) {
    Attempt(editing);
  } else {
    Finish(order.group_id, editing, revision.status());
  }
}

GroupEditor::GroupEditor(Storage* storage, Executor* executor)
    : state_(std::make_shared<State>(storage, executor)) {}

GroupEditor::~GroupEditor() {
  const MutexLock lock(&state_->mutex);
  while (!state_->turns.empty()) state_->idle.Wait(&state_->mutex);
}

void GroupEditor::Create(GroupRecord group,
                         std::function<absl::Status()> given_up, Created done) {
  const std::string id = group.id;
  const auto creation = std::make_shared<Creation>(
      Creation{std::move(group), std::move(given_up), std::move(done)});
  state_->Take(id, [state = state_, creation] { state->Create(creation); });
}

void GroupEditor::Change(GroupOrder order, GroupPlan plan, Done done) {
  const std::string id = order.group_id;
  const auto editing = std::make_shared<Editing>(
      Editing{std::move(order), std::move(plan), std::move(done)});
  state_->Take(id, [state = state_, editing] { state->Attempt(editing); });
}

void GroupEditor::Delete(GroupOrder order, Done done) {
  Change(std::move(order), nullptr, std::move(done));
}

}  // namespace revisit::server
