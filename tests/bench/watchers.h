// Callers of WatchCandidates, who count what they are told.
#ifndef REVISIT_TESTS_BENCH_WATCHERS_H_
#define REVISIT_TESTS_BENCH_WATCHERS_H_

#include <cstdint>
#include <memory>
#include <string>
#include <vector>

#include "revisit/v1/pose_graph_service.pb.h"

namespace revisit::bench {

class Watchers {
 public:
  // Begins a watch for each request, so many to a connection, and waits until
  // the server has said of each from where it tells. Ends this process with a
  // message if a watch ends by itself.
  Watchers(const std::string& address,
           const std::vector<v1::WatchCandidatesRequest>& requests,
           int a_connection);
  // Ends the watches.
  ~Watchers();

  Watchers(const Watchers&) = delete;
  Watchers& operator=(const Watchers&) = delete;

  // Counts the events of candidates that all of them were told so far.
  std::uint64_t told() const;

 private:
  class Reactor;
  std::vector<std::unique_ptr<Reactor>> reactors_;
};

}  // namespace revisit::bench

#endif  // REVISIT_TESTS_BENCH_WATCHERS_H_
