// Every request of the service, from its bytes to what the session is given,
// and poses on to the graph.
#include <optional>
#include <string>
#include <vector>

#include "google/protobuf/util/field_mask_util.h"
#include "revisit/v1/pose_graph_service.pb.h"
#include "server/conversion/names.h"
#include "server/conversion/page_token.h"
#include "server/conversion/pose_pairs.h"
#include "server/conversion/poses.h"
#include "server/conversion/vehicle_labels.h"
#include "server/conversion/vehicle_settings.h"
#include "server/fields/pose_fields.h"
#include "server/records/batch_records.h"
#include "server/records/proto_record_codec.h"
#include "tests/fuzz/fuzzing.h"
#include "tests/fuzz/vehicles.h"

namespace revisit::fuzz {
namespace {

using google::protobuf::util::FieldMaskUtil;
using server::DecodedBatch;
using server::FieldPath;
using server::VehicleConfig;

constexpr int kMostPoses = 256;
constexpr FieldPath kRequest;

template <typename Message>
std::optional<Message> Parse(const Input& input) {
  Message message;
  if (!message.ParseFromString(input.Rest())) return std::nullopt;
  return message;
}

void CheckBatch(const server::SentPoses& poses, const VehicleConfig& config) {
  const auto batch = server::DecodeBatch(poses, kMostPoses, config, kRequest);
  RequireGoodError(batch.status());
  if (!batch.ok()) return;
  const auto count = static_cast<std::size_t>(poses.count());
  Require(batch->samples.size() == count, "a sample for each pose");
  VehicleConfig stored_config = config;
  if (!stored_config.origin) stored_config.origin = batch->origin;
  const server::ProtoRecordCodec codec;
  const auto stored = codec.DecodePoses(batch->payload, stored_config);
  Require(stored.ok(), "what is stored can be read");
  Require(stored->samples.size() == count, "what is stored is what was sent");
  const auto fingerprints = codec.Fingerprints(batch->payload);
  Require(fingerprints.ok() && fingerprints->size() == count,
          "a fingerprint for each pose");
  const auto messages = codec.AsMessages(batch->payload);
  Require(messages.ok(), "poses of columns can be messages");
  const auto of_messages = codec.Fingerprints(*messages);
  Require(of_messages.ok() && *of_messages == *fingerprints,
          "a pose is the same in both forms");
  const auto slice = codec.SliceBatch(batch->payload, count / 2, count / 2);
  Require(slice.ok(), "a batch can be cut");
  Drive(stored_config, batch->samples);
}

void CheckConfig(const absl::StatusOr<VehicleConfig>& config) {
  RequireGoodError(config.status());
  if (!config.ok()) return;
  Require(core::FindProblems(config->drive).empty(), "settings are valid");
  v1::VehicleSettings settings;
  server::EncodeSettings(*config, &settings);
  const auto again = server::DecodeSettings(settings, kRequest);
  Require(again.ok(), "settings that are told can be given");
  Require(server::SameSettings(*config, *again), "settings stay the same");
  const server::ProtoRecordCodec codec;
  VehicleConfig stored = *config;
  stored.create_time_ns = 1;
  server::VehicleRecord record;
  record.payload = codec.EncodeVehicle(stored);
  const auto read = codec.DecodeVehicle(record);
  Require(read.ok(), "a stored vehicle can be read");
}

void CheckOptions(const v1::CandidateOptions& options,
                  const VehicleConfig& config) {
  const auto decoded =
      server::DecodeCandidateOptions(options, config, kRequest);
  RequireGoodError(decoded.status());
  if (decoded.ok()) {
    Require(core::FindProblems(*decoded, config.drive).empty(),
            "options are valid");
  }
}

void CheckName(const std::string& name) {
  const auto id = server::ParseVehicleName(name, kRequest.Field("name"));
  RequireGoodError(id.status());
  if (id.ok()) Require(server::VehicleName(*id) == name, "a name is its id's");
}

template <typename Pair>
void CheckPair(const Pair* pair, const std::string& id,
               const VehicleConfig& config) {
  const auto record = server::DecodePosePair(pair, id, "");
  RequireGoodError(record.status());
  if (!record.ok()) return;
  Pair answer;
  server::EncodePosePair("v", *record, &answer);
  const core::StateSpace space = config.drive.state_space;
  const auto measurement =
      server::ProtoRecordCodec().DecodeMeasurement(record->payload, space);
  RequireGoodError(measurement.status());
  if (measurement.ok() && *measurement) {
    core::PoseSample sample;
    sample.covariance = (*measurement)->covariance;
    Require(!core::FindDefect(sample, space), "a measurement is valid");
  }
  Require(record->matched_sequence < record->query_sequence &&
              record->matched_sequence > 0,
          "a pair is of a pose and an earlier one");
}

void CheckRevision(const v1::RevisePosesRequest& request,
                   const VehicleConfig& config) {
  CheckName(request.vehicle());
  std::vector<const v1::Pose*> poses;
  v1::PoseBatch stored;
  for (const v1::Pose& pose : request.poses()) {
    poses.push_back(&pose);
    stored.add_poses()->set_sequence(pose.sequence());
  }
  const absl::Status checked =
      server::CheckRevisedPoses(request.poses(), 0, config);
  RequireGoodError(checked);
  if (!checked.ok() || poses.empty()) return;
  server::BatchRecord record;
  record.payload = stored.SerializeAsString();
  const auto starts = request.common_frame() ? server::RevisedStarts::kFirst
                                             : server::RevisedStarts::kStay;
  const auto revised =
      server::ReviseBatch(record, config, starts, [&](std::uint64_t sequence) {
        std::optional<server::PoseFields> found;
        for (const v1::Pose* pose : poses) {
          if (pose->sequence() == sequence) found = server::PoseFieldsOf(*pose);
        }
        return found;
      });
  Require(revised.ok() && revised->has_value(), "a batch is revised");
}

}  // namespace
}  // namespace revisit::fuzz

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data,
                                      std::size_t size) {
  using namespace revisit::fuzz;
  namespace v1 = revisit::v1;
  namespace server = revisit::server;
  Input input(data, size);
  const int request = input.Choice(10);
  const server::VehicleConfig config =
      VehicleOfKind(input.Choice(kVehicleKinds));
  switch (request) {
    case 0:
      if (const auto m = Parse<v1::CreateVehicleRequest>(input)) {
        RequireGoodError(server::CheckId(m->vehicle_id(), kRequest));
        CheckConfig(server::DecodeSettings(m->vehicle().settings(), kRequest));
        VehicleConfig named = config;
        RequireGoodError(server::UpdateLabels(m->vehicle(), {true, true, {}},
                                              kRequest, &named));
        CheckConfig(named);
      }
      break;
    case 1:
      if (const auto m = Parse<v1::UpdateVehicleRequest>(input)) {
        CheckName(m->vehicle().name());
        for (const bool has_poses : {false, true}) {
          CheckConfig(server::UpdateConfig(config, has_poses, m->vehicle(),
                                           m->update_mask()));
        }
        v1::Vehicle answer = m->vehicle();
        server::TrimToMask(m->update_mask(), &answer);
      }
      break;
    case 2:
      if (const auto m = Parse<v1::AppendPosesRequest>(input)) {
        CheckName(m->vehicle());
        CheckBatch(server::SentPosesOf(*m), config);
      }
      break;
    case 3:
      if (const auto m = Parse<v1::StreamPosesRequest>(input)) {
        CheckName(m->open().vehicle());
        CheckOptions(m->open().candidate_options(), config);
        CheckBatch(server::SentPosesOf(m->batch()), config);
      }
      break;
    case 4:
      if (const auto m = Parse<v1::FindCandidatesRequest>(input)) {
        CheckName(m->vehicle());
        CheckOptions(m->options(), config);
      }
      break;
    case 5:
      if (const auto m = Parse<v1::AddLoopClosureRequest>(input)) {
        CheckName(m->parent());
        CheckPair(m->has_loop_closure() ? &m->loop_closure() : nullptr,
                  m->loop_closure_id(), config);
      }
      break;
    case 6:
      if (const auto m = Parse<v1::RejectCandidateRequest>(input)) {
        CheckPair(
            m->has_rejected_candidate() ? &m->rejected_candidate() : nullptr,
            m->rejected_candidate_id(), config);
      }
      break;
    case 7:
      if (const auto m = Parse<v1::RevisePosesRequest>(input)) {
        CheckRevision(*m, config);
      }
      break;
    case 8:
      if (const auto m = Parse<v1::ListPosesRequest>(input)) {
        CheckName(m->parent());
        RequireGoodError(
            server::ParsePageToken("ListPoses", m->page_token()).status());
        RequireGoodError(server::PageSize(m->page_size(), 10, 20).status());
        bool valid = true;
        for (const std::string& path : m->read_mask().paths()) {
          valid = valid && FieldMaskUtil::IsValidPath<v1::Pose>(path);
        }
        v1::Pose pose;
        pose.mutable_local()->set_x_meters(1.0);
        if (valid) FieldMaskUtil::TrimMessage(m->read_mask(), &pose);
      }
      break;
    default:
      // The rest name something and no more.
      if (const auto m = Parse<v1::DeleteLoopClosureRequest>(input)) {
        for (const server::PairKind kind : server::kPairKinds) {
          RequireGoodError(
              server::ParsePosePairName(kind, m->name(), kRequest).status());
        }
      }
  }
  return 0;
}
