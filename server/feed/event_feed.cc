#include "server/feed/event_feed.h"

#include <pthread.h>

#include <algorithm>
#include <tuple>
#include <utility>

#include "server/base/metrics.h"
#include "server/conversion/stored_checks_codec.h"
#include "server/feed/sweep_pace.h"
#include "server/storage/storage.h"

namespace revisit::server {
namespace {

constexpr int kEventsPerRead = 500;
// The feed indexes each event, which takes about so many bytes beside it.
constexpr std::size_t kIndexBytes = 64;
// Events that one call of Newest() looks at, of all vehicles.
constexpr std::size_t kMostLookedAt = 1000;
// With more vehicles than these, looking at all events takes no longer.
constexpr std::size_t kFewVehicles = 16;

bool IsBefore(const EventPosition& a, const EventPosition& b) {
  return std::tie(a.order, a.key, a.number) <
         std::tie(b.order, b.key, b.number);
}

// The id in vehicles/{vehicle}, or at the beginning of a longer name.
std::string IdIn(const std::string& name) {
  const std::size_t begin = name.find('/') + 1;
  return name.substr(begin, name.find('/', begin) - begin);
}

FeedEventPtr Decode(const EventRecord& record) {
  auto event = std::make_shared<FeedEvent>();
  event->position = record.position;
  if (record.payload.empty() ||
      !EncodeEvent(record, &event->message, &event->matched_vehicle_id).ok()) {
    event->message.Clear();
  } else {
    event->vehicle_id = IdIn(event->message.has_vehicle_deleted()
                                 ? event->message.vehicle_deleted().vehicle()
                                 : event->message.candidate().check());
  }
  // What is decoded takes some times as much as its payload.
  event->bytes = sizeof(FeedEvent) - sizeof(event->message) +
                 event->message.SpaceUsedLong() + kIndexBytes;
  return event;
}

}  // namespace

EventFeed::EventFeed(Storage* storage, const Options& options)
    : storage_(storage), options_(options), thread_([this] { Run(); }) {
  pthread_setname_np(thread_.native_handle(), "event-feed");
}

EventFeed::~EventFeed() {
  {
    const MutexLock lock(&mutex_);
    stopping_ = true;
    changed_.NotifyAll();
  }
  thread_.join();
}

EventFeed::WatchId EventFeed::Watch(std::function<void()> look) {
  const MutexLock lock(&mutex_);
  const WatchId id = ++last_id_;
  watches_.emplace(id,
                   std::make_shared<std::function<void()>>(std::move(look)));
  changed_.NotifyAll();
  return id;
}

void EventFeed::Unwatch(WatchId id) {
  const MutexLock lock(&mutex_);
  watches_.erase(id);
}

void EventFeed::Run() {
  while (true) {
    {
      MutexLock lock(&mutex_);
      while (!stopping_ && watches_.empty()) {
        // What comes while nobody watches is not read.
        Forget();
        changed_.Wait(&mutex_);
      }
      if (stopping_) return;
    }
    const auto until = std::chrono::steady_clock::now() + options_.period;
    const bool may_have_more = ReadOn();
    // Whoever is behind what is written is not to rest.
    CallWatches(may_have_more ? std::chrono::milliseconds(0) : options_.period);
    if (may_have_more) continue;
    MutexLock lock(&mutex_);
    while (!stopping_ && std::chrono::steady_clock::now() < until) {
      changed_.WaitUntil(&mutex_, until);
    }
  }
}

bool EventFeed::ReadOn() {
  bool is_known = false;
  EventPosition end;
  {
    const MutexLock lock(&mutex_);
    is_known = begin_.has_value();
    end = end_;
  }
  if (!is_known) {
    const absl::StatusOr<EventPosition> last = storage_->LastEvent();
    if (!last.ok()) return false;
    const MutexLock lock(&mutex_);
    begin_ = end_ = *last;
    return false;
  }
  const auto records = storage_->ReadEvents(end, kEventsPerRead);
  if (absl::IsOutOfRange(records.status())) {
    // The store is another one than before, or was long out of reach: whoever
    // watches finds out by its own cursor.
    const MutexLock lock(&mutex_);
    Forget();
    return true;
  }
  if (!records.ok() || records->empty()) return false;
  const std::int64_t now_ns =
      std::chrono::duration_cast<std::chrono::nanoseconds>(
          std::chrono::system_clock::now().time_since_epoch())
          .count();
  std::vector<FeedEventPtr> decoded;
  for (const EventRecord& record : *records) {
    decoded.push_back(Decode(record));
    delay_.Observe(static_cast<double>(now_ns - record.time_ns) / 1e9);
  }
  const MutexLock lock(&mutex_);
  for (FeedEventPtr& event : decoded) Keep(std::move(event));
  while (bytes_ > options_.most_bytes && events_.size() > 1) DropFirst();
  return static_cast<int>(records->size()) == kEventsPerRead;
}

void EventFeed::CallWatches(std::chrono::milliseconds within) {
  using Clock = std::chrono::steady_clock;
  SweepPace pace(within, Clock::now().time_since_epoch());
  WatchId last = 0;
  while (true) {
    const Clock::time_point now = Clock::now();
    const auto until = now + pace.RestBefore(now.time_since_epoch());
    std::shared_ptr<std::function<void()>> look;
    {
      MutexLock lock(&mutex_);
      while (!stopping_ && Clock::now() < until) {
        changed_.WaitUntil(&mutex_, until);
      }
      const auto next = watches_.upper_bound(last);
      if (next == watches_.end()) return;
      last = next->first;
      look = next->second;
    }
    (*look)();
  }
}

void EventFeed::Forget() {
  begin_.reset();
  of_vehicle_.clear();
  events_.clear();
  bytes_ = 0;
}

void EventFeed::Keep(FeedEventPtr event) {
  bytes_ += event->bytes;
  end_ = event->position;
  of_vehicle_.emplace(event->vehicle_id, dropped_ + events_.size());
  events_.push_back(std::move(event));
}

void EventFeed::DropFirst() {
  const FeedEvent& first = *events_.front();
  bytes_ -= first.bytes;
  begin_ = first.position;
  of_vehicle_.erase({first.vehicle_id, dropped_});
  ++dropped_;
  events_.pop_front();
}

std::optional<NewEvents> EventFeed::Newest(
    const EventPosition& after, const std::set<std::string>& vehicles,
    Wanted wanted, int most) const {
  const MutexLock lock(&mutex_);
  if (!begin_ || IsBefore(after, *begin_)) return std::nullopt;
  const auto next = std::upper_bound(
      events_.begin(), events_.end(), after,
      [](const EventPosition& position, const FeedEventPtr& event) {
        return IsBefore(position, event->position);
      });
  if (next == events_.end()) return NewEvents{{}, after, 0};
  const auto first = static_cast<std::size_t>(next - events_.begin());
  return vehicles.empty() || vehicles.size() > kFewVehicles
             ? NewestOfAll(first, wanted, most)
             : NewestOfVehicles(first, vehicles, wanted, most);
}

NewEvents EventFeed::NewestOfVehicles(std::size_t first,
                                      const std::set<std::string>& vehicles,
                                      Wanted wanted, int most) const {
  std::vector<std::size_t> found;
  for (const std::string& vehicle : vehicles) {
    for (auto next = of_vehicle_.lower_bound({vehicle, dropped_ + first});
         next != of_vehicle_.end() && next->first == vehicle; ++next) {
      const std::size_t index = next->second - dropped_;
      if (wanted(*events_[index])) found.push_back(index);
    }
  }
  std::sort(found.begin(), found.end());
  std::size_t last = events_.size() - 1;
  if (found.size() > static_cast<std::size_t>(most)) {
    found.resize(static_cast<std::size_t>(most));
    last = found.back();
  }
  NewEvents newest;
  for (const std::size_t index : found) {
    newest.events.push_back(events_[index]);
  }
  newest.up_to = events_[last]->position;
  newest.passed = static_cast<std::int64_t>(last + 1 - first - found.size());
  return newest;
}

NewEvents EventFeed::NewestOfAll(std::size_t first, Wanted wanted,
                                 int most) const {
  NewEvents newest;
  const std::size_t end = std::min(events_.size(), first + kMostLookedAt);
  for (std::size_t index = first; index < end; ++index) {
    const FeedEventPtr& event = events_[index];
    newest.up_to = event->position;
    if (!wanted(*event)) {
      ++newest.passed;
      continue;
    }
    newest.events.push_back(event);
    if (static_cast<int>(newest.events.size()) == most) break;
  }
  return newest;
}

absl::StatusOr<std::vector<FeedEventPtr>> EventFeed::Read(
    const EventPosition& after, int most) const {
  const auto records = storage_->ReadEvents(after, most);
  if (!records.ok()) return records.status();
  std::vector<FeedEventPtr> events;
  for (const EventRecord& record : *records) events.push_back(Decode(record));
  return events;
}

void EventFeed::CollectMetrics(Metrics* metrics) const {
  std::int64_t watches = 0;
  {
    const MutexLock lock(&mutex_);
    watches = static_cast<std::int64_t>(watches_.size());
  }
  metrics
      ->Gauge("revisit_watches", "Calls of WatchCandidates that are under way.")
      .Add(watches);
  metrics
      ->Histogram("revisit_feed_delay_seconds",
                  "Time from when an event was written until this server read "
                  "it for those who watch.")
      .Add(delay_.Read());
}

}  // namespace revisit::server
