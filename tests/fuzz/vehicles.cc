#include "tests/fuzz/vehicles.h"

#include <cmath>
#include <cstddef>
#include <optional>

#include "core/drive/drive.h"
#include "core/geometry/pose.h"
#include "core/search/search.h"
#include "core/settings.h"
#include "server/base/status.h"
#include "server/base/status_grpc.h"

namespace revisit::fuzz {
namespace {

// gRPC's peers take 8 KiB of trailers, and details travel in base64.
constexpr std::size_t kMostDetailBytes = 6000;

constexpr double kMostNodes = 5000.0;

}  // namespace

server::VehicleConfig VehicleOfKind(int kind) {
  server::VehicleConfig config;
  config.create_time_ns = 1;
  config.drive.search.sequence_length_meters = 20.0;
  config.drive.check_interval_meters = 10.0;
  if ((kind & 1) != 0) {
    config.drive.state_space = core::StateSpace::kSpatial;
  }
  if ((kind & 2) != 0) {
    config.frame = server::CoordinateFrame::kGeodetic;
    // Some have an origin, some take that of the first pose.
    if ((kind & 1) != 0) config.origin = {43.8, -79.5, 150.0};
  }
  if ((kind & 4) != 0) {
    config.drive.search.correlation_model = core::CorrelationModel::kFilter;
  }
  return config;
}

void RequireGoodError(const absl::Status& status) {
  if (status.ok()) return;
  Require(!server::ReasonOf(status).empty(), "an error has a reason");
  Require(!status.message().empty(), "an error has words");
  const grpc::Status answer = server::ToGrpcStatus(status);
  Require(answer.error_details().size() <= kMostDetailBytes,
          "an error fits a trailer");
}

void Drive(const server::VehicleConfig& config,
           const std::vector<core::PoseSample>& samples) {
  if (!core::FindProblems(config.drive).empty()) return;
  double meters = 0.0;
  for (std::size_t i = 1; i < samples.size(); ++i) {
    const core::Pose& a = samples[i - 1].pose;
    const core::Pose& b = samples[i].pose;
    meters += std::hypot(b.x - a.x, b.y - a.y, b.z - a.z);
  }
  if (!(meters / config.drive.node_spacing_meters <= kMostNodes)) return;
  // A batch may go on where another ended; a drive starts at 1.
  std::vector<core::PoseSample> numbered = samples;
  for (std::size_t i = 0; i < numbered.size(); ++i) {
    numbered[i].sequence = i + 1;
  }
  core::Drive drive(config.drive);
  const core::AppendResult applied = drive.Append(numbered, 1);
  Require(drive.last_sequence() == numbered.size(), "all poses are appended");
  int searches = 0;
  for (const core::NodeIndex node : applied.checks_due) {
    if (++searches > 3) break;
    const auto found =
        core::Search(&drive).At(node, config.drive.search, nullptr);
    Require(found.ok(), "a search that is not stopped answers");
    for (const core::Candidate& candidate : found->candidates) {
      Require(!std::isnan(candidate.score), "a score is a number");
      if (!candidate.relative) continue;
      const double probability = candidate.relative->probability;
      Require(probability >= 0.0 && probability <= 1.0 + 1e-9,
              "a probability is one");
    }
  }
}

}  // namespace revisit::fuzz
