// All vehicles of the server: those in memory, and how the others get there.
//
// Lifetimes. The storage calls back on its writer's thread, from where sessions
// post to the executors, whose tasks call the storage: so none of them can go
// first while there is work. The fleet goes first of all, and its destructor
// waits until the work of every session is done, so that storage and executors
// are idle and may follow in any order. Nobody may call the fleet or a
// session while or after the fleet is destroyed: finish the calls of the server
// before.
#ifndef REVISIT_SERVER_SESSIONS_FLEET_H_
#define REVISIT_SERVER_SESSIONS_FLEET_H_

#include <chrono>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <memory>
#include <optional>
#include <string>

#include "absl/status/statusor.h"
#include "server/sessions/executor.h"
#include "server/sessions/retention_monitor.h"
#include "server/sessions/server_clock.h"
#include "server/sessions/vehicle_census.h"
#include "server/sessions/vehicle_session.h"

namespace revisit::server {

class Storage;

// A vehicle as it was at the moment of its creation. Valid during the callback
// that is given it.
struct CreatedVehicle {
  // The row that was written.
  const VehicleRecord& record;
  // The vehicle as it was loaded. Null where others have changed or deleted it
  // before that, so that memory does not show it as it was created.
  const VehicleView* view;
};
using CreateCallback =
    std::function<void(const absl::StatusOr<CreatedVehicle>&)>;

// How long events of stored candidates are kept for those who watch.
inline constexpr std::chrono::hours kEventsKept{7 * 24};

// It hands vehicles over that other servers ask for (Storage::OnWanted()), each
// once its calls that came before are finished.
//
// Thread-safe.
class Fleet {
 public:
  struct Options {
    // A vehicle that nobody has asked for this long is unloaded.
    std::chrono::milliseconds idle_unload{std::chrono::minutes(10)};
    // Above this many bytes of nodes and edges, vehicles that nobody holds are
    // unloaded sooner, those first that were not asked for the longest time.
    std::optional<std::int64_t> memory_budget_bytes;
    VehicleSession::Limits session;
    SnapshotPolicy snapshots;
    RetentionMonitor::Reports retention;
    // Counts the vehicles; may be null.
    std::shared_ptr<VehicleCensus> census;
    // Against which the stamps of poses are held.
    ServerClock clock = SystemNanoseconds;
    StoredChecksPolicy checks;
    // How long the end of the fleet may be delayed to write snapshots. Marks
    // are written in any case, in a row for each vehicle.
    std::chrono::milliseconds last_snapshots{500};
  };

  // Storage, codec and executors must outlive the fleet, and no other fleet has
  // the storage.
  Fleet(Storage* storage, const RecordCodec* codec, const Lanes& lanes,
        const Options& options);
  // Finishes what was called, see above. Not on a thread of the executors.
  ~Fleet();

  Fleet(const Fleet&) = delete;
  Fleet& operator=(const Fleet&) = delete;

  // The session of a vehicle, loaded on first use. Hold it no longer than the
  // work or the stream that needs it, and ask again after it is gone().
  std::shared_ptr<VehicleSession> Session(const std::string& id);

  // The session of a vehicle if it is in memory, else null. Does not keep it
  // there.
  std::shared_ptr<VehicleSession> SessionIfLoaded(const std::string& id) const;

  // Creates a vehicle, of revision 1, and answers with it, whatever others have
  // done to it since: never NOT_FOUND. ALREADY_EXISTS (VEHICLE_EXISTS) if the
  // id is taken.
  void Create(const std::string& id, const VehicleConfig& config,
              CreateCallback callback);

  // Deletes a vehicle. NOT_FOUND (VEHICLE_NOT_FOUND) if there is none.
  void Delete(const std::string& id,
              std::function<void(absl::Status)> callback);

  // Has vehicles that are being loaded, now or later, give up where that takes
  // long (VehicleSession::GiveUpReplay()): the server ends.
  void GiveUpReplays();

  // Writes a part of a snapshot that is due, or some where the storage has
  // little else to write. The server calls it on a timer, whose period so
  // bounds what snapshots take of the storage.
  void WriteSnapshots();

  // Has vehicles that owe checks make them: loads some that are in no server's
  // memory, as after a crash, and lets them go once they owe none. The server
  // calls it on a timer.
  void PayChecks();

  // Removes some events that are older than kEventsKept. Any server of a store
  // may do it; each does soon after its start, and then on a timer.
  void DropOldEvents();

  // Vehicles in memory.
  std::size_t loaded() const;

  // Vehicles in memory, with the sums of their VehicleSession::Residency.
  struct Residency {
    std::int64_t vehicles = 0;
    std::int64_t nodes = 0;
    std::int64_t bytes = 0;
  };
  Residency residency() const;

  RetentionMonitor::Counts retention() const;

  // The vehicles in memory, and what retention has dropped.
  void CollectMetrics(Metrics* metrics) const;

  // Unloads the vehicles that have been idle since before `now` less
  // Options::idle_unload, then as many others as exceed the memory budget. Of
  // one whose snapshot is due, or whose marks are new, these are written first,
  // and a later call unloads it.
  // Returns the residency of those that were unloaded. The server calls it on a
  // timer.
  Residency UnloadIdle(std::chrono::steady_clock::time_point now);

 private:
  struct State;
  const std::shared_ptr<State> state_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SESSIONS_FLEET_H_
