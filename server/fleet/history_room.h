// The memory that followed histories take together.
#ifndef REVISIT_SERVER_FLEET_HISTORY_ROOM_H_
#define REVISIT_SERVER_FLEET_HISTORY_ROOM_H_

#include <atomic>
#include <cstdint>

namespace revisit::server {

// Thread-safe.
class HistoryRoom {
 public:
  explicit HistoryRoom(std::int64_t most_bytes) : most_bytes_(most_bytes) {}

  void Change(std::int64_t bytes) { taken_ += bytes; }
  std::int64_t taken() const { return taken_.load(); }
  // Whether there is room for so many bytes more.
  bool Holds(std::int64_t bytes) const {
    return taken_.load() + bytes <= most_bytes_;
  }

 private:
  const std::int64_t most_bytes_;
  std::atomic<std::int64_t> taken_{0};
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_FLEET_HISTORY_ROOM_H_
