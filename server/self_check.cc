#include "server/self_check.h"

#include <grpcpp/client_context.h>
#include <grpcpp/generic/generic_stub.h>
#include <grpcpp/support/byte_buffer.h>
#include <grpcpp/support/slice.h>

#include <utility>

#include "core/base/mutex.h"

namespace revisit::server {
namespace {

// Shared by the asker and by those who answer, who may come after it has gone.
struct Questions {
  grpc::ClientContext context;
  grpc::ByteBuffer request;
  grpc::ByteBuffer response;
  Mutex mutex;
  CondVar answered;
  int open ABSL_GUARDED_BY(mutex) = 2;

  void AnswerOne() {
    const MutexLock lock(&mutex);
    --open;
    answered.NotifyOne();
  }

  bool WaitUntil(std::chrono::steady_clock::time_point deadline) {
    const MutexLock lock(&mutex);
    while (open > 0) {
      if (answered.WaitUntil(&mutex, deadline)) break;
    }
    return open == 0;
  }
};

}  // namespace

SelfCheck::SelfCheck(std::shared_ptr<grpc::Channel> channel, Executor* executor)
    : channel_(std::move(channel)), executor_(executor) {}

bool SelfCheck::Answers(std::chrono::milliseconds patience) {
  const auto deadline = std::chrono::steady_clock::now() + patience;
  const auto questions = std::make_shared<Questions>();
  // An empty message asks for the health of the whole server.
  const grpc::Slice empty;
  questions->request = grpc::ByteBuffer(&empty, 1);
  grpc::GenericStub(channel_).UnaryCall(
      &questions->context, "/grpc.health.v1.Health/Check", grpc::StubOptions(),
      &questions->request, &questions->response,
      [questions](const grpc::Status&) { questions->AnswerOne(); });
  executor_->Post([questions] { questions->AnswerOne(); });
  const bool answered = questions->WaitUntil(deadline);
  if (!answered) questions->context.TryCancel();
  return answered;
}

}  // namespace revisit::server
