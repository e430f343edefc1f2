#include "server/security/method_rules.h"

namespace revisit::server {
namespace {

constexpr MethodRule kRules[] = {
    {"AcceptDataLoss", Verb::kAdmin},
    // Also requires kWrite on the vehicle.
    {"AddGroupMember", Verb::kWrite},
    // Also requires kRead on both vehicles.
    {"AddInterVehicleLoopClosure", Verb::kWrite},
    {"AddLoopClosure", Verb::kWrite},
    {"AppendPoses", Verb::kWrite},
    {"CreateGroup", Verb::kWrite, true},
    {"CreateVehicle", Verb::kWrite, true},
    {"DeleteGroup", Verb::kAdmin},
    {"DeleteInterVehicleLoopClosure", Verb::kWrite},
    {"DeleteInterVehicleRejectedCandidate", Verb::kWrite},
    {"DeleteLoopClosure", Verb::kWrite},
    {"DeleteRejectedCandidate", Verb::kWrite},
    {"DeleteVehicle", Verb::kAdmin},
    {"ExportPoseGraph", Verb::kRead, false, true},
    {"FindCandidates", Verb::kRead},
    {"FindContradictions", Verb::kRead},
    {"GetCheck", Verb::kRead},
    {"GetGroup", Verb::kRead},
    {"GetServerInfo", std::nullopt},
    {"GetVehicle", Verb::kRead},
    {"ListChecks", Verb::kRead},
    {"ListDeletedPosePairs", Verb::kRead},
    {"ListFrameTransforms", Verb::kRead},
    {"ListGroupMembers", Verb::kRead},
    {"ListGroups", Verb::kRead},
    {"ListInterVehicleLoopClosures", Verb::kRead},
    {"ListInterVehicleRejectedCandidates", Verb::kRead},
    {"ListLoopClosures", Verb::kRead},
    {"ListPoses", Verb::kRead},
    {"ListRecordings", Verb::kRead},
    {"ListRejectedCandidates", Verb::kRead},
    {"ListVehicles", Verb::kRead},
    {"RejectCandidate", Verb::kWrite},
    // Also requires kRead on both vehicles.
    {"RejectInterVehicleCandidate", Verb::kWrite},
    {"RemoveGroupMember", Verb::kWrite},
    {"RevisePoses", Verb::kWrite, false, true},
    // StreamPoses also requires kRead where candidates are asked for.
    {"StreamPoses", Verb::kWrite, false, true},
    {"UpdateGroup", Verb::kWrite},
    {"UpdateGroupMember", Verb::kWrite},
    {"UpdateVehicle", Verb::kWrite},
    {"WatchCandidates", Verb::kRead, false, true},
};

}  // namespace

const MethodRule* FindMethodRule(const std::string& method) {
  for (const MethodRule& rule : kRules) {
    if (method == rule.method) return &rule;
  }
  return nullptr;
}

absl::Span<const MethodRule> MethodRules() { return kRules; }

}  // namespace revisit::server
