// The queue of fair_queue.h, which looks at all flows whenever it is asked, and
// forgets them only when none has anything to do.
#ifndef REVISIT_TESTS_ORACLE_PLAIN_FAIR_QUEUE_H_
#define REVISIT_TESTS_ORACLE_PLAIN_FAIR_QUEUE_H_

#include <algorithm>
#include <cstdint>
#include <deque>
#include <map>
#include <optional>
#include <string>
#include <utility>

namespace revisit::oracle {

class PlainFairQueue {
 public:
  explicit PlainFairQueue(std::int64_t credit) : credit_(credit) {}

  void Push(const std::string& name, int item) {
    Flow& flow = flows_[name];
    // One that was not there yet has used nothing that counts.
    const std::int64_t least = reached_ - credit_;
    if (!HasWork(flow)) flow.used = std::max(flow.used.value_or(least), least);
    if (flow.waiting.empty()) flow.since = ++moves_;
    flow.waiting.push_back(item);
  }

  void Return(const std::string& name, int item) {
    Flow& flow = flows_[name];
    if (flow.waiting.empty()) flow.since = ++moves_;
    flow.waiting.push_front(item);
    --flow.at_work;
  }

  std::optional<std::pair<std::string, int>> Take() {
    Flow* first = nullptr;
    std::string name;
    for (auto& [other, flow] : flows_) {
      if (flow.waiting.empty()) continue;
      if (first == nullptr || *flow.used < *first->used ||
          (*flow.used == *first->used && flow.since < first->since)) {
        first = &flow;
        name = other;
      }
    }
    if (first == nullptr) return std::nullopt;
    const int item = first->waiting.front();
    first->waiting.pop_front();
    first->since = ++moves_;
    ++first->at_work;
    LookHowFar();
    return std::pair(name, item);
  }

  void Charge(const std::string& name, std::int64_t cost) {
    *flows_[name].used += cost;
    LookHowFar();
  }

  void Finish(const std::string& name) {
    --flows_[name].at_work;
    if (std::none_of(flows_.begin(), flows_.end(),
                     [](const auto& entry) { return HasWork(entry.second); })) {
      flows_.clear();
    }
  }

  bool OthersFirst(const std::string& name) const {
    return std::any_of(flows_.begin(), flows_.end(), [&](const auto& entry) {
      const auto& [other, flow] = entry;
      return other != name && !flow.waiting.empty() &&
             *flow.used < *flows_.at(name).used;
    });
  }

 private:
  struct Flow {
    std::deque<int> waiting;
    int at_work = 0;
    std::optional<std::int64_t> used;
    // The move with which it began to wait for its next turn.
    int since = 0;
  };

  static bool HasWork(const Flow& flow) {
    return !flow.waiting.empty() || flow.at_work > 0;
  }

  void LookHowFar() {
    std::optional<std::int64_t> least;
    for (const auto& [name, flow] : flows_) {
      if (!HasWork(flow)) continue;
      least = least ? std::min(*least, *flow.used) : *flow.used;
    }
    if (least) reached_ = std::max(reached_, *least);
  }

  const std::int64_t credit_;
  std::map<std::string, Flow> flows_;
  // Each flow with something to do has used at least this much.
  std::int64_t reached_ = 0;
  int moves_ = 0;
};

}  // namespace revisit::oracle

#endif  // REVISIT_TESTS_ORACLE_PLAIN_FAIR_QUEUE_H_
