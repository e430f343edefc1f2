// The order in which flows of work get their turns.
//
// This is start-time fair queueing (Goyal, Vin and Cheng, 1996), in which a
// flow is charged for what its items have used, while and after they use it: it
// needs no estimate beforehand. The next item is that of the flow that has used
// least. A flow that comes back after a pause begins where those that are there
// have got to, less a credit: it gets nothing for the time when it wanted
// nothing, but a little at once. So while two flows both have items that wait,
// neither gets ahead of the other by more than the credit and what the items
// that it has at work are still to be charged for; and none waits for ever.
#ifndef REVISIT_SERVER_SESSIONS_FAIR_QUEUE_H_
#define REVISIT_SERVER_SESSIONS_FAIR_QUEUE_H_

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <deque>
#include <iterator>
#include <optional>
#include <set>
#include <string>
#include <unordered_map>
#include <utility>

namespace revisit::server {

// Needs no clock. Flows that have nothing to do are forgotten once what they
// have used makes no difference, all of them when none has anything to do, and,
// beyond kMostIdle, those first that have used least. Not thread-safe.
template <typename Item>
class FairQueue {
 public:
  // How much was used, in a unit of the caller's.
  using Cost = std::int64_t;

  // Flows without anything to do of which is known what they have used.
  static constexpr std::size_t kMostIdle = 10000;

  struct Taken {
    std::string flow;
    Item item;
  };

  // REQUIRES: credit >= 0.
  explicit FairQueue(Cost credit) : credit_(credit) {}

  // Adds an item behind the others of its flow.
  void Push(const std::string& flow, Item item) {
    Flow& state = Enter(flow);
    state.waiting.push_back(std::move(item));
    if (state.waiting.size() == 1) StandInLine(&state);
  }

  // Gives an item back that was taken and is to go on before the others of its
  // flow, in place of Finish().
  void Return(const std::string& flow, Item item) {
    Flow& state = flows_.at(flow);
    state.waiting.push_front(std::move(item));
    if (state.waiting.size() == 1) StandInLine(&state);
    Leave(&state);
  }

  // Takes the first item of the flow that has used least; of several such, of
  // that which has waited longest since its last turn. Nothing if none waits.
  // Each item that was taken is finished or returned.
  std::optional<Taken> Take() {
    if (line_.empty()) return std::nullopt;
    Flow& state = *line_.begin()->flow;
    LeaveLine(&state);
    Taken taken{*state.name, std::move(state.waiting.front())};
    state.waiting.pop_front();
    if (!state.waiting.empty()) StandInLine(&state);
    if (state.taken++ == 0) busy_.insert(&state);
    Advance();
    return taken;
  }

  // Charges a flow for what an item that is taken has used.
  void Charge(const std::string& flow, Cost cost) {
    Flow& state = flows_.at(flow);
    const bool waits = !state.waiting.empty();
    if (waits) line_.erase(PlaceOf(state));
    state.used += cost;
    if (waits) line_.insert(PlaceOf(state));
    Advance();
  }

  // An item that was taken is done.
  void Finish(const std::string& flow) { Leave(&flows_.at(flow)); }

  // Whether another flow waits that has used less than this one, of which an
  // item is taken.
  bool OthersFirst(const std::string& flow) const {
    const Flow& state = flows_.at(flow);
    auto first = line_.begin();
    if (first != line_.end() && first->flow == &state) ++first;
    return first != line_.end() && first->used < state.used;
  }

  bool empty() const { return line_.empty(); }
  // Flows that are remembered.
  std::size_t flows() const { return flows_.size(); }

 private:
  struct Flow {
    const std::string* name = nullptr;
    std::deque<Item> waiting;
    int taken = 0;
    // Compared between flows only: one that comes begins with what the others
    // have got to (Enter()).
    Cost used = 0;
    // Grows from one that stands in line to the next.
    std::uint64_t came = 0;
  };
  // The place of a flow among others. The flow that has used least comes first.
  struct Place {
    Cost used;
    std::uint64_t came;
    Flow* flow;

    bool operator<(const Place& other) const {
      return used != other.used ? used < other.used : came < other.came;
    }
  };

  static Place PlaceOf(Flow& flow) { return {flow.used, flow.came, &flow}; }

  Flow& Enter(const std::string& name) {
    const auto [entry, is_new] = flows_.try_emplace(name);
    Flow& flow = entry->second;
    flow.name = &entry->first;
    if (is_new) {
      flow.used = reached_ - credit_;
    } else if (flow.waiting.empty() && flow.taken == 0) {
      // It has used more than a new one, or it would have been forgotten.
      idle_.erase(PlaceOf(flow));
    }
    return flow;
  }

  void Leave(Flow* flow) {
    if (--flow->taken > 0) return;
    busy_.erase(flow);
    if (!flow->waiting.empty()) return;
    idle_.insert(PlaceOf(*flow));
    Forget();
  }

  void StandInLine(Flow* flow) {
    flow->came = ++came_;
    line_.insert(PlaceOf(*flow));
  }

  void LeaveLine(Flow* flow) { line_.erase(PlaceOf(*flow)); }

  // Notes how far the flows that have something to do have got.
  void Advance() {
    std::optional<Cost> least;
    if (!line_.empty()) least = line_.begin()->used;
    for (const Flow* flow : busy_) {
      least = least ? std::min(*least, flow->used) : flow->used;
    }
    if (least) reached_ = std::max(reached_, *least);
    Forget();
  }

  void Forget() {
    const bool all = line_.empty() && busy_.empty();
    while (!idle_.empty() && (all || idle_.size() > kMostIdle ||
                              idle_.begin()->used <= reached_ - credit_)) {
      const std::string name = *idle_.begin()->flow->name;
      idle_.erase(idle_.begin());
      flows_.erase(name);
    }
  }

  const Cost credit_;
  std::unordered_map<std::string, Flow> flows_;
  // Flows with items that wait, and flows with nothing at all.
  std::set<Place> line_;
  std::set<Place> idle_;
  // Flows of which items are taken.
  std::set<Flow*> busy_;
  // Each flow with something to do has used at least this much.
  Cost reached_ = 0;
  std::uint64_t came_ = 0;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SESSIONS_FAIR_QUEUE_H_
