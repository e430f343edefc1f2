// A client that streams poses as fast as its window allows, or as it is told
// to, and measures.
#ifndef REVISIT_TESTS_BENCH_STREAM_LOAD_H_
#define REVISIT_TESTS_BENCH_STREAM_LOAD_H_

#include <grpcpp/channel.h>

#include <chrono>
#include <cstdint>
#include <memory>
#include <mutex>
#include <string>
#include <vector>

#include "revisit/v1/geometry.pb.h"
#include "revisit/v1/vehicle.pb.h"

namespace revisit::bench {

// Makes the pose of this sequence of a vehicle that drives on at 1 m a pose, in
// curves, with stamps and PLANAR_6 covariances.
void SetPose(std::uint64_t sequence, v1::Pose* pose);

// The same for a vehicle that drives the same lap again and again, 2 m a pose.
inline constexpr int kLapPoses = 200;
void SetLapPose(std::uint64_t sequence, v1::Pose* pose);

struct LoadOptions {
  int batch_poses = 64;
  void (*set_pose)(std::uint64_t, v1::Pose*) = SetPose;
  // Whether batches are PoseColumns rather than messages Pose.
  bool as_columns = false;
  // A batch is sent once fewer than this many poses, and batches, are not
  // acknowledged.
  int window_poses = 4096;
  int window_batches = 1024;
};

// One stream of one vehicle, whose poses have about 115 bytes each.
class StreamLoad {
 public:
  // Opens the stream and waits until it is open.
  StreamLoad(const std::shared_ptr<grpc::Channel>& channel,
             const std::string& vehicle, const LoadOptions& options);
  // As Stop().
  ~StreamLoad();

  StreamLoad(const StreamLoad&) = delete;
  StreamLoad& operator=(const StreamLoad&) = delete;

  // Sends from now on.
  void Start();
  // Sends a batch that was due then, as soon as the window allows.
  void Send(std::chrono::steady_clock::time_point due);
  // Waits until all that Send() was called for is acknowledged.
  void WaitUntilAcked();
  // Sends no more. Whoever stops many does so first of all of them, so that
  // none waits behind what others still send.
  void StopSending();
  // Sends no more, and waits until all is acknowledged and the stream closed.
  void Stop();

  std::uint64_t acked_poses() const;
  // From the call that sends a batch, or from when it was due, to its
  // acknowledgement; cleared by the call. Seconds.
  std::vector<double> TakeLatencies();

 private:
  class Reactor;
  std::unique_ptr<Reactor> reactor_;
};

// Sends the poses given, and waits until they are durable.
void Upload(const std::shared_ptr<grpc::Channel>& channel,
            const std::string& vehicle, const std::vector<v1::Pose>& poses);

// One that shares its connection with no other.
std::shared_ptr<grpc::Channel> NewChannel(const std::string& address);

void CreateVehicle(const std::shared_ptr<grpc::Channel>& channel,
                   const std::string& id,
                   const v1::VehicleSettings& settings = {});

}  // namespace revisit::bench

#endif  // REVISIT_TESTS_BENCH_STREAM_LOAD_H_
