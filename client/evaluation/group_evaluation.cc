#include "client/evaluation/group_evaluation.h"

#include <algorithm>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <thread>
#include <utility>

#include "absl/strings/str_cat.h"
#include "client/answers/names.h"
#include "client/evaluation/drive_evaluator.h"
#include "client/evaluation/evaluation_report.h"
#include "client/evaluation/service_answer.h"

namespace revisit::client {
namespace {

using Clock = std::chrono::steady_clock;

// A change of a group counts in searches after a second at most.
constexpr std::chrono::seconds kLongestWait{10};
constexpr std::chrono::milliseconds kPause{50};

class GroupEvaluation {
 public:
  GroupEvaluation(const std::shared_ptr<grpc::Channel>& channel,
                  const Client& client, const Drive& known, const Drive& asking,
                  const GroupRun& run, const Terminal& terminal)
      : channel_(channel),
        client_(client),
        known_(known),
        asking_(asking),
        run_(run),
        terminal_(terminal) {}

  absl::StatusOr<GroupResult> Run() {
    if (absl::Status status = StreamBoth(); !status.ok()) return status;
    if (absl::Status status = MakeGroup(); !status.ok()) return status;
    const auto answers = Ask();
    if (!answers.ok()) return answers.status();
    GroupResult result;
    result.before = Judge(nodes_, truth_, *answers, judging_);
    const auto first = std::find_if(
        result.before.begin(), result.before.end(), [](const auto& check) {
          return check.accepted() && check.top_correct();
        });
    if (first == result.before.end()) return result;
    if (absl::Status status = Link(first->answer); !status.ok()) return status;
    result.linked_after_meters =
        Travelled(first->answer.query) - Travelled(judging_.first_asking_node);
    judging_.counted_behind = first->answer.query;
    result.before.erase(result.before.begin(), first + 1);
    const auto again = Ask();
    if (!again.ok()) return again.status();
    result.after = Judge(nodes_, truth_, *again, judging_);
    return result;
  }

 private:
  double Travelled(std::int64_t node) const {
    return nodes_[static_cast<std::size_t>(node)].travelled_meters;
  }

  absl::StatusOr<DriveResult> Stream(const Drive& drive) {
    DriveRun run;
    run.vehicle_id = drive.name;
    run.settings = run_.settings;
    run.label = drive.name;
    run.judging = run_.judging;
    const auto claims = ClaimUncertainty(drive, run_.uncertainty);
    if (!claims.ok()) return claims.status();
    return EvaluateDrive(
        channel_, client_, drive, *claims, {}, run, [](const v1::Vehicle&) {},
        terminal_);
  }

  // Numbers the nodes of both drives one behind the other, as judging expects
  // them of recordings.
  absl::Status StreamBoth() {
    auto known = Stream(known_);
    if (!known.ok()) return known.status();
    auto asking = Stream(asking_);
    if (!asking.ok()) return asking.status();
    nodes_ = std::move(known->nodes);
    truth_ = std::move(known->truth_at_nodes);
    judging_ = run_.judging;
    judging_.first_asking_node = static_cast<std::int64_t>(nodes_.size());
    for (const CheckAnswer& answer : asking->answers) {
      checks_.push_back(
          asking->nodes[static_cast<std::size_t>(answer.query)].sequence);
    }
    const double driven = nodes_.empty() ? 0.0 : nodes_.back().travelled_meters;
    for (GraphNode& node : asking->nodes) {
      node.travelled_meters += driven;
      nodes_.push_back(node);
    }
    truth_.insert(truth_.end(), asking->truth_at_nodes.begin(),
                  asking->truth_at_nodes.end());
    return absl::OkStatus();
  }

  absl::Status MakeGroup() {
    v1::CreateGroupRequest create;
    create.set_group_id(run_.group_id);
    if (absl::Status status = client_.CreateGroup(create).status();
        !status.ok()) {
      return status;
    }
    for (const Drive* drive : {&known_, &asking_}) {
      v1::AddGroupMemberRequest add;
      add.set_parent(GroupName(run_.group_id));
      add.mutable_member()->set_vehicle(VehicleName(drive->name));
      const auto added = client_.AddGroupMember(add);
      if (!added.ok()) return added.status();
      revision_ = added->revision();
    }
    return absl::OkStatus();
  }

  // Answers to all checks that count, by the group as it is now.
  absl::StatusOr<std::vector<CheckAnswer>> Ask() {
    Progress progress(terminal_, GroupName(run_.group_id), checks_.size(),
                      "searches");
    std::vector<CheckAnswer> answers;
    for (std::size_t i = 0; i < checks_.size(); ++i) {
      const auto answer = AskAt(checks_[i]);
      if (!answer.ok()) return answer.status();
      answers.push_back(*answer);
      progress.Update(i + 1);
    }
    return answers;
  }

  absl::StatusOr<CheckAnswer> AskAt(std::uint64_t sequence) {
    v1::FindCandidatesRequest request;
    request.set_vehicle(VehicleName(asking_.name));
    request.set_sequence(sequence);
    v1::SearchScope* scope = request.mutable_options()->mutable_scope();
    scope->set_group(GroupName(run_.group_id));
    scope->set_exclude_own(true);
    const auto give_up = Clock::now() + kLongestWait;
    for (;;) {
      const auto response = client_.FindCandidates(request);
      if (!response.ok()) return response.status();
      if (response->candidates().group_revision() >= revision_) {
        return AnswerAmongNodes(response->candidates());
      }
      if (Clock::now() >= give_up) {
        return absl::DeadlineExceededError(
            absl::StrCat("searches do not use revision ", revision_, " of ",
                         GroupName(run_.group_id)));
      }
      std::this_thread::sleep_for(kPause);
    }
  }

  absl::StatusOr<CheckAnswer> AnswerAmongNodes(
      const v1::CandidateSet& set) const {
    auto answer = MakeAnswer(set);
    if (!answer.ok()) return answer;
    const auto all = static_cast<std::int64_t>(nodes_.size());
    const std::int64_t known = judging_.first_asking_node;
    const bool has_nodes = std::all_of(
        answer->candidates.begin(), answer->candidates.end(),
        [&](const auto& c) { return c.matched >= 0 && c.matched < known; });
    if (answer->query < 0 || answer->query >= all - known || !has_nodes) {
      return absl::InternalError(
          "an answer names a node that was not exported");
    }
    answer->query += known;
    return answer;
  }

  absl::Status Link(const CheckAnswer& answer) {
    v1::AddInterVehicleLoopClosureRequest request;
    request.set_parent(GroupName(run_.group_id));
    v1::InterVehicleLoopClosure* link = request.mutable_loop_closure();
    const auto fill = [&](const Drive& drive, std::int64_t node,
                          v1::MemberPose* pose) {
      pose->set_vehicle(VehicleName(drive.name));
      pose->set_sequence(nodes_[static_cast<std::size_t>(node)].sequence);
    };
    fill(asking_, answer.query, link->mutable_query());
    fill(known_, answer.candidates[0].matched, link->mutable_matched());
    const auto added = client_.AddInterVehicleLoopClosure(request);
    if (added.ok()) revision_ = added->revision();
    return added.status();
  }

  const std::shared_ptr<grpc::Channel>& channel_;
  const Client& client_;
  const Drive& known_;
  const Drive& asking_;
  const GroupRun& run_;
  const Terminal& terminal_;
  // The nodes of the known drive, and behind them those of the asking one. A
  // node's sequence is that in its own vehicle.
  std::vector<GraphNode> nodes_;
  std::vector<PlanarPose> truth_;
  Judging judging_;
  // The sequences at which the asking vehicle is asked about.
  std::vector<std::uint64_t> checks_;
  // The revision of the group that searches have to use.
  std::uint64_t revision_ = 0;
};

}  // namespace

absl::StatusOr<GroupResult> EvaluateGroup(
    const std::shared_ptr<grpc::Channel>& channel, const Client& client,
    const Drive& known, const Drive& asking, const GroupRun& run,
    const Terminal& terminal) {
  return GroupEvaluation(channel, client, known, asking, run, terminal).Run();
}

}  // namespace revisit::client
