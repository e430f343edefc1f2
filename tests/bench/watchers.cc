#include "tests/bench/watchers.h"

#include <grpcpp/grpcpp.h>

#include <atomic>
#include <condition_variable>
#include <mutex>

#include "revisit/v1/pose_graph_service.grpc.pb.h"
#include "tests/bench/child_process.h"
#include "tests/bench/stream_load.h"

namespace revisit::bench {

// A watch runs on gRPC's own threads, so that many need no threads of their
// own.
class Watchers::Reactor final
    : public grpc::ClientReadReactor<v1::WatchCandidatesResponse> {
 public:
  Reactor(const std::shared_ptr<grpc::Channel>& channel,
          const v1::WatchCandidatesRequest& request)
      : request_(request), stub_(v1::PoseGraphService::NewStub(channel)) {
    stub_->async()->WatchCandidates(&context_, &request_, this);
    StartRead(&response_);
    StartCall();
  }

  void OnReadDone(bool ok) override {
    if (!ok) return;
    if (response_.has_candidate()) ++told_;
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      began_ = true;
      changed_.notify_all();
    }
    StartRead(&response_);
  }

  void OnDone(const grpc::Status& status) override {
    const std::lock_guard<std::mutex> lock(mutex_);
    if (!cancelled_) Die("WatchCandidates: " + status.error_message());
    done_ = true;
    changed_.notify_all();
  }

  void WaitUntilBegun() {
    std::unique_lock<std::mutex> lock(mutex_);
    changed_.wait(lock, [this] { return began_; });
  }

  void Cancel() {
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      cancelled_ = true;
    }
    context_.TryCancel();
  }

  void WaitUntilDone() {
    std::unique_lock<std::mutex> lock(mutex_);
    changed_.wait(lock, [this] { return done_; });
  }

  std::uint64_t told() const { return told_; }

 private:
  const v1::WatchCandidatesRequest request_;
  const std::unique_ptr<v1::PoseGraphService::Stub> stub_;
  grpc::ClientContext context_;
  v1::WatchCandidatesResponse response_;
  std::atomic<std::uint64_t> told_{0};

  std::mutex mutex_;
  std::condition_variable changed_;
  bool began_ = false;
  bool cancelled_ = false;
  bool done_ = false;
};

Watchers::Watchers(const std::string& address,
                   const std::vector<v1::WatchCandidatesRequest>& requests,
                   int a_connection) {
  std::shared_ptr<grpc::Channel> channel;
  for (const v1::WatchCandidatesRequest& request : requests) {
    if (reactors_.size() % static_cast<std::size_t>(a_connection) == 0) {
      channel = NewChannel(address);
    }
    reactors_.push_back(std::make_unique<Reactor>(channel, request));
  }
  for (const auto& one : reactors_) one->WaitUntilBegun();
}

Watchers::~Watchers() {
  for (const auto& one : reactors_) one->Cancel();
  for (const auto& one : reactors_) one->WaitUntilDone();
}

std::uint64_t Watchers::told() const {
  std::uint64_t sum = 0;
  for (const auto& one : reactors_) sum += one->told();
  return sum;
}

}  // namespace revisit::bench
