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
#include <string>
#include <thread>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
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
  v1::WatchCandidatesResponse message;
  // The memory that it takes.
  std::size_t bytes = 0;
};
using FeedEventPtr = std::shared_ptr<const FeedEvent>;

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

  // The events behind a position that are in memory, `most` of them: none if
  // there are none yet. Nothing at all if the position is not among those that
  // memory covers: then they have to be read (Read()).
  std::optional<std::vector<FeedEventPtr>> Newest(const EventPosition& after,
                                                  int most) const;
  // The same from the store, for those that are behind: takes a while. Errors
  // are those of Storage::ReadEvents().
  absl::StatusOr<std::vector<FeedEventPtr>> Read(const EventPosition& after,
                                                 int most) const;

  void CollectMetrics(Metrics* metrics) const;

 private:
  void Run();
  // Asks the store for what is new. Returns whether there may be more.
  bool ReadOn() ABSL_LOCKS_EXCLUDED(mutex_);
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
  std::size_t bytes_ ABSL_GUARDED_BY(mutex_) = 0;
  std::map<WatchId, std::shared_ptr<std::function<void()>>> watches_
      ABSL_GUARDED_BY(mutex_);
  WatchId last_id_ ABSL_GUARDED_BY(mutex_) = 0;
  // The last member, since the thread uses the others.
  std::thread thread_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_FEED_EVENT_FEED_H_
