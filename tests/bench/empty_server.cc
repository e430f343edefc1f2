#include "tests/bench/empty_server.h"

#include <grpc/impl/codegen/grpc_types.h>
#include <grpcpp/grpcpp.h>
#include <pthread.h>
#include <signal.h>

#include <chrono>
#include <cstdint>
#include <cstdio>
#include <memory>
#include <mutex>
#include <string>

#include "revisit/v1/pose_graph_service.grpc.pb.h"

namespace revisit::bench {
namespace {

// Reads on whether its answers are written or not: the client limits itself.
class EmptyStream final
    : public grpc::ServerBidiReactor<v1::StreamPosesRequest,
                                     v1::StreamPosesResponse> {
 public:
  EmptyStream() { StartRead(&request_); }

  void OnReadDone(bool ok) override {
    std::unique_lock<std::mutex> lock(mutex_);
    if (!ok) {
      done_reading_ = true;
      Write();
      return;
    }
    if (request_.has_batch()) {
      const v1::PoseBatch& batch = request_.batch();
      const v1::PoseColumns& columns = batch.columns();
      durable_ = batch.has_columns()
                     ? columns.first_sequence() +
                           static_cast<std::uint64_t>(columns.pose_count()) - 1
                     : batch.poses(batch.poses_size() - 1).sequence();
    }
    ++unanswered_;
    Write();
    StartRead(&request_);
  }

  void OnWriteDone(bool) override {
    const std::lock_guard<std::mutex> lock(mutex_);
    writing_ = false;
    Write();
  }

  void OnDone() override { delete this; }

 private:
  // With the mutex held.
  void Write() {
    if (writing_ || finished_) return;
    if (unanswered_ == 0) {
      if (done_reading_) {
        finished_ = true;
        Finish(grpc::Status::OK);
      }
      return;
    }
    writing_ = true;
    --unanswered_;
    if (!opened_) {
      opened_ = true;
      response_.mutable_opened();
    } else {
      response_.mutable_ack()->set_durable_sequence(durable_);
      response_.mutable_ack()->set_revision(++revision_);
    }
    grpc::WriteOptions options;
    if (unanswered_ > 0) options.set_buffer_hint();
    StartWrite(&response_, options);
  }

  v1::StreamPosesRequest request_;
  v1::StreamPosesResponse response_;
  std::mutex mutex_;
  int unanswered_ = 0;
  std::uint64_t durable_ = 0;
  std::uint64_t revision_ = 0;
  bool opened_ = false;
  bool writing_ = false;
  bool done_reading_ = false;
  bool finished_ = false;
};

class EmptyService final : public v1::PoseGraphService::CallbackService {
 public:
  grpc::ServerBidiReactor<v1::StreamPosesRequest, v1::StreamPosesResponse>*
  StreamPoses(grpc::CallbackServerContext*) override {
    return new EmptyStream;
  }

  grpc::ServerUnaryReactor* FindCandidates(
      grpc::CallbackServerContext* context, const v1::FindCandidatesRequest*,
      v1::FindCandidatesResponse*) override {
    return Answer(context);
  }

  grpc::ServerUnaryReactor* GetServerInfo(grpc::CallbackServerContext* context,
                                          const v1::GetServerInfoRequest*,
                                          v1::GetServerInfoResponse*) override {
    return Answer(context);
  }

 private:
  static grpc::ServerUnaryReactor* Answer(
      grpc::CallbackServerContext* context) {
    grpc::ServerUnaryReactor* reactor = context->DefaultReactor();
    reactor->Finish(grpc::Status::OK);
    return reactor;
  }
};

}  // namespace

int RunEmptyServer() {
  sigset_t signals;
  sigemptyset(&signals);
  sigaddset(&signals, SIGTERM);
  pthread_sigmask(SIG_BLOCK, &signals, nullptr);
  EmptyService service;
  grpc::ServerBuilder builder;
  int port = 0;
  builder.AddListeningPort("127.0.0.1:0", grpc::InsecureServerCredentials(),
                           &port);
  builder.RegisterService(&service);
  const std::unique_ptr<grpc::Server> server = builder.BuildAndStart();
  if (server == nullptr) return 1;
  std::printf("listening on 127.0.0.1:%d\n", port);
  std::fflush(stdout);
  int signal_number = 0;
  sigwait(&signals, &signal_number);
  server->Shutdown(std::chrono::system_clock::now());
  return 0;
}

}  // namespace revisit::bench
