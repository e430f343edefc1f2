// Answers: vehicles, acknowledgements, nodes, recordings and candidates.
#ifndef REVISIT_SERVER_CONVERSION_ANSWERS_H_
#define REVISIT_SERVER_CONVERSION_ANSWERS_H_

#include <chrono>
#include <cstddef>
#include <vector>

#include "core/drive/drive.h"
#include "revisit/v1/candidate.pb.h"
#include "revisit/v1/pose_graph_service.pb.h"
#include "revisit/v1/recording.pb.h"
#include "revisit/v1/vehicle.pb.h"
#include "server/fleet/group_scope.h"
#include "server/sessions/append_request.h"
#include "server/storage/records.h"
#include "server/storage/storage_facts.h"

namespace revisit::core {
struct FrameRelation;
}  // namespace revisit::core

namespace revisit::server {

void EncodeVehicle(const VehicleView& view, v1::Vehicle* vehicle);
// Encodes what the store knows of a vehicle that is not in memory.
void EncodeVehicle(const VehicleRecord& record, v1::Vehicle* vehicle);

// With warnings of its findings and of a stamp that is ahead.
void EncodeAck(const Acknowledgement& acknowledgement, v1::Ack* ack);

void EncodeNode(const core::PoseGraph& graph, core::NodeIndex index,
                core::StateSpace space, bool with_covariance, v1::Node* node);

// Encodes recording `k` of the view; `relation` is that of the last recording
// to it. REQUIRES: the vehicle has poses, and k is below
// drive.recordings().size().
void EncodeRecording(const VehicleView& view, std::size_t k,
                     const core::FrameRelation& relation,
                     v1::Recording* message);

void EncodeDurability(const Durability& durability,
                      v1::GetServerInfoResponse* response);
void EncodeStorageUsers(const std::vector<StorageUser>& users,
                        v1::GetServerInfoResponse* response);

// `scope`: that of the search, if it had one. REQUIRES: the set was found in
// this view.
void EncodeCandidateSet(const VehicleView& view, const core::CandidateSet& set,
                        bool include_aligned_path,
                        std::chrono::nanoseconds search_duration,
                        v1::CandidateSet* message,
                        const GroupScope* scope = nullptr);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_CONVERSION_ANSWERS_H_
