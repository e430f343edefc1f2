// The order in which a session's work is done: one ordered queue per vehicle.
#ifndef REVISIT_SERVER_SESSIONS_VEHICLE_QUEUE_H_
#define REVISIT_SERVER_SESSIONS_VEHICLE_QUEUE_H_

#include <deque>
#include <functional>
#include <memory>
#include <string>
#include <utility>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/sessions/appends_in_flight.h"
#include "server/sessions/executor.h"
#include "server/sessions/vehicle_state.h"
#include "server/storage/records.h"

namespace revisit::server {

// When an operation may start, once the vehicle is loaded.
enum class Turn {
  // At once, ahead of what waits; but not while the store shows a change that
  // memory does not show yet.
  kRead,
  // As kRead, for an operation that searches: it runs in the lane of searches
  // also where it had to wait.
  kSearch,
  // The operation reads the store itself, which takes long. It starts when a
  // kRead may, but also waits while poses are being revised.
  kReadStored,
  // After what came before; other appends may be in flight.
  kAppend,
  // After what came before, and while no append is in flight.
  kAlone,
};

struct Operation {
  Turn turn;
  // Called once, with OK to do it, or with the answer instead.
  std::function<void(const absl::Status&)> run;
  // Whose search it is, of a kSearch.
  std::string flow{};
};

// Belongs to the strand, but for what is said to be called from any thread.
class VehicleQueue {
 public:
  // The part of the vehicle that the store shows, or may show at any moment,
  // before memory does.
  enum class StoreLead {
    kNone,
    // Revised poses.
    kPoses,
    // The vehicle's end, or pairs that are not yet in the graph.
    kVehicle,
  };

  VehicleQueue(VehicleState* vehicle, const AppendsInFlight* appends,
               const Lanes& lanes);

  // Every task holds a reference to `session`, so that it lives until its work
  // is done. Call once, before anything else.
  void KeepAlive(std::weak_ptr<void> session) { session_ = std::move(session); }

  // ---- From any thread

  // Submits an operation by the lane of short work, of long work, of searches.
  void Submit(Operation operation);
  void SubmitLong(Operation operation);
  void SubmitSearch(Operation operation);

  // Runs a task on the strand, in the lane of short work, of long work, of
  // searches, where `flow` says whose search it is. Tasks do not take turns:
  // they are parts of operations.
  template <typename Task>
  void Post(Task task) {
    strand_->Post(Keeping(std::move(task)));
  }
  template <typename Task>
  void PostLong(Task task) {
    strand_->PostLong(Keeping(std::move(task)));
  }
  template <typename Task>
  void PostSearch(const std::string& flow, Task task) {
    strand_->PostSearch(flow, Keeping([this, task = std::move(task)]() mutable {
                          task();
                          vehicle_->NoteSearched();
                        }));
  }
  // Whether other work of the vehicle waits for the task that runs.
  bool IsWanted() const { return strand_->IsWanted(); }
  // See Strand::RunOrPost().
  template <typename Task>
  void RunOrPost(Task task) {
    strand_->RunOrPost(Keeping(std::move(task)));
  }

  // A callback for the storage that runs `then`, with its status, on the
  // strand.
  template <typename Then>
  WriteDone OnStrand(Then then) {
    return Kept([this, then = std::move(then)](const absl::Status& status) {
      Post([then, status]() mutable { then(status); });
    });
  }
  // The same where `then` runs on the storage's thread.
  template <typename Then>
  WriteDone Kept(Then then) {
    return [keep = session_.lock(), then = std::move(then)](
               const absl::Status& status) { then(status); };
  }

  // The same for an answer that has a value.
  template <typename Value, typename Then>
  std::function<void(absl::StatusOr<Value>)> AnswerOnStrand(Then then) {
    return [this, keep = session_.lock(),
            then = std::move(then)](absl::StatusOr<Value> answer) {
      strand_->Post([keep, then, answer = std::move(answer)]() mutable {
        then(std::move(answer));
      });
    };
  }

  // ---- On the strand

  // Submits an operation behind all others, or ahead of them; what may start is
  // started by a task of its own.
  void PushBack(Operation operation);
  void PushFront(Operation operation);
  void PumpLater();

  // Starts what may start, in order. Does nothing within Release() and within
  // an operation that Pump() runs: what it would do follows.
  void Pump();

  // Whether an append that comes now may start at once, on a thread that must
  // not wait for the storage.
  bool MayAppendHere() const;

  // Between Hold() and Release() nothing starts but reads: the vehicle is
  // loaded or changed. Release() runs `then` before anything that waits.
  void Hold() { held_ = true; }
  void Release(const std::function<void()>& then);

  void set_store_lead(StoreLead lead) { store_lead_ = lead; }

 private:
  template <typename Task>
  auto Keeping(Task task) {
    return
        [keep = session_.lock(), task = std::move(task)]() mutable { task(); };
  }

  void Add(Operation operation);
  // Starts an operation, or answers it.
  void Start(const Operation& operation);
  bool MayStart(Turn turn) const;
  // Whether a read could show what a later one does not.
  bool MustWait(Turn turn) const;
  // Whether memory shows what everybody would see: OK, or the answer instead.
  absl::Status CheckMemory(Turn turn);

  VehicleState* const vehicle_;
  const AppendsInFlight* const appends_;
  const std::shared_ptr<Strand> strand_;
  std::weak_ptr<void> session_;

  // Oldest first.
  std::deque<Operation> waiting_;
  bool pumping_ = false;
  bool held_ = false;
  StoreLead store_lead_ = StoreLead::kNone;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SESSIONS_VEHICLE_QUEUE_H_
