// Between the messages of revisit.v1 and the types of core and server: the one
// place that knows both. Decoders check everything that the protos promise to
// check and name every field that is wrong; encoders cannot fail.
//
// Geodetic poses. The local frame of a geodetic vehicle is East-North-Up at its
// origin. With M the rotation from East-North-Up at the pose to that frame (the
// two differ by the curvature of the earth):
//   * the position is the pose's, in the local frame;
//   * the heading is that of M f projected onto the local x-y plane, f the
//   forward
//     axis at the pose;
//   * the covariance is carried over by the Jacobian J of these two maps, which
//   is
//     M for position (PLANAR: its upper left 2x2 part, since nothing is known
//     of height) and, for heading, the derivative of the heading of M f by a
//     turn of f about the vertical at the pose;
//   * an error transition Psi becomes J Psi J^-1: consecutive poses are so
//   close
//     that their frames are taken for one.
#ifndef REVISIT_SERVER_CONVERSION_PROTO_CONVERSION_H_
#define REVISIT_SERVER_CONVERSION_PROTO_CONVERSION_H_

#include <chrono>
#include <cstdint>
#include <functional>
#include <limits>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/engine.h"
#include "google/protobuf/field_mask.pb.h"
#include "revisit/v1/candidate.pb.h"
#include "revisit/v1/geometry.pb.h"
#include "revisit/v1/loop_closure.pb.h"
#include "revisit/v1/pose_graph_service.pb.h"
#include "revisit/v1/vehicle.pb.h"
#include "server/conversion/field_violations.h"
#include "server/sessions/vehicle_config.h"
#include "server/sessions/vehicle_session.h"
#include "server/storage/storage.h"

namespace revisit::server {

// Of a pose: sequences are stored as signed numbers.
inline constexpr std::uint64_t kMaxSequence =
    std::numeric_limits<std::int64_t>::max();

using Poses = google::protobuf::RepeatedPtrField<v1::Pose>;

// ---- Names

std::string VehicleName(const std::string& vehicle_id);

// INVALID_ARGUMENT (INVALID_RESOURCE_NAME) unless the id matches the pattern of
// ids.
absl::Status CheckId(const std::string& id, const FieldPath& path);

// The id in `vehicles/{vehicle}`.
absl::StatusOr<std::string> ParseVehicleName(const std::string& name,
                                             const FieldPath& path);

// INVALID_ARGUMENT (INVALID_FIELD) unless the uid of a vehicle is empty or one
// that a vehicle may have.
absl::Status CheckUid(const std::string& uid, const FieldPath& path);

struct PosePairName {
  std::string vehicle_id;
  std::string id;
};
// Of `vehicles/{vehicle}/loopClosures/{loop_closure}` or
// `vehicles/{vehicle}/rejectedCandidates/{rejected_candidate}`.
absl::StatusOr<PosePairName> ParsePosePairName(PairKind kind,
                                               const std::string& name,
                                               const FieldPath& path);

// ---- Vehicles and their settings

// Fields left out take their defaults. State, uid and creation time are left
// alone.
absl::StatusOr<VehicleConfig> DecodeSettings(
    const v1::VehicleSettings& settings, const FieldPath& path);
void EncodeSettings(const VehicleConfig& config, v1::VehicleSettings* settings);

// The config with the settings named by the mask replaced. FAILED_PRECONDITION
// (SETTING_FIXED) for those that cannot change once there are poses.
absl::StatusOr<VehicleConfig> UpdateSettings(
    const VehicleConfig& current, bool has_poses,
    const v1::VehicleSettings& settings,
    const google::protobuf::FieldMask& update_mask);

// Whether a vehicle was created, or could have been, with these settings: an
// origin that was left out is that of the first pose.
bool SameSettings(const VehicleConfig& existing,
                  const VehicleConfig& requested);

void EncodeVehicle(const VehicleView& view, v1::Vehicle* vehicle);
// What is stored of a vehicle that is not in memory.
void EncodeVehicle(const VehicleRecord& record, v1::Vehicle* vehicle);

// The vehicle's own search with what the options change.
absl::StatusOr<core::SearchOptions> DecodeCandidateOptions(
    const v1::CandidateOptions& options, const VehicleConfig& config,
    const FieldPath& path);

// ---- Poses

// A batch as AppendPoses takes it. `path` is what the field `poses` lies below.
absl::StatusOr<DecodedBatch> DecodeBatch(const Poses& poses, int max_poses,
                                         const VehicleConfig& config,
                                         const FieldPath& path);

// Drops what this version does not know. It would be stored and come back in
// answers, and make these larger than clients take, without being of use.
void DropUnknownFields(Poses* poses);

// Whether poses may replace stored ones. They are numbered over the whole call;
// the first of these is `first_number`.
absl::Status CheckRevisedPoses(const Poses& poses, std::size_t first_number,
                               const VehicleConfig& config);

// The new pose of a sequence; null if it stays as it is.
using RevisedPose = std::function<const v1::Pose*(std::uint64_t sequence)>;

// The batch with new estimates; nothing if none of its poses is replaced.
// Stamps stay; so do error transitions where the new pose brings none.
// REQUIRES: CheckRevisedPoses() says OK to the new ones.
absl::StatusOr<std::optional<BatchRecord>> ReviseBatch(
    const BatchRecord& stored, const VehicleConfig& config,
    const RevisedPose& revised);

// Calls with each pose of a stored batch, in order, until `visit` says false.
absl::Status VisitPoses(const BatchRecord& stored,
                        const std::function<bool(v1::Pose*)>& visit);

// The bytes in the store: a vehicle is a serialized revisit.v1.Vehicle with
// settings, state, uid and creation time; a batch is a serialized
// revisit.v1.PoseBatch. The fingerprint of a pose is the XXH3-64 of its
// serialized message.
class ProtoRecordCodec : public RecordCodec {
 public:
  std::string EncodeVehicle(const VehicleConfig& config) const override;
  absl::StatusOr<VehicleConfig> DecodeVehicle(
      const VehicleRecord& record) const override;
  absl::StatusOr<DecodedBatch> DecodeBatch(
      const std::string& payload, const VehicleConfig& config) const override;
  absl::StatusOr<std::string> SliceBatch(const std::string& payload,
                                         std::size_t first,
                                         std::size_t count) const override;
};

// ---- Pairs of poses

// The record that a request for a new pair asks for, without creation time.
// `pair` is null if it was left out; an id that was left out is made from the
// sequences.
absl::StatusOr<PosePairRecord> DecodePosePair(const v1::LoopClosure* pair,
                                              const std::string& id);
absl::StatusOr<PosePairRecord> DecodePosePair(const v1::RejectedCandidate* pair,
                                              const std::string& id);

void EncodePosePair(const std::string& vehicle_id, const PosePairRecord& record,
                    v1::LoopClosure* message);
void EncodePosePair(const std::string& vehicle_id, const PosePairRecord& record,
                    v1::RejectedCandidate* message);

// ---- Answers

void EncodeAck(const Acknowledgement& acknowledgement, v1::Ack* ack);

void EncodeNode(const core::PoseGraph& graph, core::NodeIndex index,
                core::StateSpace space, bool with_covariance, v1::Node* node);

// REQUIRES: the set is of this view.
void EncodeCandidateSet(const VehicleView& view, const core::CandidateSet& set,
                        bool include_aligned_path,
                        std::chrono::nanoseconds search_duration,
                        v1::CandidateSet* message);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_CONVERSION_PROTO_CONVERSION_H_
