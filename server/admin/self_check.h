// Whether a server that runs still answers: what it asks itself for a watchdog
// and for the probes of an orchestrator.
#ifndef REVISIT_SERVER_ADMIN_SELF_CHECK_H_
#define REVISIT_SERVER_ADMIN_SELF_CHECK_H_

#include <chrono>
#include <memory>

#include "grpcpp/channel.h"
#include "server/sessions/executor.h"

namespace revisit::server {

// Not thread-safe.
class SelfCheck {
 public:
  // `channel` leads to the server itself, in the process. The executor, which
  // must outlive this, is the one of the vehicles' short work: what takes long
  // may wait behind other work without anything being wrong.
  SelfCheck(std::shared_ptr<grpc::Channel> channel, Executor* executor);

  // Whether both a call of the health service is answered, through the threads
  // of gRPC that answer all calls, and a task gets a thread of the executor,
  // within `patience`. Any answer will do, NOT_SERVING and UNIMPLEMENTED too: a
  // server that refuses works, and to restart it would help nobody.
  bool Answers(std::chrono::milliseconds patience);

  // The same for who may not wait. Asks, unless a question of an earlier call
  // is open, and returns for how long that one has been; zero if none is.
  std::chrono::milliseconds Silence();

  ~SelfCheck();

 private:
  struct Questions;

  std::shared_ptr<Questions> Ask();

  const std::shared_ptr<grpc::Channel> channel_;
  Executor* const executor_;
  // The questions of the last Silence() that asked; null if none did.
  std::shared_ptr<Questions> asked_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_ADMIN_SELF_CHECK_H_
