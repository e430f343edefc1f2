// The life of a call's reactor, whatever its messages are: who owns it, what
// tells it to end, and that it ends once.
#ifndef REVISIT_SERVER_SERVICE_CALL_REACTOR_H_
#define REVISIT_SERVER_SERVICE_CALL_REACTOR_H_

#include <chrono>
#include <memory>
#include <utility>

#include "absl/status/status.h"
#include "core/base/mutex.h"
#include "grpcpp/alarm.h"
#include "grpcpp/server_context.h"
#include "server/connections/drain.h"
#include "server/service/call.h"
#include "server/service/service_context.h"

namespace revisit::server {

// A call of the class `Self`, which derives from this, on a reactor of gRPC.
//
// Lifetime: gRPC may destroy its side as soon as OnDone() has run, and sessions
// call back from their own threads at any time. So the call is held by a
// shared_ptr: one of its own, dropped in OnDone(), and one in every callback
// given to a session. A callback that comes after the end finds `ended_`, and
// touches only the call's own members.
//
// An operation of gRPC is started before the end or not at all.
template <typename Self, typename Reactor>
class CallReactor : public Reactor,
                    public Call,
                    public std::enable_shared_from_this<Self> {
 public:
  // All that the service refers to must outlive this.
  CallReactor(grpc::CallbackServerContext* context, const char* method,
              const ServiceContext& service)
      : Call(context, method, service),
        grpc_context_(context),
        drain_(service.drain) {}

  // Begins the call, or ends it if it is not let in. Call once, before gRPC
  // gets the reactor. REQUIRES: a shared_ptr owns it.
  void Start() {
    self_ = this->shared_from_this();
    if (needs_store()) WatchDrain();
    if (entry().ok()) {
      OnStart();
    } else {
      End(entry());
    }
  }

  // Ends the call with this status, unless it has ended: then nobody hears the
  // status. On any thread.
  void End(const absl::Status& status) ABSL_LOCKS_EXCLUDED(mutex_) {
    const MutexLock lock(&mutex_);
    EndLocked(status);
  }

  void OnCancel() final {
    MarkGivenUp();
    const MutexLock lock(&mutex_);
    if (!ended_) OnGivenUp();
  }

  void OnDone() final {
    drain_->Unwatch(drain_watch_);
    Leave();
    // May destroy this.
    const std::shared_ptr<Self> self = std::move(self_);
  }

 protected:
  using Reaction = void (Self::*)();

  // End() for those who hold the mutex.
  void EndLocked(const absl::Status& status)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    if (ended_) return;
    ended_ = true;
    OnEnd(status);
    this->Finish(Conclude(status));
  }

  // Has OnRightsLost() called once the caller has lost the right to the call.
  // For a call that may wait long for its caller.
  void WatchRights() {
    rights().Watch([weak = this->weak_from_this()] {
      if (const auto self = weak.lock()) self->CheckRights();
    });
  }

  // Calls `then`, which needs the mutex, once the duration has passed, unless
  // the call has ended or the alarm was destroyed by then.
  std::unique_ptr<grpc::Alarm> AlarmAfter(
      std::chrono::steady_clock::duration duration, Reaction then) {
    auto alarm = std::make_unique<grpc::Alarm>();
    alarm->Set(std::chrono::system_clock::now() + duration,
               [weak = this->weak_from_this(), then](bool has_come) {
                 const auto self = weak.lock();
                 if (has_come && self != nullptr) self->React(then);
               });
    return alarm;
  }

  // The call was let in. It may end at any time from here on, and may have
  // ended.
  virtual void OnStart() = 0;

  // All others are called as long as the call has not ended.

  // The call is to end as Drain::Watch() says.
  virtual void OnDrain(const Drain::End& end)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) = 0;
  // The caller has lost the right to the call, for this reason.
  virtual void OnRightsLost(const absl::Status& reason)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    EndLocked(reason);
  }
  // The caller's rights may be others than before, but they still have that to
  // the call.
  virtual void OnRightsKept() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {}
  // The caller waits for nothing any more.
  virtual void OnGivenUp() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {}
  // The call ends with this status: makes the response if that is OK, and gives
  // back what the call holds.
  virtual void OnEnd(const absl::Status& /*status*/)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {}

  // Must not be used after OnDone().
  grpc::CallbackServerContext* const grpc_context_;

  Mutex mutex_;
  bool ended_ ABSL_GUARDED_BY(mutex_) = false;

 private:
  void WatchDrain() {
    drain_watch_ =
        drain_->Watch([weak = this->weak_from_this()](const Drain::End& end) {
          if (const auto self = weak.lock()) self->Heed(end);
        });
  }

  void Heed(const Drain::End& end) {
    const MutexLock lock(&mutex_);
    if (!ended_) OnDrain(end);
  }

  void CheckRights() {
    const MutexLock lock(&mutex_);
    if (ended_) return;
    const absl::Status status = rights().Recheck();
    if (status.ok()) {
      OnRightsKept();
    } else {
      OnRightsLost(status);
    }
  }

  void React(Reaction reaction) {
    const MutexLock lock(&mutex_);
    if (!ended_) (static_cast<Self*>(this)->*reaction)();
  }

  Drain* const drain_;
  Drain::WatchId drain_watch_ = -1;
  std::shared_ptr<Self> self_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SERVICE_CALL_REACTOR_H_
