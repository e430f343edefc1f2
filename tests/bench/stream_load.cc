#include "tests/bench/stream_load.h"

#include <grpcpp/grpcpp.h>

#include <cmath>
#include <condition_variable>
#include <deque>

#include "revisit/v1/pose_graph_service.grpc.pb.h"
#include "tests/bench/child_process.h"

namespace revisit::bench {
namespace {

using Clock = std::chrono::steady_clock;

constexpr double kRadius = 200.0;
constexpr double kLapSpacing = 2.0;

// All poses of the load have this in common, after so many metres of way.
void SetPlace(std::uint64_t sequence, double along, double x, double y,
              double heading, v1::Pose* pose) {
  pose->set_sequence(sequence);
  pose->mutable_stamp()->set_seconds(1'700'000'000 +
                                     static_cast<std::int64_t>(sequence / 10));
  pose->mutable_stamp()->set_nanos(
      static_cast<std::int32_t>(sequence % 10) * 100'000'000 + 1);
  pose->mutable_local()->set_x_meters(x);
  pose->mutable_local()->set_y_meters(y);
  pose->mutable_local()->set_z_meters(0.25);
  pose->set_heading_radians(heading);
  v1::Covariance* covariance = pose->mutable_covariance();
  covariance->set_form(v1::COVARIANCE_FORM_PLANAR_6);
  covariance->mutable_values()->Resize(6, 0.0);
  double* values = covariance->mutable_values()->mutable_data();
  values[0] = 0.01 + 1e-4 * along;
  values[1] = 1e-4;
  values[2] = 1e-5;
  values[3] = 0.01 + 1e-4 * along;
  values[4] = 1e-5;
  values[5] = 1e-4 + 1e-7 * along;
}

}  // namespace

std::shared_ptr<grpc::Channel> NewChannel(const std::string& address) {
  grpc::ChannelArguments arguments;
  arguments.SetInt(GRPC_ARG_USE_LOCAL_SUBCHANNEL_POOL, 1);
  return grpc::CreateCustomChannel(address, grpc::InsecureChannelCredentials(),
                                   arguments);
}

void CreateVehicle(const std::shared_ptr<grpc::Channel>& channel,
                   const std::string& id, const v1::VehicleSettings& settings) {
  const auto stub = v1::PoseGraphService::NewStub(channel);
  grpc::ClientContext context;
  v1::CreateVehicleRequest request;
  request.set_vehicle_id(id);
  *request.mutable_vehicle()->mutable_settings() = settings;
  v1::CreateVehicleResponse response;
  const grpc::Status status = stub->CreateVehicle(&context, request, &response);
  if (!status.ok()) Die("CreateVehicle: " + status.error_message());
}

void SetPose(std::uint64_t sequence, v1::Pose* pose) {
  const double along = static_cast<double>(sequence);
  const double angle = along / kRadius;
  // A snake of half circles.
  const double turn = std::fmod(angle, 2.0 * M_PI);
  const double heading = turn < M_PI ? turn : 2.0 * M_PI - turn;
  SetPlace(sequence, along, kRadius * std::sin(heading), along, heading, pose);
}

void SetLapPose(std::uint64_t sequence, v1::Pose* pose) {
  constexpr double kLapRadius = kLapPoses * kLapSpacing / (2.0 * M_PI);
  const double along = kLapSpacing * static_cast<double>(sequence);
  const double angle = along / kLapRadius;
  SetPlace(sequence, along, kLapRadius * std::cos(angle),
           kLapRadius * std::sin(angle),
           std::remainder(angle + M_PI / 2.0, 2.0 * M_PI), pose);
}

class StreamLoad::Reactor final
    : public grpc::ClientBidiReactor<v1::StreamPosesRequest,
                                     v1::StreamPosesResponse> {
 public:
  Reactor(const std::shared_ptr<grpc::Channel>& channel,
          const std::string& vehicle, const LoadOptions& options)
      : options_(options), stub_(v1::PoseGraphService::NewStub(channel)) {
    stub_->async()->StreamPoses(&context_, this);
    request_.mutable_open()->set_vehicle(vehicle);
    writing_ = true;
    AddHold();
    StartWrite(&request_);
    StartRead(&response_);
    StartCall();
    std::unique_lock<std::mutex> lock(mutex_);
    changed_.wait(lock, [this] { return opened_ || done_; });
    if (done_) Die("StreamPoses: " + status_.error_message());
  }

  void OnReadDone(bool ok) override {
    if (!ok) return;
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      if (response_.has_opened()) {
        opened_ = true;
        sent_ = acked_ = response_.opened().durable_sequence();
        first_ = sent_;
        changed_.notify_all();
      } else if (response_.has_ack()) {
        acked_ = response_.ack().durable_sequence();
        const Clock::time_point now = Clock::now();
        while (!in_flight_.empty() && in_flight_.front().last <= acked_) {
          latencies_.push_back(
              std::chrono::duration<double>(now - in_flight_.front().start)
                  .count());
          in_flight_.pop_front();
        }
        Send();
        if (in_flight_.empty()) changed_.notify_all();
      }
    }
    StartRead(&response_);
  }

  void OnWriteDone(bool) override {
    const std::lock_guard<std::mutex> lock(mutex_);
    writing_ = false;
    Send();
  }

  void OnDone(const grpc::Status& status) override {
    const std::lock_guard<std::mutex> lock(mutex_);
    status_ = status;
    done_ = true;
    changed_.notify_all();
  }

  void Start() {
    const std::lock_guard<std::mutex> lock(mutex_);
    sending_ = true;
    Send();
  }

  void Send(Clock::time_point due) {
    const std::lock_guard<std::mutex> lock(mutex_);
    due_.push_back(due);
    Send();
  }

  void WaitUntilAcked() {
    std::unique_lock<std::mutex> lock(mutex_);
    changed_.wait(
        lock, [this] { return done_ || (due_.empty() && in_flight_.empty()); });
    if (done_) Die("StreamPoses: " + status_.error_message());
  }

  void StopSending() {
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      if (stopped_) return;
      stopped_ = true;
      sending_ = false;
      Send();
    }
    RemoveHold();
  }

  void Stop() {
    StopSending();
    std::unique_lock<std::mutex> lock(mutex_);
    changed_.wait(lock, [this] { return done_; });
    if (!status_.ok()) Die("StreamPoses: " + status_.error_message());
    if (acked_ != sent_) Die("StreamPoses ended with poses not acknowledged");
  }

  std::uint64_t acked_poses() const {
    const std::lock_guard<std::mutex> lock(mutex_);
    return acked_ - first_;
  }

  std::vector<double> TakeLatencies() {
    const std::lock_guard<std::mutex> lock(mutex_);
    std::vector<double> taken;
    taken.swap(latencies_);
    return taken;
  }

 private:
  struct InFlight {
    std::uint64_t last;
    Clock::time_point start;
  };

  // Starts what can be written, if anything. With the mutex held.
  void Send() {
    if (writing_ || closed_) return;
    if (stopped_) {
      closed_ = true;
      StartWritesDone();
      return;
    }
    const auto batch = static_cast<std::uint64_t>(options_.batch_poses);
    if ((!sending_ && due_.empty()) ||
        static_cast<int>(in_flight_.size()) >= options_.window_batches ||
        (!in_flight_.empty() &&
         sent_ + batch - acked_ >
             static_cast<std::uint64_t>(options_.window_poses))) {
      return;
    }
    if (options_.as_columns) {
      FillColumns();
    } else {
      auto* poses = request_.mutable_batch()->mutable_poses();
      while (poses->size() < options_.batch_poses) poses->Add();
      for (v1::Pose& pose : *poses) options_.set_pose(++sent_, &pose);
    }
    in_flight_.push_back({sent_, due_.empty() ? Clock::now() : due_.front()});
    if (!due_.empty()) due_.pop_front();
    writing_ = true;
    StartWrite(&request_);
  }

  void FillColumns() {
    v1::PoseColumns& columns = *request_.mutable_batch()->mutable_columns();
    columns.Clear();
    columns.set_first_sequence(sent_ + 1);
    columns.set_pose_count(options_.batch_poses);
    std::int64_t before_ns = 0;
    for (int i = 0; i < options_.batch_poses; ++i) {
      options_.set_pose(++sent_, &pose_);
      const std::int64_t stamp_ns =
          pose_.stamp().seconds() * 1'000'000'000 + pose_.stamp().nanos();
      if (i == 0) {
        *columns.mutable_first_stamp() = pose_.stamp();
        columns.set_covariance_form(pose_.covariance().form());
      } else {
        columns.add_stamp_step_nanos(stamp_ns - before_ns);
      }
      before_ns = stamp_ns;
      columns.add_x_meters(pose_.local().x_meters());
      columns.add_y_meters(pose_.local().y_meters());
      columns.add_z_meters(pose_.local().z_meters());
      columns.add_heading_radians(pose_.heading_radians());
      columns.mutable_covariances()->MergeFrom(pose_.covariance().values());
    }
  }

  const LoadOptions options_;
  const std::unique_ptr<v1::PoseGraphService::Stub> stub_;
  grpc::ClientContext context_;
  v1::StreamPosesRequest request_;
  // The last one of those that were made columns.
  v1::Pose pose_;
  v1::StreamPosesResponse response_;

  mutable std::mutex mutex_;
  std::condition_variable changed_;
  bool opened_ = false;
  bool sending_ = false;
  bool writing_ = false;
  bool stopped_ = false;
  bool closed_ = false;
  bool done_ = false;
  std::uint64_t first_ = 0;
  std::uint64_t sent_ = 0;
  std::uint64_t acked_ = 0;
  // When each batch that Send() was called for was due, and is not sent yet.
  std::deque<Clock::time_point> due_;
  std::deque<InFlight> in_flight_;
  std::vector<double> latencies_;
  grpc::Status status_;
};

StreamLoad::StreamLoad(const std::shared_ptr<grpc::Channel>& channel,
                       const std::string& vehicle, const LoadOptions& options)
    : reactor_(std::make_unique<Reactor>(channel, vehicle, options)) {}

StreamLoad::~StreamLoad() { Stop(); }

void StreamLoad::Start() { reactor_->Start(); }

void StreamLoad::Send(Clock::time_point due) { reactor_->Send(due); }

void StreamLoad::WaitUntilAcked() { reactor_->WaitUntilAcked(); }

void StreamLoad::StopSending() { reactor_->StopSending(); }

void StreamLoad::Stop() { reactor_->Stop(); }

std::uint64_t StreamLoad::acked_poses() const {
  return reactor_->acked_poses();
}

std::vector<double> StreamLoad::TakeLatencies() {
  return reactor_->TakeLatencies();
}

void Upload(const std::shared_ptr<grpc::Channel>& channel,
            const std::string& vehicle, const std::vector<v1::Pose>& poses) {
  constexpr std::size_t kBatch = 1024;
  const auto stub = v1::PoseGraphService::NewStub(channel);
  v1::AppendPosesRequest request;
  for (std::size_t first = 0; first < poses.size(); first += kBatch) {
    request.set_vehicle(vehicle);
    request.clear_poses();
    const std::size_t end = std::min(poses.size(), first + kBatch);
    for (std::size_t i = first; i < end; ++i) *request.add_poses() = poses[i];
    grpc::ClientContext context;
    v1::AppendPosesResponse response;
    const grpc::Status status = stub->AppendPoses(&context, request, &response);
    if (!status.ok()) Die("AppendPoses: " + status.error_message());
  }
}

}  // namespace revisit::bench
