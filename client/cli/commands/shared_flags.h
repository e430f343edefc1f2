// Flags that several commands take.
#ifndef REVISIT_CLIENT_CLI_COMMANDS_SHARED_FLAGS_H_
#define REVISIT_CLIENT_CLI_COMMANDS_SHARED_FLAGS_H_

#include <cstdint>
#include <functional>
#include <string>

#include "absl/status/status.h"
#include "client/cli/flags.h"
#include "client/trajectory/dead_reckoning.h"
#include "revisit/v1/candidate.pb.h"
#include "revisit/v1/check.pb.h"
#include "revisit/v1/pose_graph_service.pb.h"

namespace revisit::client {

// The vehicle of a command: a bare word in its place, or --vehicle.
void AddVehicleName(const Command& command, std::string* vehicle);

// The group of a command: a bare word in its place.
void AddGroupName(const Command& command, std::string* group);

// The revision that the group of a change is expected to have.
void AddExpectedRevision(const Command& command, std::uint64_t* revision);

// Which estimate of a vehicle's poses is meant.
void AddPoseView(const Command& command, v1::PoseView* view);

// Which passes of a place candidates are looked for among.
void AddDirection(const Command& command, v1::CandidateOptions* options);

// Some of the members of a group: calls `add` with the name of each.
Flag AddMembers(const Command& command, const char* help,
                std::function<void(const std::string& vehicle)> add);

// Where else than in the vehicle's own history searches look.
void AddScope(const Command& command, v1::CandidateOptions* options);

// The status, with a hint at --partial where the server still reads histories.
absl::Status WithPartialHint(const absl::Status& status);

// Which stored candidates are wanted.
void AddCandidateFilter(const Command& command, v1::CandidateFilter* filter);

// The same, whatever their state is.
void AddCandidateThresholds(const Command& command,
                            v1::CandidateFilter* filter);

// The uncertainty that is claimed for the poses of a drive file.
void AddUncertainty(const Command& command, UncertaintyOptions* options);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_COMMANDS_SHARED_FLAGS_H_
