#include "server/admin/self_check.h"

#include <grpcpp/client_context.h>
#include <grpcpp/generic/generic_stub.h>
#include <grpcpp/support/byte_buffer.h>
#include <grpcpp/support/slice.h>

#include <utility>

#include "core/base/mutex.h"

namespace revisit::server {

// Shared by the asker and by those who answer, who may come after it has gone.
struct SelfCheck::Questions {
  const std::chrono::steady_clock::time_point asked =
      std::chrono::steady_clock::now();
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

  bool AreAnswered() {
    const MutexLock lock(&mutex);
    return open == 0;
  }
};

SelfCheck::SelfCheck(std::shared_ptr<grpc::Channel> channel, Executor* executor)
    : channel_(std::move(channel)), executor_(executor) {}

SelfCheck::~SelfCheck() {
  if (asked_ != nullptr) asked_->context.TryCancel();
}

bool SelfCheck::Answers(std::chrono::milliseconds patience) {
  const std::shared_ptr<Questions> questions = Ask();
  const bool answered = questions->WaitUntil(questions->asked + patience);
  if (!answered) questions->context.TryCancel();
  return answered;
}

std::chrono::milliseconds SelfCheck::Silence() {
  if (asked_ != nullptr && !asked_->AreAnswered()) {
    return std::chrono::duration_cast<std::chrono::milliseconds>(
        std::chrono::steady_clock::now() - asked_->asked);
  }
  asked_ = Ask();
  return std::chrono::milliseconds(0);
}

std::shared_ptr<SelfCheck::Questions> SelfCheck::Ask() {
  auto questions = std::make_shared<Questions>();
  // An empty message asks for the health of the whole server.
  const grpc::Slice empty;
  questions->request = grpc::ByteBuffer(&empty, 1);
  grpc::GenericStub(channel_).UnaryCall(
      &questions->context, "/grpc.health.v1.Health/Check", grpc::StubOptions(),
      &questions->request, &questions->response,
      [questions](const grpc::Status&) { questions->AnswerOne(); });
  executor_->Post([questions] { questions->AnswerOne(); });
  return questions;
}

}  // namespace revisit::server
