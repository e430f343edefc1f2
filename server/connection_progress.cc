#include "server/connection_progress.h"

#include <cstddef>

namespace revisit::server {

ProgressCounter ConnectionProgress::Open(const std::string& remote) {
  auto counter = std::make_shared<std::atomic<std::uint64_t>>(0);
  const MutexLock lock(&mutex_);
  counters_[remote] = counter;
  return counter;
}

void ConnectionProgress::Close(const std::string& remote,
                               const ProgressCounter& counter) {
  const MutexLock lock(&mutex_);
  const auto found = counters_.find(remote);
  if (found != counters_.end() && found->second == counter) {
    counters_.erase(found);
  }
}

ProgressCounter ConnectionProgress::Find(const std::string& peer) const {
  const std::string remote = RemoteOf(peer);
  const MutexLock lock(&mutex_);
  const auto found = counters_.find(remote);
  return found == counters_.end() ? nullptr : found->second;
}

std::string ConnectionProgress::RemoteOf(const std::string& peer) {
  const std::size_t scheme = peer.find(':');
  if (scheme == std::string::npos) return peer;
  std::string remote;
  for (std::size_t i = scheme + 1; i < peer.size(); ++i) {
    if (peer.compare(i, 3, "%5B") == 0 || peer.compare(i, 3, "%5D") == 0) {
      i += 2;
    } else if (peer[i] != '[' && peer[i] != ']') {
      remote += peer[i];
    }
  }
  return remote;
}

}  // namespace revisit::server
