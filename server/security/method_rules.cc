#include "server/security/method_rules.h"

namespace revisit::server {
namespace {

constexpr MethodRule kRules[] = {
    {"AcceptDataLoss", Verb::kAdmin},
    {"AddLoopClosure", Verb::kWrite},
    {"AppendPoses", Verb::kWrite},
    {"CreateVehicle", Verb::kWrite, true},
    {"DeleteLoopClosure", Verb::kWrite},
    {"DeleteRejectedCandidate", Verb::kWrite},
    {"DeleteVehicle", Verb::kAdmin},
    {"ExportPoseGraph", Verb::kRead, false, true},
    {"FindCandidates", Verb::kRead},
    {"FindContradictions", Verb::kRead},
    {"GetCheck", Verb::kRead},
    {"GetServerInfo", std::nullopt},
    {"GetVehicle", Verb::kRead},
    {"ListChecks", Verb::kRead},
    {"ListDeletedPosePairs", Verb::kRead},
    {"ListLoopClosures", Verb::kRead},
    {"ListPoses", Verb::kRead},
    {"ListRecordings", Verb::kRead},
    {"ListRejectedCandidates", Verb::kRead},
    {"ListVehicles", Verb::kRead},
    {"RejectCandidate", Verb::kWrite},
    {"RevisePoses", Verb::kWrite, false, true},
    // StreamPoses also requires kRead where candidates are asked for.
    {"StreamPoses", Verb::kWrite, false, true},
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
