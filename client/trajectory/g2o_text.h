// A pose graph in the format of g2o, which GTSAM, Ceres and SE-Sync read too.
#ifndef REVISIT_CLIENT_TRAJECTORY_G2O_TEXT_H_
#define REVISIT_CLIENT_TRAJECTORY_G2O_TEXT_H_

#include <cstdint>
#include <map>
#include <optional>
#include <ostream>
#include <vector>

#include "client/trajectory/local_pose.h"
#include "client/trajectory/relative_pose.h"
#include "revisit/v1/loop_closure.pb.h"
#include "revisit/v1/vehicle.pb.h"

namespace revisit::client {

// Writes VERTEX_SE2 and EDGE_SE2 for a PLANAR vehicle, VERTEX_SE3:QUAT and
// EDGE_SE3:QUAT for a SPATIAL one. The id of a vertex is the sequence of its
// pose. The error of an edge is in the axes of its later vertex, rotations as
// rotation vectors in radians, as GTSAM and Ceres take them.
class G2oWriter {
 public:
  // The closures must be known before the first pose. All arguments must
  // outlive the writer.
  G2oWriter(const v1::VehicleSettings& settings,
            const std::vector<v1::LoopClosure>& closures, std::ostream* out);

  // Writes the next pose and, behind it, the edge that leads to it: the step
  // between the two poses as they were sent, which is what was measured, with
  // the uncertainty that it was sent with. `as_sent` is the same pose, in the
  // frame of its recording, and says where a recording begins. Such a pose has
  // an edge from the last one of the recording before if the recording begins
  // where that one ended; from the first one of the last recording with a datum
  // if it has one; and otherwise none.
  void Add(const LocalPose& pose, const LocalPose& as_sent);

  // Writes an edge for each closure, from the matched pose to the query pose.
  // REQUIRES: their poses were added.
  void AddClosures();

  struct Counts {
    std::int64_t poses = 0;
    std::int64_t closures = 0;
    std::int64_t unmeasured_closures = 0;
    // Steps longer than max_step_meters, written as all but unknown.
    std::int64_t jumps = 0;
    // Steps over poses that were dropped, written as uncertain as both ends.
    std::int64_t gaps = 0;
    // Recordings that began behind others, and those that no edge but that of
    // a loop closure ties to these.
    std::int64_t recordings = 0;
    std::int64_t untied = 0;
    // Steps whose covariance was raised to the least one.
    std::int64_t raised = 0;
  };
  const Counts& counts() const { return counts_; }

 private:
  void WriteVertex(const LocalPose& pose);
  // `from` and `to` as they were sent.
  void WriteStep(const LocalPose& from, const LocalPose& to);
  // Writes the edges that lead to the first pose of a recording.
  void WriteStart(const LocalPose& to);
  void WriteEdge(const RelativePose& relative, const LocalPose& from,
                 const LocalPose& to);
  bool IsJump(const LocalPose& from, const LocalPose& to) const;

  const v1::VehicleSettings& settings_;
  const bool spatial_;
  const std::vector<v1::LoopClosure>& closures_;
  std::ostream& out_;
  // The poses of the closures, once they were added.
  std::map<std::uint64_t, LocalPose> closed_;
  // The last pose, as it was sent.
  std::optional<LocalPose> last_;
  // The first pose of the last recording with a datum.
  std::optional<LocalPose> last_datum_;
  Counts counts_;
};

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_TRAJECTORY_G2O_TEXT_H_
