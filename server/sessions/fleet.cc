#include "server/sessions/fleet.h"

#include <algorithm>
#include <atomic>
#include <cstdlib>
#include <limits>
#include <unordered_map>
#include <utility>
#include <vector>

#include "core/base/mutex.h"
#include "server/base/metrics.h"
#include "server/base/status.h"
#include "server/storage/storage.h"

namespace revisit::server {
namespace {

constexpr std::uint64_t kCreatedRevision = 1;

// Parts of a snapshot that are written in one go where little else came from
// one call of WriteSnapshots() to the next: at most so many writes, and nodes.
// A part is about a megabyte.
constexpr int kPartsAtRest = 16;
constexpr std::uint64_t kWritesAtRest = 100;
constexpr std::int64_t kNodesAtRest = 2000;

// Vehicles that are loaded at a time to make the checks that they owe, and how
// many are looked for at a time.
constexpr std::size_t kMostPaying = 2;
constexpr int kOwingPerRead = 100;
constexpr int kMostEventsDropped = 1000;

}  // namespace

struct Fleet::State : std::enable_shared_from_this<Fleet::State> {
  struct Entry {
    std::shared_ptr<VehicleSession> session;
    std::chrono::steady_clock::time_point last_use;
    // Number of the call of WriteSnapshots() that chose it last.
    std::uint64_t last_snapshot = 0;
    // Whether the fleet has set it to work by itself since the last use.
    bool works_by_itself = false;
  };
  using Entries = std::unordered_map<std::string, Entry>;
  // Sessions that were taken out of the map, and what they held.
  struct Dropped {
    std::vector<std::shared_ptr<VehicleSession>> sessions;
    Residency residency;
  };

  State(Storage* fleet_storage, const RecordCodec* fleet_codec,
        const Lanes& fleet_lanes, const Options& fleet_options)
      : storage(fleet_storage),
        codec(fleet_codec),
        lanes(fleet_lanes),
        options(fleet_options),
        retention(std::make_shared<RetentionMonitor>(fleet_options.retention)) {
  }

  std::shared_ptr<VehicleSession> Session(const std::string& id)
      ABSL_LOCKS_EXCLUDED(mutex) {
    // Destroyed after the lock is released.
    std::shared_ptr<VehicleSession> replaced;
    std::shared_ptr<VehicleSession> session;
    {
      const MutexLock guard(&mutex);
      Entry& entry = entries[id];
      entry.last_use = std::chrono::steady_clock::now();
      entry.works_by_itself = false;
      if (entry.session != nullptr && !entry.session->gone()) {
        return entry.session;
      }
      session = VehicleSession::Load(
          id, storage, codec, lanes, options.session, options.snapshots,
          retention, options.clock, options.census, options.checks);
      if (gives_up_replays) session->GiveUpReplay();
      replaced = std::exchange(entry.session, session);
    }
    // A vehicle that is not there takes no room.
    session->Read(
        [weak = weak_from_this(), id](const absl::StatusOr<VehicleView>& view) {
          if (view.ok()) return;
          if (const auto self = weak.lock()) self->Forget(id);
        });
    return session;
  }

  // Drops the session of a vehicle if it is gone.
  void Forget(const std::string& id) ABSL_LOCKS_EXCLUDED(mutex) {
    std::shared_ptr<VehicleSession> dropped;
    const MutexLock guard(&mutex);
    const auto found = entries.find(id);
    if (found == entries.end() || !found->second.session->gone()) return;
    dropped = std::move(found->second.session);
    entries.erase(found);
  }

  // Loads a vehicle that was created, so that those who ask for it find it, and
  // answers the creation.
  void LoadCreated(const VehicleRecord& record, bool again,
                   const CreateCallback& callback) {
    Session(record.id)->Read(
        [self = shared_from_this(), record, again,
         callback](const absl::StatusOr<VehicleView>& view) {
          if (absl::IsNotFound(view.status()) && again) {
            // This session was loaded, and found no vehicle, just before the
            // vehicle was created.
            self->LoadCreated(record, false, callback);
          } else {
            AnswerCreated(record, view, callback);
            self->Created();
          }
        });
  }

  // A vehicle that is not found a second time has been deleted since.
  static void AnswerCreated(const VehicleRecord& record,
                            const absl::StatusOr<VehicleView>& view,
                            const CreateCallback& callback) {
    if (!view.ok() && !absl::IsNotFound(view.status())) {
      callback(view.status());
      return;
    }
    const bool is_as_created = view.ok() && view->key == record.key &&
                               view->revision == record.revision &&
                               view->damage.ok();
    callback(CreatedVehicle{record, is_as_created ? &*view : nullptr});
  }

  Residency ResidencyLocked() const ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex) {
    Residency sum;
    for (const auto& [id, entry] : entries) {
      if (entry.session->gone()) continue;
      const VehicleSession::Residency of = entry.session->residency();
      ++sum.vehicles;
      sum.nodes += of.nodes;
      sum.bytes += of.bytes;
    }
    return sum;
  }

  void Created() ABSL_LOCKS_EXCLUDED(mutex) {
    const MutexLock guard(&mutex);
    --creating;
    // Under the lock: afterwards the fleet may go, and the executor with it.
    changed.NotifyAll();
  }

  Residency UnloadIdle(std::chrono::steady_clock::time_point now) {
    // Destroyed after the lock is released: a graph takes a while to take down.
    Dropped dropped;
    const MutexLock guard(&mutex);
    std::vector<Entries::iterator> unused_entries;
    for (auto i = entries.begin(); i != entries.end();) {
      Entry& entry = i->second;
      // Nobody but this map has it, so nobody can start anything on it now.
      const bool unused =
          entry.session.use_count() == 1 && !entry.session->busy();
      // Work that it does by itself, such as writing its snapshot, is no use.
      if (entry.session.use_count() > 1 ||
          (entry.session->busy() && !entry.works_by_itself)) {
        entry.last_use = now;
      }
      const bool is_idle =
          unused && entry.last_use + options.idle_unload <= now;
      if (entry.session->gone() || (is_idle && !MustWrite(entry))) {
        i = Drop(i, &dropped);
        continue;
      }
      if (unused && !is_idle) unused_entries.push_back(i);
      ++i;
    }
    if (!options.memory_budget_bytes) return dropped.residency;
    std::int64_t above = ResidencyLocked().bytes - *options.memory_budget_bytes;
    if (above <= 0) return dropped.residency;
    std::sort(unused_entries.begin(), unused_entries.end(),
              [](const Entries::iterator& a, const Entries::iterator& b) {
                return a->second.last_use < b->second.last_use;
              });
    for (const Entries::iterator& entry : unused_entries) {
      if (above <= 0) break;
      above -= entry->second.session->residency().bytes;
      if (!MustWrite(entry->second)) Drop(entry, &dropped);
    }
    return dropped.residency;
  }

  // Whether something is to be written before the vehicle can be unloaded: then
  // it is begun.
  bool MustWrite(Entry& entry) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex) {
    if (entry.session->has_unsettled_checks()) {
      entry.works_by_itself = true;
      entry.session->SettleChecks([] {});
      return true;
    }
    if (!entry.session->wants_snapshot() && !entry.session->has_new_marks()) {
      return false;
    }
    WriteSnapshot(std::numeric_limits<int>::max(), &entry);
    return true;
  }

  // Has sessions go on with what they do by themselves and could not, or may do
  // only so often.
  void GoOn() ABSL_LOCKS_EXCLUDED(mutex) {
    const MutexLock guard(&mutex);
    for (auto& [id, entry] : entries) {
      VehicleSession* const session = entry.session.get();
      if (session->gone()) continue;
      if (!session->is_loaded()) session->PayChecks();
      if (!session->has_waiting_checks()) continue;
      entry.works_by_itself = true;
      session->GoOnWithChecks();
    }
  }

  void PayChecks() ABSL_LOCKS_EXCLUDED(mutex) {
    GoOn();
    // Sessions are let go after the lock is.
    std::vector<std::shared_ptr<VehicleSession>> over;
    bool has_room = false;
    {
      const MutexLock guard(&mutex);
      const auto is_over = [](const std::shared_ptr<VehicleSession>& session) {
        return session->gone() ||
               (session->is_loaded() && session->check_debt() == 0);
      };
      const auto first = std::partition(
          paying.begin(), paying.end(),
          [&](const auto& session) { return !is_over(session); });
      over.assign(first, paying.end());
      paying.erase(first, paying.end());
      has_room = paying.size() < kMostPaying;
    }
    for (const auto& session : over) {
      if (session->has_unsettled_checks()) session->SettleChecks([] {});
    }
    if (!has_room) return;
    const absl::StatusOr<std::vector<VehicleRecord>> owing =
        storage->ListUnchecked(paid_to, kOwingPerRead);
    if (!owing.ok()) return;
    // From the beginning again, the next time.
    paid_to = owing->size() < kOwingPerRead ? 0 : owing->back().key;
    for (const VehicleRecord& record : *owing) {
      if (const auto session = Resident(record.id)) {
        // One that is in use pays by itself, unless a write has failed.
        if (session->check_debt() > 0) session->PayChecks();
        continue;
      }
      const std::shared_ptr<VehicleSession> session = Session(record.id);
      const MutexLock guard(&mutex);
      paying.push_back(session);
      if (paying.size() < kMostPaying) continue;
      paid_to = record.key;
      return;
    }
  }

  // The session of a vehicle that is in memory, else null: asking is no use of
  // it.
  std::shared_ptr<VehicleSession> Resident(const std::string& id)
      ABSL_LOCKS_EXCLUDED(mutex) {
    const MutexLock guard(&mutex);
    const auto found = entries.find(id);
    return found == entries.end() || found->second.session->gone()
               ? nullptr
               : found->second.session;
  }

  void WriteSnapshot(int most_parts, Entry* entry)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex) {
    entry->works_by_itself = true;
    ++writing_snapshots;
    entry->session->WriteSnapshot(most_parts, [self = shared_from_this()] {
      const MutexLock guard(&self->mutex);
      --self->writing_snapshots;
      // Under the lock: see Created().
      self->changed.NotifyAll();
    });
  }

  // Goes on with the snapshot that is due and has waited longest, unless one is
  // being written.
  void WriteNextSnapshot(int most_parts) ABSL_LOCKS_EXCLUDED(mutex) {
    const MutexLock guard(&mutex);
    if (writing_snapshots > 0) return;
    ++snapshot_calls;
    Entry* next = nullptr;
    for (auto& [id, entry] : entries) {
      if (entry.session->gone() || !entry.session->wants_snapshot()) continue;
      if (next == nullptr || entry.last_snapshot < next->last_snapshot) {
        next = &entry;
      }
    }
    if (next == nullptr) return;
    next->last_snapshot = snapshot_calls;
    WriteSnapshot(most_parts, next);
  }

  void HandOver(const WantedVehicle& wanted) ABSL_LOCKS_EXCLUDED(mutex) {
    const MutexLock guard(&mutex);
    const auto found = entries.find(wanted.id);
    // Under the lock, so that nobody loads the vehicle in between.
    if (found == entries.end() || found->second.session->gone()) {
      storage->ReleaseVehicle(wanted.key);
    } else {
      found->second.session->HandOver();
    }
  }

  Entries::iterator Drop(Entries::iterator entry, Dropped* dropped)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex) {
    const VehicleSession::Residency of = entry->second.session->residency();
    ++dropped->residency.vehicles;
    dropped->residency.nodes += of.nodes;
    dropped->residency.bytes += of.bytes;
    dropped->sessions.push_back(std::move(entry->second.session));
    return entries.erase(entry);
  }

  Storage* const storage;
  const RecordCodec* const codec;
  const Lanes lanes;
  const Options options;
  const std::shared_ptr<RetentionMonitor> retention;

  Mutex mutex;
  CondVar changed;
  Entries entries ABSL_GUARDED_BY(mutex);
  bool gives_up_replays ABSL_GUARDED_BY(mutex) = false;
  std::uint64_t snapshot_calls ABSL_GUARDED_BY(mutex) = 0;
  // Vehicles that are held in memory until they owe no checks.
  std::vector<std::shared_ptr<VehicleSession>> paying ABSL_GUARDED_BY(mutex);
  // The key of the last vehicle that was looked at for checks that it owes.
  // Belongs to the thread that calls PayChecks().
  VehicleKey paid_to = 0;
  // Calls of VehicleSession::WriteSnapshot() that are not answered: maybe by
  // sessions that are no entries any more.
  int writing_snapshots ABSL_GUARDED_BY(mutex) = 0;
  // Storage::Counts() and residency at the last call of WriteSnapshots().
  std::atomic<std::uint64_t> writes_before{0};
  std::atomic<std::int64_t> nodes_before{0};
  // Calls of Create() that are not answered.
  int creating ABSL_GUARDED_BY(mutex) = 0;
};

Fleet::Fleet(Storage* storage, const RecordCodec* codec, const Lanes& lanes,
             const Options& options)
    : state_(std::make_shared<State>(storage, codec, lanes, options)) {
  storage->OnWanted([state = state_.get()](const WantedVehicle& wanted) {
    state->HandOver(wanted);
  });
}

Fleet::~Fleet() {
  state_->storage->OnWanted(nullptr);
  std::vector<std::shared_ptr<VehicleSession>> sessions;
  {
    const MutexLock lock(&state_->mutex);
    while (state_->creating != 0) state_->changed.Wait(&state_->mutex);
    state_->paying.clear();
    for (const auto& [id, entry] : state_->entries) {
      sessions.push_back(entry.session);
    }
  }
  struct Countdown {
    explicit Countdown(std::size_t from) : left(from) {}

    Mutex mutex;
    CondVar zero;
    std::size_t left ABSL_GUARDED_BY(mutex);
  };
  const auto countdown = std::make_shared<Countdown>(sessions.size());
  const auto snapshot_until =
      std::chrono::steady_clock::now() + state_->options.last_snapshots;
  for (const std::shared_ptr<VehicleSession>& session : sessions) {
    session->Close(snapshot_until, [countdown] {
      const MutexLock guard(&countdown->mutex);
      if (--countdown->left == 0) countdown->zero.NotifyAll();
    });
  }
  const MutexLock lock(&countdown->mutex);
  while (countdown->left != 0) countdown->zero.Wait(&countdown->mutex);
  const MutexLock guard(&state_->mutex);
  while (state_->writing_snapshots != 0) state_->changed.Wait(&state_->mutex);
}

void Fleet::WriteSnapshots() {
  const std::uint64_t writes = state_->storage->Counts().writes;
  const std::int64_t nodes = residency().nodes;
  const bool is_at_rest =
      writes - state_->writes_before.exchange(writes) <= kWritesAtRest &&
      std::abs(nodes - state_->nodes_before.exchange(nodes)) <= kNodesAtRest;
  state_->WriteNextSnapshot(is_at_rest ? kPartsAtRest : 1);
}

void Fleet::DropOldEvents() {
  constexpr std::int64_t kept_ns =
      std::chrono::nanoseconds(kEventsKept).count();
  // One that fails is made up for by the next.
  state_->storage->DropEvents(state_->options.clock() - kept_ns,
                              kMostEventsDropped, [](const absl::Status&) {});
}

void Fleet::PayChecks() { state_->PayChecks(); }

void Fleet::GiveUpReplays() {
  const MutexLock lock(&state_->mutex);
  state_->gives_up_replays = true;
  for (const auto& [id, entry] : state_->entries) entry.session->GiveUpReplay();
}

std::shared_ptr<VehicleSession> Fleet::Session(const std::string& id) {
  return state_->Session(id);
}

std::shared_ptr<VehicleSession> Fleet::SessionIfLoaded(
    const std::string& id) const {
  return state_->Resident(id);
}

void Fleet::Create(const std::string& id, const VehicleConfig& config,
                   CreateCallback callback) {
  {
    const MutexLock guard(&state_->mutex);
    ++state_->creating;
  }
  VehicleRecord record;
  record.id = id;
  record.payload = state_->codec->EncodeVehicle(config);
  record.revision = kCreatedRevision;
  state_->storage->CreateVehicle(
      record, [state = state_, record, callback = std::move(callback)](
                  const absl::StatusOr<VehicleKey>& key) {
        // Off the writer's thread.
        state->lanes.short_work->Post([state, record, callback, key]() mutable {
          if (key.ok()) {
            if (state->options.census) state->options.census->Created(*key);
            record.key = *key;
            state->LoadCreated(record, true, callback);
          } else {
            callback(key.status());
            state->Created();
          }
        });
      });
}

void Fleet::Delete(const std::string& id,
                   std::function<void(absl::Status)> callback) {
  Session(id)->Delete([weak = std::weak_ptr<State>(state_), id,
                       callback = std::move(callback)](absl::Status status) {
    if (const auto state = weak.lock()) state->Forget(id);
    callback(std::move(status));
  });
}

std::size_t Fleet::loaded() const {
  const MutexLock guard(&state_->mutex);
  std::size_t count = 0;
  for (const auto& [id, entry] : state_->entries) {
    if (!entry.session->gone()) ++count;
  }
  return count;
}

Fleet::Residency Fleet::residency() const {
  const MutexLock guard(&state_->mutex);
  return state_->ResidencyLocked();
}

RetentionMonitor::Counts Fleet::retention() const {
  return state_->retention->Read();
}

void Fleet::CollectMetrics(Metrics* metrics) const {
  const Residency sum = residency();
  metrics->Gauge("revisit_resident_vehicles", "Vehicles in memory.")
      .Add(sum.vehicles);
  metrics->Gauge("revisit_resident_nodes", "Nodes of vehicles in memory.")
      .Add(sum.nodes);
  metrics
      ->Gauge("revisit_resident_bytes",
              "Bytes of nodes and edges of vehicles in memory.")
      .Add(sum.bytes);
  state_->retention->CollectMetrics(metrics);
  if (state_->options.checks.monitor != nullptr) {
    state_->options.checks.monitor->CollectMetrics(metrics);
  }
}

Fleet::Residency Fleet::UnloadIdle(std::chrono::steady_clock::time_point now) {
  return state_->UnloadIdle(now);
}

}  // namespace revisit::server
