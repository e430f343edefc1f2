// The newest events of a store (storage.h) for all who watch it: one reader
// asks the store for them, and only while somebody watches.
#ifndef REVISIT_SERVER_FEED_EVENT_FEED_H_
#define REVISIT_SERVER_FEED_EVENT_FEED_H_

#include <chrono>
#include <cstddef>
#include <cstdint>
#include <deque>
#include <functional>
#include <map>
#include <memory>
#include <optional>
#include <set>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "absl/container/btree_set.h"
#include "absl/functional/function_ref.h"
#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "core/base/mutex.h"
#include "revisit/v1/pose_graph_service.pb.h"
#include "server/base/histogram.h"
#include "server/storage/records.h"

namespace revisit::server {

class Metrics;
class Storage;

// An event as it is told, without its cursor.
struct FeedEvent {
  EventPosition position;
  // Empty where the vehicle is gone, or the event is damaged: nothing is told
  // of it then, and whoever has come to it goes on behind it.
  std::string vehicle_id;
  // The other vehicle that it is about; empty if there is none.
  std::string matched_vehicle_id;
  v1::WatchCandidatesResponse message;
  // The memory that it takes.
  std::size_t bytes = 0;
};
using FeedEventPtr = std::shared_ptr<const FeedEvent>;

// The next events that somebody wants.
struct NewEvents {
  std::vector<FeedEventPtr> events;
  // Up to here there are no others that are wanted, but `passed` that are not.
  EventPosition up_to;
  std::int64_t passed = 0;
};

// Thread-safe.
class EventFeed {
 public:
  struct Options {
    // How often the store is asked while somebody watches.
    std::chrono::milliseconds period{200};
    // Events that are kept in memory for all who watch.
    std::size_t most_bytes = std::size_t{16} << 20;
  };

  // The storage outlives this.
  EventFeed(Storage* storage, const Options& options);
  // REQUIRES: nobody watches any more.
  ~EventFeed();

  EventFeed(const EventFeed&) = delete;
  EventFeed& operator=(const EventFeed&) = delete;

  // Calls `look` on the feed's thread once a period, and whenever there are new
  // events, until Unwatch(); a call may still come shortly after that. Return
  // soon from it.
  using WatchId = std::int64_t;
  WatchId Watch(std::function<void()> look);
  void Unwatch(WatchId id);

  // The events behind a position that are in memory and wanted, `most` of them,
  // of these vehicles or, with none, of all: none if there are none yet, or
  // where many that are not wanted come first (NewEvents::up_to). Nothing at
  // all if the position is not among those that memory covers: then they have
  // to be read (Read()). O(log) for a few vehicles and what they have, for
  // others O(events that are looked at). Call nothing of the feed in `wanted`.
  using Wanted = absl::FunctionRef<bool(const FeedEvent&)>;
  std::optional<NewEvents> Newest(const EventPosition& after,
                                  const std::set<std::string>& vehicles,
                                  Wanted wanted, int most) const;
  // All events behind a position, `most` of them, from the store, for those
  // that are behind: takes a while. Errors are those of Storage::ReadEvents().
  absl::StatusOr<std::vector<FeedEventPtr>> Read(const EventPosition& after,
                                                 int most) const;

  void CollectMetrics(Metrics* metrics) const;

 private:
  void Run();
  // Asks the store for what is new. Returns whether there may be more.
  bool ReadOn() ABSL_LOCKS_EXCLUDED(mutex_);
  // Forgets what is in memory, and up to where the store was read.
  void Forget() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  void Keep(FeedEventPtr event) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  void DropFirst() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  // Newest() from the event with this index on.
  NewEvents NewestOfVehicles(std::size_t first,
                             const std::set<std::string>& vehicles,
                             Wanted wanted, int most) const
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  NewEvents NewestOfAll(std::size_t first, Wanted wanted, int most) const
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  // Rests between calls, so long as it does not take longer than this.
  void CallWatches(std::chrono::milliseconds within)
      ABSL_LOCKS_EXCLUDED(mutex_);

  Storage* const storage_;
  const Options options_;
  Histogram delay_{{0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 10.0, 60.0, 600.0}};

  mutable Mutex mutex_;
  CondVar changed_;
  bool stopping_ ABSL_GUARDED_BY(mutex_) = false;
  // Behind which all events up to `end_` are in `events_`; nothing until the
  // store was asked.
  std::optional<EventPosition> begin_ ABSL_GUARDED_BY(mutex_);
  EventPosition end_ ABSL_GUARDED_BY(mutex_);
  std::deque<FeedEventPtr> events_ ABSL_GUARDED_BY(mutex_);
  // How many events were dropped before the first: with its index, an event's
  // serial number.
  std::uint64_t dropped_ ABSL_GUARDED_BY(mutex_) = 0;
  // The events of each vehicle, by serial number. The ids are those of events.
  absl::btree_set<std::pair<absl::string_view, std::uint64_t>> of_vehicle_
      ABSL_GUARDED_BY(mutex_);
  std::size_t bytes_ ABSL_GUARDED_BY(mutex_) = 0;
  std::map<WatchId, std::shared_ptr<std::function<void()>>> watches_
      ABSL_GUARDED_BY(mutex_);
  WatchId last_id_ ABSL_GUARDED_BY(mutex_) = 0;
  // The last member, since the thread uses the others.
  std::thread thread_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_FEED_EVENT_FEED_H_
