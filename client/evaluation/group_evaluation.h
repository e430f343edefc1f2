// Two drives as vehicles of one group, and what one finds in the other.
#ifndef REVISIT_CLIENT_EVALUATION_GROUP_EVALUATION_H_
#define REVISIT_CLIENT_EVALUATION_GROUP_EVALUATION_H_

#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "client/evaluation/evaluation.h"
#include "client/formats/drive_file.h"
#include "client/revisit/client.h"
#include "client/terminal/terminal.h"
#include "client/trajectory/dead_reckoning.h"
#include "revisit/v1/vehicle.pb.h"

namespace grpc {
class Channel;
}

namespace revisit::client {

struct GroupRun {
  std::string group_id;
  // The settings of both vehicles, whose ids are the names of their drives.
  v1::VehicleSettings settings;
  UncertaintyOptions uncertainty;
  Judging judging;
};

struct GroupResult {
  // How far the asking drive went until its first accepted candidate that is
  // right was linked; absent where there was none.
  std::optional<double> linked_after_meters;
  // The checks behind that one without the link, or all where there is none.
  std::vector<JudgedCheck> before;
  // The same checks with the link; none where there is none.
  std::vector<JudgedCheck> after;
};

// Streams both drives, which have truth, into new vehicles of a new group, in
// which nothing ties their frames. Then the asking one is asked, at each of its
// checks, where in the known one it is. The first accepted candidate that is
// right becomes a loop closure between the vehicles, without a measurement, and
// the checks behind it are asked again. DEADLINE_EXCEEDED if searches do not
// see the group's changes.
absl::StatusOr<GroupResult> EvaluateGroup(
    const std::shared_ptr<grpc::Channel>& channel, const Client& client,
    const Drive& known, const Drive& asking, const GroupRun& run,
    const Terminal& terminal);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_EVALUATION_GROUP_EVALUATION_H_
