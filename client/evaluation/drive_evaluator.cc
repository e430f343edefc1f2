#include "client/evaluation/drive_evaluator.h"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <set>
#include <utility>

#include "absl/strings/str_cat.h"
#include "client/evaluation/baselines.h"
#include "client/evaluation/service_answer.h"
#include "client/revisit/pose_stream.h"
#include "client/revisit/printable_text.h"
#include "client/revisit/status.h"
#include "client/trajectory/drive_poses.h"
#include "grpcpp/channel.h"

namespace revisit::client {
namespace {

using Clock = std::chrono::steady_clock;

constexpr std::size_t kBatchPoses = 64;
// Attempts at streaming a drive whose connection breaks.
constexpr int kAttempts = 3;

v1::Direction DirectionOf(PassDirection direction) {
  switch (direction) {
    case PassDirection::kSame:
      return v1::DIRECTION_SAME;
    case PassDirection::kOpposite:
      return v1::DIRECTION_OPPOSITE;
    case PassDirection::kEither:
      return v1::DIRECTION_EITHER;
  }
  return v1::DIRECTION_SAME;
}

class Evaluator {
 public:
  Evaluator(std::shared_ptr<grpc::Channel> channel, const Client& client,
            const Drive& drive,
            const std::vector<ClaimedUncertainty>& uncertainty,
            const RecordingsOfDrive& starts, const DriveRun& run,
            const Terminal& terminal)
      : channel_(std::move(channel)),
        client_(client),
        drive_(drive),
        uncertainty_(uncertainty),
        starts_(starts),
        run_(run),
        verifier_(run.verifier_errors, drive.name, run.seed),
        progress_(terminal, run.label, drive.samples.size(), "poses") {}

  // The last error that interrupted the stream; OK if none did.
  const absl::Status& broken() const { return broken_; }

  void ReportAnotherAttempt() {
    progress_.Note(absl::StrCat(
        "the connection broke (", Printable(std::string(broken_.message())),
        "); the drive is streamed again from its start"));
  }

  absl::StatusOr<DriveResult> Run(const v1::Vehicle& vehicle) {
    vehicle_ = vehicle.name();
    const auto start = Clock::now();
    const std::size_t poses = drive_.samples.size();
    for (std::size_t next = 0; next < poses;) {
      const std::size_t end = run_.verify ? EndOfStretch(next) : poses;
      if (absl::Status status = Stream(next, end); !status.ok()) return status;
      if (run_.verify) {
        if (absl::Status status = Verify(); !status.ok()) return status;
      }
      next = end;
    }
    const double seconds =
        std::chrono::duration<double>(Clock::now() - start).count();
    if (absl::Status status = FetchNodes(); !status.ok()) return status;
    if (absl::Status status = CheckAnswers(); !status.ok()) return status;
    if (run_.verify) {
      if (absl::Status status = FetchInflation(); !status.ok()) return status;
    }
    result_.drive = drive_.name;
    result_.truth_at_nodes = TruthAtNodes(result_.nodes, drive_.truth);
    result_.checks = Judge(result_.nodes, result_.truth_at_nodes,
                           result_.answers, JudgingOfNodes());
    Tally tally = Count(result_.checks);
    tally.confirmed = result_.tally.confirmed;
    tally.rejected = result_.tally.rejected;
    tally.jumps = result_.tally.jumps;
    tally.poses = static_cast<std::int64_t>(poses);
    tally.timed_poses = tally.poses;
    tally.seconds = seconds;
    result_.tally = std::move(tally);
    return std::move(result_);
  }

 private:
  // How answers are judged now that the nodes are known.
  Judging JudgingOfNodes() {
    Judging judging = run_.judging;
    if (run_.asking_from == 0) return judging;
    const auto first = std::find_if(result_.nodes.begin(), result_.nodes.end(),
                                    [&](const GraphNode& node) {
                                      return node.sequence > run_.asking_from;
                                    });
    judging.first_asking_node = first - result_.nodes.begin();
    if (!run_.verify) return judging;
    // Nothing counts where there was no link.
    judging.counted_behind =
        linked_at_.value_or(static_cast<std::int64_t>(result_.nodes.size()));
    if (linked_at_ && first != result_.nodes.end()) {
      result_.linked_after_meters =
          result_.nodes[static_cast<std::size_t>(*linked_at_)]
              .travelled_meters -
          first->travelled_meters;
    }
    return judging;
  }

  // Whether a node is of a recording that the asking one searches.
  bool IsInOther(const v1::Node& node) const {
    return node.sequence() <= run_.asking_from;
  }

  // The end of a stretch from `begin` on in which at most one check falls due.
  std::size_t EndOfStretch(std::size_t begin) const {
    // Nobody verifies before the asking recording begins.
    if (begin < run_.asking_from) return run_.asking_from;
    const double most = run_.settings.check_interval_meters();
    double travelled = 0.0;
    std::size_t end = begin + 1;
    while (end < drive_.samples.size() && end - begin < kBatchPoses) {
      const PlanarPose& from = drive_.samples[end - 1].estimate;
      const PlanarPose& to = drive_.samples[end].estimate;
      travelled += std::hypot(to.x - from.x, to.y - from.y);
      if (travelled > most) break;
      ++end;
    }
    return end;
  }

  PoseStreamOptions OptionsFrom(std::size_t begin) const {
    PoseStreamOptions options;
    options.batch_poses = static_cast<int>(kBatchPoses);
    options.send_candidates = true;
    options.candidate_options.set_direction(
        DirectionOf(run_.judging.direction));
    options.candidate_options.set_exhaustive(run_.exhaustive);
    options.acked_sequence = begin;
    options.give_up_after = std::chrono::seconds(30);
    return options;
  }

  // Takes answers; `understood` becomes the error of the first that made no
  // sense. It is written by callbacks, and to be read when they are over.
  PoseStreamCallbacks Callbacks(absl::Status* understood) {
    PoseStreamCallbacks callbacks;
    callbacks.ack = [this](const v1::Ack& ack) {
      progress_.Update(ack.durable_sequence());
      for (const v1::Jump& jump : ack.jumps()) {
        ++result_.tally.jumps;
        progress_.Note(JumpText(jump));
      }
    };
    callbacks.candidates = [this, understood](const v1::CandidateSet& set) {
      auto answer = MakeAnswer(set);
      if (!answer.ok()) {
        understood->Update(answer.status());
        return;
      }
      if (run_.older_candidates.has_value()) {
        LeaveOutRecentPath(run_.judging.excluded_nodes, *run_.older_candidates,
                           &*answer);
      }
      result_.answers.push_back(*std::move(answer));
      if (run_.verify) unverified_.push_back(set);
    };
    callbacks.disconnected = [this](const absl::Status& status,
                                    std::chrono::nanoseconds) {
      broken_ = status;
    };
    return callbacks;
  }

  // Streams these poses and waits for all answers.
  absl::Status Stream(std::size_t begin, std::size_t end) {
    absl::Status understood;
    PoseStream stream(channel_, vehicle_, OptionsFrom(begin),
                      Callbacks(&understood));
    const auto durable = stream.WaitUntilOpened();
    if (!durable.ok()) return durable.status();
    if (*durable != begin) {
      return LocalError(absl::FailedPreconditionError(absl::StrCat(
          vehicle_, " has ", *durable, " poses where ", begin,
          " were sent; an evaluation needs a new vehicle of its own")));
    }
    // Reconnects before this lost no answers, since nothing had been sent.
    const int reconnects = stream.reconnects();
    AppendPoses(drive_, uncertainty_, starts_, run_.settings, {begin, end},
                kBatchPoses, &stream);
    if (absl::Status status = stream.Finish(); !status.ok()) return status;
    if (stream.reconnects() > reconnects) {
      return absl::UnavailableError(
          absl::StrCat("the connection broke while ", drive_.name,
                       " was streamed (", broken_.message(),
                       "); answers of checks may be lost, so the figures would "
                       "not be comparable"));
    }
    return understood;
  }

  bool IsRight(const v1::Candidate& candidate) const {
    const auto truth = [&](const v1::Node& node) {
      return TruthAt(node.sequence(), node.fraction(), drive_.truth);
    };
    const bool is_history =
        run_.asking_from > 0
            ? IsInOther(candidate.matched())
            : candidate.matched().index() <=
                  candidate.query().index() - run_.judging.excluded_nodes;
    return is_history &&
           SamePlace(truth(candidate.query()), truth(candidate.matched()),
                     candidate.direction() == v1::DIRECTION_OPPOSITE,
                     run_.judging);
  }

  // The candidate that counts as first; null if there is none.
  const v1::Candidate* FirstOf(const v1::CandidateSet& set) const {
    for (const v1::Candidate& candidate : set.candidates()) {
      if (run_.asking_from > 0 && !IsInOther(candidate.matched())) continue;
      if (!run_.older_candidates.has_value() ||
          candidate.matched().index() <=
              candidate.query().index() - run_.judging.excluded_nodes) {
        return &candidate;
      }
    }
    return nullptr;
  }

  // Plays the verifier for the checks since the last call.
  absl::Status Verify() {
    for (const v1::CandidateSet& set : std::exchange(unverified_, {})) {
      const v1::Candidate* candidate = FirstOf(set);
      if (candidate == nullptr) continue;
      const v1::Candidate& first = *candidate;
      if (first.verdict() != v1::VERDICT_ACCEPTED) continue;
      for (const v1::Node* node : {&first.query(), &first.matched()}) {
        if (node->sequence() < 1 || node->sequence() > drive_.samples.size()) {
          return absl::InternalError("a candidate names a pose never sent");
        }
      }
      if (run_.asking_from > 0 && !IsFirstLink(first)) continue;
      const bool is_right = IsRight(first);
      absl::Status sent;
      switch (verifier_.Judge(is_right)) {
        case PlayedVerifier::Word::kNothing:
          break;
        case PlayedVerifier::Word::kConfirm:
          sent = Confirm(first, is_right);
          break;
        case PlayedVerifier::Word::kReject:
          sent = Reject(first);
          break;
      }
      if (!sent.ok()) return sent;
    }
    return absl::OkStatus();
  }

  absl::Status Confirm(const v1::Candidate& candidate, bool is_right) {
    ++result_.tally.confirmed;
    v1::AddLoopClosureRequest request;
    request.set_parent(vehicle_);
    v1::LoopClosure* closure = request.mutable_loop_closure();
    closure->set_query_sequence(candidate.query().sequence());
    closure->set_matched_sequence(candidate.matched().sequence());
    // A measurement is of the two poses, which lie before their nodes.
    const auto truth = [&](const v1::Node& node) {
      return TruthAt(node.sequence(), 0.0, drive_.truth);
    };
    if (const auto measured = verifier_.Measure(
            truth(candidate.query()), truth(candidate.matched()), is_right)) {
      *closure->mutable_measurement() = *measured;
    }
    return client_.AddLoopClosure(request).status();
  }

  absl::Status Reject(const v1::Candidate& candidate) {
    ++result_.tally.rejected;
    v1::RejectCandidateRequest request;
    request.set_parent(vehicle_);
    v1::RejectedCandidate* rejected = request.mutable_rejected_candidate();
    rejected->set_query_sequence(candidate.query().sequence());
    rejected->set_matched_sequence(candidate.matched().sequence());
    return client_.RejectCandidate(request).status();
  }

  // Whether a candidate is the first one that is right in its recording, and
  // the check is one of the asking recording.
  bool IsFirstLink(const v1::Candidate& candidate) {
    if (IsInOther(candidate.query()) || !IsRight(candidate)) return false;
    const auto next = starts_.upper_bound(
        static_cast<std::size_t>(candidate.matched().sequence()) - 1);
    if (!linked_.insert(next == starts_.end() ? 0 : next->first).second) {
      return false;
    }
    if (!linked_at_) linked_at_ = candidate.query().index();
    return true;
  }

  absl::Status FetchNodes() {
    v1::ExportPoseGraphRequest request;
    request.set_vehicle(vehicle_);
    const bool spatial = run_.settings.state_space() == v1::STATE_SPACE_SPATIAL;
    const auto form =
        spatial ? v1::COVARIANCE_FORM_SPATIAL_10 : v1::COVARIANCE_FORM_PLANAR_6;
    return client_.ExportPoseGraph(
        request, [&](const v1::ExportPoseGraphResponse& part) {
          for (const v1::Node& node : part.nodes()) {
            if (node.index() !=
                    static_cast<std::int64_t>(result_.nodes.size()) ||
                node.sequence() < 1 ||
                node.sequence() > drive_.samples.size() ||
                node.covariance().form() != form ||
                node.covariance().values_size() != (spatial ? 10 : 6)) {
              return absl::InternalError(
                  absl::StrCat("the export's node ", node.index(),
                               " is not what was expected"));
            }
            const auto& covariance = node.covariance().values();
            result_.nodes.push_back(
                {node.sequence(), node.fraction(), node.travelled_meters(),
                 PlanarPose{node.pose().x_meters(), node.pose().y_meters(),
                            node.pose().heading_radians()},
                 covariance[0], covariance[1], covariance[spatial ? 4 : 3]});
          }
          return absl::OkStatus();
        });
  }

  absl::Status CheckAnswers() const {
    const auto known = [&](std::int64_t index) {
      return index >= 0 &&
             index < static_cast<std::int64_t>(result_.nodes.size());
    };
    for (const CheckAnswer& answer : result_.answers) {
      if (!known(answer.query) ||
          !std::all_of(answer.candidates.begin(), answer.candidates.end(),
                       [&](const CandidateAnswer& candidate) {
                         return known(candidate.matched);
                       })) {
        return absl::InternalError(
            "a candidate names a node that the export does not have");
      }
    }
    return absl::OkStatus();
  }

  absl::Status FetchInflation() {
    v1::GetVehicleRequest request;
    request.set_name(vehicle_);
    const auto vehicle = client_.GetVehicle(request);
    if (!vehicle.ok()) return vehicle.status();
    if (vehicle->vehicle().has_consistency()) {
      result_.inflation = vehicle->vehicle().consistency().inflation();
    }
    return absl::OkStatus();
  }

  const std::shared_ptr<grpc::Channel> channel_;
  const Client& client_;
  const Drive& drive_;
  const std::vector<ClaimedUncertainty>& uncertainty_;
  const RecordingsOfDrive& starts_;
  const DriveRun& run_;
  PlayedVerifier verifier_;
  Progress progress_;
  std::string vehicle_;
  // Written by the stream, read when it is over.
  absl::Status broken_;
  // Filled as answers come; its tally holds what is counted on the way.
  DriveResult result_;
  std::vector<v1::CandidateSet> unverified_;
  // The recordings that a verifier has tied to the asking one, and the node of
  // the first check at which it did.
  std::set<std::size_t> linked_;
  std::optional<std::int64_t> linked_at_;
};

}  // namespace

absl::StatusOr<DriveResult> EvaluateDrive(
    const std::shared_ptr<grpc::Channel>& channel, const Client& client,
    const Drive& drive, const std::vector<ClaimedUncertainty>& uncertainty,
    const RecordingsOfDrive& starts, const DriveRun& run,
    const std::function<void(const v1::Vehicle&)>& created,
    const Terminal& terminal) {
  for (int attempt = 1;; ++attempt) {
    v1::CreateVehicleRequest create;
    create.set_vehicle_id(run.vehicle_id);
    *create.mutable_vehicle()->mutable_settings() = run.settings;
    const auto answer = client.CreateVehicle(create);
    if (!answer.ok()) return answer.status();
    created(answer->vehicle());
    Evaluator evaluator(channel, client, drive, uncertainty, starts, run,
                        terminal);
    auto result = evaluator.Run(answer->vehicle());
    if (result.ok() || evaluator.broken().ok() || attempt == kAttempts) {
      return result;
    }
    evaluator.ReportAnotherAttempt();
    v1::DeleteVehicleRequest forget;
    forget.set_name(answer->vehicle().name());
    if (absl::Status status = client.DeleteVehicle(forget).status();
        !status.ok()) {
      return status;
    }
  }
}

}  // namespace revisit::client
