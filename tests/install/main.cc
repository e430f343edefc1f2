// usage: example ADDRESS VEHICLE: creates a vehicle, streams ten poses into it,
// and prints how many are durable.
#include <cstdint>
#include <iostream>

#include "client/revisit/channel.h"
#include "client/revisit/client.h"
#include "client/revisit/pose_stream.h"
#include "client/revisit/status.h"
#include "grpcpp/channel.h"

namespace {

int Fail(const absl::Status& status) {
  std::cerr << revisit::client::Describe(status) << '\n';
  return 1;
}

revisit::v1::PoseBatch StraightRoad() {
  revisit::v1::PoseBatch batch;
  for (int i = 1; i <= 10; ++i) {
    revisit::v1::Pose* pose = batch.add_poses();
    pose->set_sequence(static_cast<std::uint64_t>(i));
    pose->mutable_local()->set_x_meters(i);
    pose->set_heading_radians(0.0);
    revisit::v1::Covariance* covariance = pose->mutable_covariance();
    covariance->set_form(revisit::v1::COVARIANCE_FORM_PLANAR_6);
    for (const double value : {0.01 * i, 0.0, 0.0, 0.01 * i, 0.0, 1e-4 * i}) {
      covariance->add_values(value);
    }
  }
  return batch;
}

}  // namespace

int main(int argc, char** argv) {
  if (argc != 3) return 64;
  const auto channel = revisit::client::MakeChannel({argv[1]});
  if (!channel.ok()) return Fail(channel.status());
  revisit::v1::CreateVehicleRequest request;
  request.set_vehicle_id(argv[2]);
  const auto created = revisit::client::Client(*channel).CreateVehicle(request);
  if (!created.ok()) return Fail(created.status());
  revisit::client::PoseStream stream(*channel, created->vehicle().name(), {},
                                     {});
  if (const auto status = stream.Append(StraightRoad()); !status.ok()) {
    return Fail(status);
  }
  if (const auto status = stream.Finish(); !status.ok()) return Fail(status);
  std::cout << stream.acked_sequence() << '\n';
  return 0;
}
