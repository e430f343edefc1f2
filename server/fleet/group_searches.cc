#include "server/fleet/group_searches.h"

#include <algorithm>
#include <atomic>
#include <cstddef>
#include <map>
#include <optional>
#include <set>
#include <string>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "core/base/mutex.h"
#include "server/base/metrics.h"
#include "server/base/status.h"
#include "server/fleet/group_cache.h"
#include "server/fleet/history_keeper.h"
#include "server/fleet/history_room.h"
#include "server/fleet/tasks.h"
#include "server/storage/storage.h"

namespace revisit::server {
namespace {

using Clock = std::chrono::steady_clock;

// Histories that were asked for within this time are not let go for others.
constexpr std::chrono::minutes kInUse{1};

absl::Status NoMember(const std::string& group, const std::string& vehicle) {
  return Error(absl::StatusCode::kNotFound, "MEMBER_NOT_FOUND",
               absl::StrCat("vehicle '", vehicle, "' is no member of group '",
                            group, "', or not known to the caller"),
               {{"vehicle", vehicle}});
}

absl::Status NotReady(const std::string& group, std::size_t missing,
                      std::size_t members) {
  return Error(
      absl::StatusCode::kUnavailable, "GROUP_NOT_READY",
      absl::StrCat("the histories of ", missing, " of ", members,
                   " members of group '", group,
                   "' are being read from the store; try again, or "
                   "set allow_partial"),
      {{"missing", absl::StrCat(missing)}, {"members", absl::StrCat(members)}});
}

// Why the history of the asking vehicle is not known, which is needed.
absl::Status Lacks(const ScopeRequest& request, Absence absence,
                   std::size_t missing, std::size_t members,
                   std::int64_t most_bytes) {
  switch (absence) {
    case Absence::kNotReady:
      return NotReady(request.group, missing, members);
    case Absence::kDamaged:
      return Corrupt(
          absl::StrCat("the stored vehicle '", request.asking, "' is damaged"));
    case Absence::kMemory:
      return Error(
          absl::StatusCode::kResourceExhausted, "MEMORY_PRESSURE",
          absl::StrCat("the history of vehicle '", request.asking,
                       "' has no room beside those that were asked for"),
          {{"limit", absl::StrCat(most_bytes)}});
    case Absence::kNone:
    case Absence::kGone:
      break;
  }
  return NoMember(request.group, request.asking);
}

}  // namespace

// A search's way to its scope.
struct Preparation {
  ScopeRequest request;
  std::function<void(absl::StatusOr<GroupScope>)> then;
  std::shared_ptr<const StoredGroup> group;
  // Of the members that the caller may read, by their ids.
  HistoryKeeper::Keepers keepers;
  std::vector<const GroupMemberRecord*> members;
  std::atomic<std::size_t> left{0};
};
using PreparationPtr = std::shared_ptr<Preparation>;

struct GroupSearches::State {
  State(Fleet* fleet, Storage* for_storage, const RecordCodec* codec,
        Executor* executor, const Options& for_options)
      : options(for_options),
        storage(for_storage),
        room(for_options.most_bytes),
        tasks(executor),
        cache(for_storage, codec) {
    shared.fleet = fleet;
    shared.storage = storage;
    shared.codec = codec;
    shared.tasks = &tasks;
    shared.room = &room;
    shared.make_room = [this] { Unload(Clock::now() - kInUse); };
    shared.views_made = &views_made;
    shared.drives_made = &drives_made;
  }

  void Begin(const PreparationPtr& search) {
    absl::StatusOr<std::shared_ptr<const StoredGroup>> group =
        cache.Group(search->request.group);
    if (!group.ok()) {
      search->then(group.status());
      return;
    }
    search->group = *std::move(group);
    for (const GroupMemberRecord& member : search->group->members) {
      if (!search->request.may_read(member.vehicle_id)) continue;
      search->members.push_back(&member);
      search->keepers.push_back(Keeper(member.vehicle_id));
    }
    std::vector<std::string> needed = search->request.vehicles;
    if (search->request.needs_asking) needed.push_back(search->request.asking);
    for (const std::string& vehicle : needed) {
      if (IsMember(*search, vehicle)) continue;
      search->then(NoMember(search->request.group, vehicle));
      return;
    }
    // One more, so that the last one is this.
    search->left = search->keepers.size() + 1;
    const auto arrived = [hold = tasks.Begin(), this, search] {
      if (--search->left == 0) tasks.Post([this, search] { End(search); });
    };
    HistoryKeeper::RefreshAll(shared, search->keepers, arrived);
    arrived();
  }

  static bool IsMember(const Preparation& search, const std::string& vehicle) {
    return std::any_of(search.members.begin(), search.members.end(),
                       [&](const GroupMemberRecord* member) {
                         return member->vehicle_id == vehicle;
                       });
  }

  static bool IsWanted(const ScopeRequest& request,
                       const std::string& vehicle) {
    const std::vector<std::string>& wanted = request.vehicles;
    return wanted.empty() ||
           std::find(wanted.begin(), wanted.end(), vehicle) != wanted.end();
  }

  void End(const PreparationPtr& search) {
    const ScopeRequest& request = search->request;
    GroupScope scope;
    std::vector<std::shared_ptr<const KnownHistory>> histories;
    std::size_t missing = 0;
    Absence asking = Absence::kGone;
    for (std::size_t m = 0; m < search->members.size(); ++m) {
      const GroupMemberRecord& member = *search->members[m];
      HistoryState state = search->keepers[m]->state();
      if (!member.damage.ok()) state = {nullptr, Absence::kDamaged, {}};
      // One that was deleted and made again is no member.
      const bool is_member =
          state.history == nullptr || state.history->key == member.vehicle;
      if (!is_member || state.absence == Absence::kGone) continue;
      if (member.vehicle_id == request.asking) asking = state.absence;
      if (state.history == nullptr) {
        if (state.absence == Absence::kNotReady) ++missing;
        if (member.vehicle_id == request.asking ||
            !IsWanted(request, member.vehicle_id)) {
          continue;
        }
        scope.absent.push_back({member.vehicle_id, state.absence});
        continue;
      }
      if (member.vehicle_id == request.asking) {
        scope.scope.asking = histories.size();
      }
      scope.scope.searched.push_back(IsWanted(request, member.vehicle_id));
      histories.push_back(std::move(state.history));
      scope.as_of.push_back(state.as_of);
    }
    if (missing > 0 && !request.allow_partial) {
      search->then(NotReady(request.group, missing, search->members.size()));
      return;
    }
    if (request.needs_asking && !scope.scope.asking) {
      search->then(Lacks(request, asking, missing, search->members.size(),
                         options.most_bytes));
      return;
    }
    scope.joined = cache.Joined(search->group, std::move(histories));
    scope.scope.drives = scope.joined->drives;
    scope.scope.exclude_own = request.exclude_own;
    search->then(std::move(scope));
  }

  absl::StatusOr<NamedGroup> ReadGroup(const std::string& id)
      ABSL_LOCKS_EXCLUDED(mutex) {
    auto group = cache.Group(id);
    if (!group.ok()) return group.status();
    NamedGroup named{*std::move(group), {}};
    std::set<std::string> unknown;
    {
      const MutexLock lock(&mutex);
      for (const GroupMemberRecord& member : named.group->members) {
        const auto known = uids.find(member.vehicle);
        if (known != uids.end()) {
          named.uids.insert(*known);
        } else {
          unknown.insert(member.vehicle_id);
        }
      }
    }
    if (unknown.empty()) return named;
    const auto rows = storage->GetVehicles(unknown);
    if (!rows.ok()) return rows.status();
    for (const VehicleRecord& row : *rows) {
      if (!row.damage.ok()) continue;
      const auto config = shared.codec->DecodeVehicle(row);
      if (config.ok()) named.uids.emplace(row.key, config->uid);
    }
    const MutexLock lock(&mutex);
    uids.insert(named.uids.begin(), named.uids.end());
    return named;
  }

  std::shared_ptr<HistoryKeeper> Keeper(const std::string& id)
      ABSL_LOCKS_EXCLUDED(mutex) {
    const MutexLock lock(&mutex);
    std::shared_ptr<HistoryKeeper>& keeper = keepers[id];
    if (keeper == nullptr) {
      keeper = std::make_shared<HistoryKeeper>(id, &shared);
    }
    return keeper;
  }

  std::vector<std::shared_ptr<HistoryKeeper>> Keepers() const
      ABSL_LOCKS_EXCLUDED(mutex) {
    const MutexLock lock(&mutex);
    std::vector<std::shared_ptr<HistoryKeeper>> all;
    for (const auto& [id, keeper] : keepers) all.push_back(keeper);
    return all;
  }

  // Lets go the histories that nobody has asked for since then, and all that
  // was joined of them.
  void Unload(Clock::time_point since) ABSL_LOCKS_EXCLUDED(mutex) {
    std::vector<std::shared_ptr<HistoryKeeper>> over;
    {
      const MutexLock lock(&mutex);
      for (auto i = keepers.begin(); i != keepers.end();) {
        // One that somebody else holds was just asked for.
        const bool is_idle =
            i->second.use_count() == 1 && i->second->last_asked() < since;
        if (is_idle) over.push_back(std::move(i->second));
        i = is_idle ? keepers.erase(i) : std::next(i);
      }
    }
    cache.Forget(since);
  }

  const Options options;
  Storage* const storage;
  HistoryRoom room;
  Tasks tasks;
  GroupCache cache;
  std::atomic<std::uint64_t> views_made{0};
  std::atomic<std::uint64_t> drives_made{0};
  HistoryKeeper::Shared shared;

  mutable Mutex mutex;
  std::map<std::string, std::shared_ptr<HistoryKeeper>> keepers
      ABSL_GUARDED_BY(mutex);
  // The uids of vehicles that are or were members; they never change.
  std::map<VehicleKey, std::string> uids ABSL_GUARDED_BY(mutex);
};

GroupSearches::GroupSearches(Fleet* fleet, Storage* storage,
                             const RecordCodec* codec, Executor* executor,
                             const Options& options)
    : state_(
          std::make_unique<State>(fleet, storage, codec, executor, options)) {}

GroupSearches::~GroupSearches() { state_->tasks.End(); }

void GroupSearches::Prepare(
    ScopeRequest request,
    std::function<void(absl::StatusOr<GroupScope>)> then) {
  auto search = std::make_shared<Preparation>();
  search->request = std::move(request);
  search->then = std::move(then);
  state_->tasks.Post([state = state_.get(), search] { state->Begin(search); });
}

void GroupSearches::ReadGroup(
    std::string id, std::function<void(absl::StatusOr<NamedGroup>)> then) {
  state_->tasks.Post([state = state_.get(), id = std::move(id),
                      then = std::move(then)] { then(state->ReadGroup(id)); });
}

void GroupSearches::UnloadIdle(Clock::time_point now) {
  state_->Unload(now - state_->options.idle_unload);
}

void GroupSearches::CollectMetrics(Metrics* metrics) const {
  std::int64_t followed = 0;
  std::int64_t nodes = 0;
  Clock::duration lag{};
  const auto now = Clock::now();
  for (const auto& keeper : state_->Keepers()) {
    const HistoryState state = keeper->state();
    if (state.history == nullptr) continue;
    // Only those that are asked for are kept up to date.
    if (now - keeper->last_asked() < kInUse) {
      lag = std::max(lag, now - state.as_of);
    }
    if (!keeper->is_followed()) continue;
    ++followed;
    nodes += state.history->view->graph.size();
  }
  metrics
      ->Gauge("revisit_followed_vehicles",
              "Histories that are read from the store for searches in groups.")
      .Add(followed);
  metrics->Gauge("revisit_followed_nodes", "Nodes of these histories.")
      .Add(nodes);
  metrics->Gauge("revisit_followed_bytes", "Bytes of these histories.")
      .Add(state_->room.taken());
  metrics
      ->Gauge("revisit_group_history_lag_seconds",
              "Age of the oldest history that searches in groups have used in "
              "the last minute.")
      .Add(std::chrono::duration<double>(lag).count());
  metrics
      ->Counter("revisit_group_views_total",
                "Views of histories that were made for searches in groups.")
      .Add(state_->views_made.load());
  metrics
      ->Counter("revisit_followed_drives_total",
                "Drives that were made from the store for searches in groups.")
      .Add(state_->drives_made.load());
}

}  // namespace revisit::server
