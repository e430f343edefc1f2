#include "server/fleet/history_keeper.h"

#include "server/storage/storage.h"

namespace revisit::server {
namespace {

// Longest that one task reads before others get the thread.
constexpr std::chrono::milliseconds kFollowSlice{20};

std::int64_t BytesOf(const core::DriveView& view) {
  return static_cast<std::int64_t>(
      view.graph.bytes() + view.motion_history.bytes() +
      view.block_bounds.bytes() + view.recordings.bytes());
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

void HistoryKeeper::Refresh(std::function<void()> then) {
  if (NoteAsked(Clock::now())) {
    then();
    return;
  }
  {
    const MutexLock lock(&mutex_);
    waiting_.push_back(std::move(then));
    if (is_working_) return;
    is_working_ = true;
  }
  shared_->tasks->Post([self = shared_from_this()] { self->Look(); });
}

bool HistoryKeeper::NoteAsked(Clock::time_point now) {
  const MutexLock lock(&mutex_);
  last_asked_ = now;
  return looked_ && now - *looked_ < kFreshHistory &&
         state_.absence != Absence::kNotReady;
}

void HistoryKeeper::Look() {
  const std::shared_ptr<VehicleSession> session =
      shared_->fleet->SessionIfLoaded(vehicle_.id);
  const bool is_here = session != nullptr && !session->gone();
  if (is_here && session->is_loaded()) {
    session->LongRead(
        [self = shared_from_this(), hold = shared_->tasks->Begin()](
            const absl::StatusOr<VehicleView>& view) { self->TakeView(view); });
  } else if (is_here && state().history == nullptr) {
    // What it is loaded for need not be done twice.
    Finish();
  } else {
    LookAtStore();
  }
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
    follower_.reset();
    SetBytes(0);
    Lack(Absence::kGone);
    Finish();
  } else if (!record.ok() || shared_->tasks->is_ending() ||
             damaged_ == std::pair(record->key, record->revision)) {
    Finish();
  } else if (IsOf(*record)) {
    const HistoryState known = state();
    if (follower_ == nullptr) SetBytes(BytesOf(*known.history->view));
    Know(known.history, asked);
    Finish();
  } else if (refused_bytes_ > 0 && !shared_->room->Holds(refused_bytes_)) {
    Lack(Absence::kMemory);
    Finish();
  } else {
    Follow(*record, asked);
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
