// A client that streams poses as fast as its window allows, and measures.
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

namespace revisit::bench {

struct LoadOptions {
  int batch_poses = 64;
  // A batch is sent once fewer than this many poses, and batches, are not
  // acknowledged.
  int window_poses = 4096;
  int window_batches = 1024;
};

// One stream of one vehicle. The poses are of a vehicle that drives on at 1 m a
// pose, in curves, with stamps and PLANAR_6 covariances: about 115 bytes each.
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
  // Sends no more, and waits until all is acknowledged and the stream closed.
  void Stop();

  std::uint64_t acked_poses() const;
  // From the call that sends a batch to its acknowledgement; cleared by the
  // call. Seconds.
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
                   const std::string& id);

// A pose of the load, of this sequence.
void SetPose(std::uint64_t sequence, v1::Pose* pose);

}  // namespace revisit::bench

#endif  // REVISIT_TESTS_BENCH_STREAM_LOAD_H_
