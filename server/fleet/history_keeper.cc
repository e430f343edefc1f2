#include "server/fleet/history_keeper.h"

#include <map>
#include <set>

#include "server/storage/storage.h"

namespace revisit::server {
namespace {

// Longest that one task reads before others get the thread.
constexpr std::chrono::milliseconds kFollowSlice{20};

std::int64_t BytesOf(const core::DriveView& view) {
  return static_cast<std::int64_t>(
      view.graph.bytes() + view.motion_history.bytes() +
      view.block_bounds.bytes() + view.recordings.bytes() +
      view.dropped.bytes());
}

}  // namespace

HistoryKeeper::HistoryKeeper(std::string vehicle_id, const Shared* shared)
    : vehicle_(std::move(vehicle_id), shared->storage, shared->codec),
      shared_(shared) {}

HistoryKeeper::~HistoryKeeper() { SetBytes(0); }

HistoryState HistoryKeeper::state() const {
  const MutexLock lock(&mutex_);
  return state_;
}

HistoryKeeper::Clock::time_point HistoryKeeper::last_asked() const {
  const MutexLock lock(&mutex_);
  return last_asked_;
}

void HistoryKeeper::RefreshAll(const Shared& shared, const Keepers& keepers,
                               const std::function<void()>& then) {
  Keepers looking;
  for (const auto& keeper : keepers) {
    if (!keeper->BeginRefresh(then) || keeper->AskSession()) continue;
    looking.push_back(keeper);
  }
  if (!looking.empty()) LookAtStore(shared, looking);
}

void HistoryKeeper::LookAtStore(const Shared& shared, const Keepers& keepers) {
  std::set<std::string> ids;
  for (const auto& keeper : keepers) ids.insert(keeper->vehicle_.id);
  const auto asked = Clock::now();
  const absl::StatusOr<std::vector<VehicleRecord>> records =
      shared.storage->GetVehicles(ids);
  std::map<std::string, const VehicleRecord*> rows;
  if (records.ok()) {
    for (const VehicleRecord& record : *records) rows[record.id] = &record;
  }
  for (const auto& keeper : keepers) {
    const auto row = rows.find(keeper->vehicle_.id);
    if (!records.ok()) {
      keeper->Finish();
    } else if (row == rows.end()) {
      keeper->FinishWithoutRow();
    } else if (!keeper->FinishWith(*row->second, asked)) {
      shared.tasks->Post([keeper, record = *row->second, asked] {
        keeper->FollowInTurn(record, asked);
      });
    }
  }
}

bool HistoryKeeper::BeginRefresh(const std::function<void()>& then) {
  if (NoteAsked(Clock::now())) {
    then();
    return false;
  }
  const MutexLock lock(&mutex_);
  waiting_.push_back(then);
  return !std::exchange(is_working_, true);
}

bool HistoryKeeper::NoteAsked(Clock::time_point now) {
  const MutexLock lock(&mutex_);
  last_asked_ = now;
  return looked_ && now - *looked_ < kFreshHistory &&
         state_.absence != Absence::kNotReady;
}

bool HistoryKeeper::AskSession() {
  const std::shared_ptr<VehicleSession> session =
      shared_->fleet->SessionIfLoaded(vehicle_.id);
  const bool is_here = session != nullptr && !session->gone();
  if (is_here && session->is_loaded()) {
    session->LongRead(
        [hold = shared_->tasks->Begin(), self = shared_from_this()](
            const absl::StatusOr<VehicleView>& view) { self->TakeView(view); });
    return true;
  }
  if (is_here && state().history == nullptr) {
    // What it is loaded for need not be done twice.
    Finish();
    return true;
  }
  return false;
}

void HistoryKeeper::TakeView(const absl::StatusOr<VehicleView>& view) {
  if (!view.ok()) {
    // It leaves, maybe to another server.
    shared_->tasks->Post([self = shared_from_this()] { self->LookAtStore(); });
    return;
  }
  follower_.reset();
  damaged_.reset();
  SetBytes(0);
  if (!view->damage.ok()) {
    Lack(Absence::kDamaged);
    Finish();
    return;
  }
  std::shared_ptr<const KnownHistory> history = state().history;
  const bool is_known = history != nullptr &&
                        history->series == view->nodes_id &&
                        history->revision == view->revision;
  if (!is_known) {
    ++*shared_->views_made;
    history = std::make_shared<const KnownHistory>(
        KnownHistory{view->id, view->key, view->config, view->revision,
                     view->durable_sequence, std::string(view->nodes_id),
                     HistoryView(view->drive)});
  }
  Know(std::move(history), Clock::now());
  Finish();
}

void HistoryKeeper::LookAtStore() {
  const auto asked = Clock::now();
  const absl::StatusOr<VehicleRecord> record =
      shared_->storage->GetVehicle(vehicle_.id);
  if (absl::IsNotFound(record.status())) {
    FinishWithoutRow();
  } else if (!record.ok()) {
    Finish();
  } else if (!FinishWith(*record, asked)) {
    Follow(*record, asked);
  }
}

void HistoryKeeper::FinishWithoutRow() {
  follower_.reset();
  SetBytes(0);
  Lack(Absence::kGone);
  Finish();
}

bool HistoryKeeper::FinishWith(const VehicleRecord& record,
                               Clock::time_point asked) {
  const bool is_known_damage =
      damaged_ == std::pair(record.key, record.revision);
  if (!is_known_damage && !shared_->tasks->is_ending()) {
    if (IsOf(record)) {
      const HistoryState known = state();
      if (follower_ == nullptr) SetBytes(BytesOf(*known.history->view));
      Know(known.history, asked);
    } else if (refused_bytes_ > 0 && !shared_->room->Holds(refused_bytes_)) {
      Lack(Absence::kMemory);
    } else {
      return false;
    }
  }
  Finish();
  return true;
}

// What was written since the row was read may be among the poses that come with
// it, so a row must not get old.
void HistoryKeeper::FollowInTurn(const VehicleRecord& record,
                                 Clock::time_point asked) {
  if (Clock::now() - asked < kFreshHistory) {
    Follow(record, asked);
  } else {
    LookAtStore();
  }
}

// The mark of damage is the one change of a row that leaves its revision.
bool HistoryKeeper::IsOf(const VehicleRecord& record) const {
  const std::shared_ptr<const KnownHistory> history = state().history;
  if (history == nullptr || !record.damage.ok() || history->key != record.key ||
      history->revision != record.revision) {
    return false;
  }
  const absl::StatusOr<VehicleConfig> config = vehicle_.DecodeConfig(record);
  return config.ok() && !config->damaged;
}

void HistoryKeeper::Follow(const VehicleRecord& record,
                           Clock::time_point asked) {
  if (follower_ == nullptr) follower_ = std::make_unique<Follower>(&vehicle_);
  const std::uint64_t made_before = follower_->made();
  // Counted from the first that was read, as in Replayer.
  std::optional<Clock::time_point> pause;
  const absl::StatusOr<bool> reached = follower_->Continue(record, [&pause] {
    const auto now = Clock::now();
    if (!pause) pause = now + kFollowSlice;
    return now < *pause;
  });
  *shared_->drives_made += follower_->made() - made_before;
  if (absl::IsDataLoss(reached.status())) {
    damaged_ = {record.key, record.revision};
    follower_.reset();
    SetBytes(0);
    Lack(Absence::kDamaged);
    Finish();
    return;
  }
  damaged_.reset();
  if (!HasRoom() || !reached.ok()) {
    Finish();
    return;
  }
  if (*reached) {
    if (follower_->history() != state().history) ++*shared_->views_made;
    Know(follower_->history(), asked);
    Finish();
    return;
  }
  // Nobody waits for a drive to be made.
  if (follower_->is_making()) LetGo();
  shared_->tasks->Post([self = shared_from_this()] { self->LookAtStore(); });
}

bool HistoryKeeper::HasRoom() {
  SetBytes(follower_->bytes());
  if (shared_->room->Holds(0)) {
    refused_bytes_ = 0;
    return true;
  }
  shared_->make_room();
  if (shared_->room->Holds(0)) return true;
  refused_bytes_ = bytes();
  follower_.reset();
  SetBytes(0);
  Lack(Absence::kMemory);
  return false;
}

void HistoryKeeper::Know(std::shared_ptr<const KnownHistory> history,
                         Clock::time_point as_of) {
  const MutexLock lock(&mutex_);
  state_ = {std::move(history), Absence::kNone, as_of};
}

void HistoryKeeper::Lack(Absence absence) {
  const MutexLock lock(&mutex_);
  state_ = {nullptr, absence, Clock::now()};
}

void HistoryKeeper::SetBytes(std::int64_t bytes) {
  shared_->room->Change(bytes - bytes_.exchange(bytes));
}

void HistoryKeeper::LetGo() {
  std::vector<std::function<void()>> waiting;
  {
    const MutexLock lock(&mutex_);
    waiting.swap(waiting_);
  }
  for (const auto& then : waiting) then();
}

void HistoryKeeper::Finish() {
  {
    const MutexLock lock(&mutex_);
    looked_ = Clock::now();
    is_working_ = false;
  }
  LetGo();
}

}  // namespace revisit::server
