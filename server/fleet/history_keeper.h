// Knows the history of one vehicle for searches of others: from its session,
// where this server has it in memory, else from the store, without owning it.
#ifndef REVISIT_SERVER_FLEET_HISTORY_KEEPER_H_
#define REVISIT_SERVER_FLEET_HISTORY_KEEPER_H_

#include <atomic>
#include <chrono>
#include <cstdint>
#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/base/mutex.h"
#include "server/fleet/follower.h"
#include "server/fleet/history_room.h"
#include "server/fleet/known_history.h"
#include "server/fleet/tasks.h"
#include "server/sessions/fleet.h"
#include "server/sessions/record_codec.h"
#include "server/sessions/vehicle_reader.h"

namespace revisit::server {

class Storage;

// How old a history may be that is used as it is.
inline constexpr std::chrono::seconds kFreshHistory{1};

// Thread-safe. Work goes on only while somebody asks.
class HistoryKeeper : public std::enable_shared_from_this<HistoryKeeper> {
 public:
  using Clock = std::chrono::steady_clock;
  using Keepers = std::vector<std::shared_ptr<HistoryKeeper>>;

  // What all keepers share; must outlive them.
  struct Shared {
    Fleet* fleet = nullptr;
    Storage* storage = nullptr;
    const RecordCodec* codec = nullptr;
    Tasks* tasks = nullptr;
    HistoryRoom* room = nullptr;
    // Lets go what nobody needs, where room is short.
    std::function<void()> make_room;
    std::atomic<std::uint64_t>* views_made = nullptr;
    std::atomic<std::uint64_t>* drives_made = nullptr;
  };

  HistoryKeeper(std::string vehicle_id, const Shared* shared);
  ~HistoryKeeper();

  HistoryKeeper(const HistoryKeeper&) = delete;
  HistoryKeeper& operator=(const HistoryKeeper&) = delete;

  // Sees to it that these histories are no older than kFreshHistory, and calls
  // `then` for each: at once, or on a thread that must not be made to wait.
  // Waits for the rows of those that are looked for in the store, which are
  // read together. Where a history has to be made from the store, that goes on
  // behind `then`, and state() is what there was before.
  static void RefreshAll(const Shared& shared, const Keepers& keepers,
                         const std::function<void()>& then);

  HistoryState state() const ABSL_LOCKS_EXCLUDED(mutex_);
  Clock::time_point last_asked() const ABSL_LOCKS_EXCLUDED(mutex_);
  // Whether the history comes from the store, the nodes that it has there, and
  // the bytes that it takes beside those of sessions.
  bool is_followed() const { return bytes_.load() > 0; }
  std::int64_t bytes() const { return bytes_.load(); }

 private:
  // Whether a refresh begins with this, at whose end `then` is called.
  bool BeginRefresh(const std::function<void()>& then)
      ABSL_LOCKS_EXCLUDED(mutex_);
  // Whether the history may be used as it is.
  bool NoteAsked(Clock::time_point now) ABSL_LOCKS_EXCLUDED(mutex_);
  // A part of one refresh after the other; there is one at a time.

  // Returns whether the session answers; else the store has to be looked at.
  bool AskSession();
  void TakeView(const absl::StatusOr<VehicleView>& view);
  static void LookAtStore(const Shared& shared, const Keepers& keepers);
  void LookAtStore();
  // Ends the refresh, and returns true, unless the row, read after `asked`, has
  // to be followed.
  bool FinishWith(const VehicleRecord& record, Clock::time_point asked);
  void FinishWithoutRow();
  // Whether the history is that of the row as it is now.
  bool IsOf(const VehicleRecord& record) const;
  void Follow(const VehicleRecord& record, Clock::time_point asked);
  // The same after a wait for a thread.
  void FollowInTurn(const VehicleRecord& record, Clock::time_point asked);
  // Whether what is followed has room.
  bool HasRoom();

  void Know(std::shared_ptr<const KnownHistory> history,
            Clock::time_point as_of) ABSL_LOCKS_EXCLUDED(mutex_);
  void Lack(Absence absence) ABSL_LOCKS_EXCLUDED(mutex_);
  void SetBytes(std::int64_t bytes);
  void LetGo() ABSL_LOCKS_EXCLUDED(mutex_);
  void Finish() ABSL_LOCKS_EXCLUDED(mutex_);

  const VehicleReader vehicle_;
  const Shared* const shared_;

  mutable Mutex mutex_;
  HistoryState state_ ABSL_GUARDED_BY(mutex_);
  Clock::time_point last_asked_ ABSL_GUARDED_BY(mutex_);
  std::optional<Clock::time_point> looked_ ABSL_GUARDED_BY(mutex_);
  bool is_working_ ABSL_GUARDED_BY(mutex_) = false;
  std::vector<std::function<void()>> waiting_ ABSL_GUARDED_BY(mutex_);

  // ---- Belongs to the refresh that is under way.

  // Null where the session has the vehicle.
  std::unique_ptr<Follower> follower_;
  // The row that was found to be damaged.
  std::optional<std::pair<VehicleKey, std::uint64_t>> damaged_;
  // The bytes for which there was no room.
  std::int64_t refused_bytes_ = 0;
  std::atomic<std::int64_t> bytes_{0};
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_FLEET_HISTORY_KEEPER_H_
