// The groups of the fake server.
#include <algorithm>
#include <iterator>

#include "google/protobuf/util/field_mask_util.h"
#include "tests/client/fake_server.h"

namespace revisit::client {
namespace {

grpc::Status NoGroup() {
  return MakeStatus(grpc::StatusCode::NOT_FOUND, "no such group",
                    {"GROUP_NOT_FOUND"});
}

// Puts two of the items of a map on a page, with this text in their names.
template <typename Map, typename Items, typename Page>
void FillPage(const Map& map, const std::string& token, const std::string& said,
              Items* items, Page* page) {
  constexpr std::size_t kPage = 2;
  const std::size_t first =
      token.empty() ? 0 : std::min<std::size_t>(std::stoul(token), map.size());
  auto at = std::next(map.begin(), static_cast<std::ptrdiff_t>(first));
  for (std::size_t i = 0; i < kPage && at != map.end(); ++i, ++at) {
    auto* const item = items->Add();
    *item = at->second;
    item->set_name(item->name() + said);
  }
  if (at != map.end()) page->set_next_page_token(std::to_string(first + kPage));
}

}  // namespace

FakeServer::Group* FakeServer::GroupOf(const std::string& name) {
  const auto found = groups_.find(name.substr(0, name.find('/', 7)));
  return found == groups_.end() ? nullptr : &found->second;
}

v1::UpdateGroupRequest FakeServer::last_group_update() const {
  std::lock_guard<std::mutex> lock(mutex_);
  return last_group_update_;
}

v1::ListFrameTransformsRequest FakeServer::last_frames() const {
  std::lock_guard<std::mutex> lock(mutex_);
  return last_frames_;
}

void FakeServer::set_revision_step(std::uint64_t step) {
  std::lock_guard<std::mutex> lock(mutex_);
  revision_step_ = step;
}

grpc::Status FakeServer::CreateGroup(grpc::ServerContext*,
                                     const v1::CreateGroupRequest* request,
                                     v1::CreateGroupResponse* response) {
  {
    std::lock_guard<std::mutex> lock(mutex_);
    const std::string name = "groups/" + request->group_id();
    v1::Group& made = groups_[name].group;
    made = request->group();
    made.set_name(name);
    made.set_uid("uid-of-" + request->group_id());
    made.set_revision(1);
    *response->mutable_group() = made;
    response->mutable_group()->set_name(name + said_);
    response->mutable_group()->set_display_name(made.display_name() + said_);
  }
  return NextUnaryStatus();
}

grpc::Status FakeServer::GetGroup(grpc::ServerContext*,
                                  const v1::GetGroupRequest* request,
                                  v1::GetGroupResponse* response) {
  {
    std::lock_guard<std::mutex> lock(mutex_);
    const Group* const group = GroupOf(request->name());
    if (group == nullptr) return NoGroup();
    *response->mutable_group() = group->group;
    response->mutable_group()->set_display_name(group->group.display_name() +
                                                said_);
  }
  return NextUnaryStatus();
}

grpc::Status FakeServer::ListGroups(grpc::ServerContext*,
                                    const v1::ListGroupsRequest* request,
                                    v1::ListGroupsResponse* response) {
  {
    std::lock_guard<std::mutex> lock(mutex_);
    std::map<std::string, v1::Group> all;
    for (const auto& [name, group] : groups_) all[name] = group.group;
    FillPage(all, request->page_token(), said_, response->mutable_groups(),
             response);
  }
  EndPage(request->page_token(), response->mutable_groups(), response);
  return NextUnaryStatus();
}

grpc::Status FakeServer::UpdateGroup(grpc::ServerContext*,
                                     const v1::UpdateGroupRequest* request,
                                     v1::UpdateGroupResponse* response) {
  using google::protobuf::util::FieldMaskUtil;
  {
    std::lock_guard<std::mutex> lock(mutex_);
    last_group_update_ = *request;
    Group* const group = GroupOf(request->group().name());
    if (group == nullptr) return NoGroup();
    FieldMaskUtil::MergeOptions replacing;
    replacing.set_replace_message_fields(true);
    FieldMaskUtil::MergeMessageTo(request->group(), request->update_mask(),
                                  replacing, &group->group);
    group->group.set_revision(group->group.revision() + 1);
    *response->mutable_group() = group->group;
  }
  return NextUnaryStatus();
}

grpc::Status FakeServer::DeleteGroup(grpc::ServerContext*,
                                     const v1::DeleteGroupRequest* request,
                                     v1::DeleteGroupResponse*) {
  NoteDeletion(request->name());
  if (const grpc::Status status = NextUnaryStatus(); !status.ok()) {
    return status;
  }
  std::lock_guard<std::mutex> lock(mutex_);
  const Group* const group = GroupOf(request->name());
  if (group != nullptr && request->expected_revision() != 0 &&
      request->expected_revision() != group->group.revision()) {
    return MakeStatus(grpc::StatusCode::ABORTED, "another revision",
                      {"REVISION_MISMATCH"});
  }
  return groups_.erase(request->name()) == 1 ? grpc::Status::OK : NoGroup();
}

grpc::Status FakeServer::AddGroupMember(
    grpc::ServerContext*, const v1::AddGroupMemberRequest* request,
    v1::AddGroupMemberResponse* response) {
  {
    std::lock_guard<std::mutex> lock(mutex_);
    Group* const group = GroupOf(request->parent());
    if (group == nullptr) return NoGroup();
    v1::GroupMember* const member = response->mutable_member();
    *member = request->member();
    member->set_name(request->parent() + "/members/" +
                     member->vehicle().substr(member->vehicle().find('/') + 1));
    group->members[member->name()] = *member;
    group->group.set_revision(group->group.revision() + 1);
    response->set_revision(group->group.revision());
    member->set_name(member->name() + said_);
  }
  return NextUnaryStatus();
}

grpc::Status FakeServer::UpdateGroupMember(
    grpc::ServerContext*, const v1::UpdateGroupMemberRequest* request,
    v1::UpdateGroupMemberResponse* response) {
  {
    std::lock_guard<std::mutex> lock(mutex_);
    Group* const group = GroupOf(request->member().name());
    if (group == nullptr) return NoGroup();
    v1::GroupMember& member = group->members[request->member().name()];
    if (request->expected_revision() != 0 &&
        request->expected_revision() != group->group.revision()) {
      return MakeStatus(grpc::StatusCode::ABORTED, "another revision",
                        {"REVISION_MISMATCH"});
    }
    member.clear_datum();
    if (request->member().has_datum()) {
      *member.mutable_datum() = request->member().datum();
    }
    group->group.set_revision(group->group.revision() + 1);
    *response->mutable_member() = member;
    response->mutable_member()->set_name(member.name() + said_);
    response->set_revision(group->group.revision());
  }
  return NextUnaryStatus();
}

grpc::Status FakeServer::RemoveGroupMember(
    grpc::ServerContext*, const v1::RemoveGroupMemberRequest* request,
    v1::RemoveGroupMemberResponse* response) {
  NoteDeletion(request->name());
  {
    std::lock_guard<std::mutex> lock(mutex_);
    Group* const group = GroupOf(request->name());
    if (group == nullptr) return NoGroup();
    group->members.erase(request->name());
    group->group.set_revision(group->group.revision() + 1);
    response->set_revision(group->group.revision());
  }
  return NextUnaryStatus();
}

grpc::Status FakeServer::ListGroupMembers(
    grpc::ServerContext*, const v1::ListGroupMembersRequest* request,
    v1::ListGroupMembersResponse* response) {
  {
    std::lock_guard<std::mutex> lock(mutex_);
    const Group* const group = GroupOf(request->parent());
    if (group == nullptr) return NoGroup();
    FillPage(group->members, request->page_token(), said_,
             response->mutable_members(), response);
    for (v1::GroupMember& member : *response->mutable_members()) {
      member.set_vehicle(member.vehicle() + said_);
    }
  }
  EndPage(request->page_token(), response->mutable_members(), response);
  return NextUnaryStatus();
}

grpc::Status FakeServer::AddInterVehicleLoopClosure(
    grpc::ServerContext*, const v1::AddInterVehicleLoopClosureRequest* request,
    v1::AddInterVehicleLoopClosureResponse* response) {
  {
    std::lock_guard<std::mutex> lock(mutex_);
    Group* const group = GroupOf(request->parent());
    if (group == nullptr) return NoGroup();
    v1::InterVehicleLoopClosure* const made = response->mutable_loop_closure();
    *made = request->loop_closure();
    const std::string id = request->loop_closure_id().empty()
                               ? std::to_string(group->links.size() + 1)
                               : request->loop_closure_id();
    made->set_name(request->parent() + "/loopClosures/" + id);
    made->set_decided_by("token:eva" + said_);
    made->set_note(made->note() + said_);
    group->links[made->name()] = *made;
    group->group.set_revision(group->group.revision() + 1);
    response->set_revision(group->group.revision());
    made->set_name(made->name() + said_);
  }
  return NextUnaryStatus();
}

grpc::Status FakeServer::ListInterVehicleLoopClosures(
    grpc::ServerContext*,
    const v1::ListInterVehicleLoopClosuresRequest* request,
    v1::ListInterVehicleLoopClosuresResponse* response) {
  {
    std::lock_guard<std::mutex> lock(mutex_);
    const Group* const group = GroupOf(request->parent());
    if (group == nullptr) return NoGroup();
    FillPage(group->links, request->page_token(), said_,
             response->mutable_loop_closures(), response);
  }
  EndPage(request->page_token(), response->mutable_loop_closures(), response);
  return NextUnaryStatus();
}

grpc::Status FakeServer::RejectInterVehicleCandidate(
    grpc::ServerContext*, const v1::RejectInterVehicleCandidateRequest* request,
    v1::RejectInterVehicleCandidateResponse* response) {
  {
    std::lock_guard<std::mutex> lock(mutex_);
    Group* const group = GroupOf(request->parent());
    if (group == nullptr) return NoGroup();
    v1::InterVehicleRejectedCandidate* const made =
        response->mutable_rejected_candidate();
    *made = request->rejected_candidate();
    const std::string id = request->rejected_candidate_id().empty()
                               ? std::to_string(group->rejected.size() + 1)
                               : request->rejected_candidate_id();
    made->set_name(request->parent() + "/rejectedCandidates/" + id);
    made->set_decided_by("token:eva" + said_);
    made->set_note(made->note() + said_);
    group->rejected[made->name()] = *made;
    group->group.set_revision(group->group.revision() + 1);
    response->set_revision(group->group.revision());
    made->set_name(made->name() + said_);
  }
  return NextUnaryStatus();
}

grpc::Status FakeServer::ListInterVehicleRejectedCandidates(
    grpc::ServerContext*,
    const v1::ListInterVehicleRejectedCandidatesRequest* request,
    v1::ListInterVehicleRejectedCandidatesResponse* response) {
  {
    std::lock_guard<std::mutex> lock(mutex_);
    const Group* const group = GroupOf(request->parent());
    if (group == nullptr) return NoGroup();
    FillPage(group->rejected, request->page_token(), said_,
             response->mutable_rejected_candidates(), response);
  }
  EndPage(request->page_token(), response->mutable_rejected_candidates(),
          response);
  return NextUnaryStatus();
}

grpc::Status FakeServer::DeleteInterVehicleRejectedCandidate(
    grpc::ServerContext*,
    const v1::DeleteInterVehicleRejectedCandidateRequest* request,
    v1::DeleteInterVehicleRejectedCandidateResponse* response) {
  NoteDeletion(request->name());
  {
    std::lock_guard<std::mutex> lock(mutex_);
    Group* const group = GroupOf(request->name());
    if (group == nullptr) return NoGroup();
    group->rejected.erase(request->name());
    group->group.set_revision(group->group.revision() + 1);
    response->set_revision(group->group.revision());
  }
  return NextUnaryStatus();
}

// Each member has one recording. The first page has those up to `vehicle`.
grpc::Status FakeServer::ListFrameTransforms(
    grpc::ServerContext*, const v1::ListFrameTransformsRequest* request,
    v1::ListFrameTransformsResponse* response) {
  {
    std::lock_guard<std::mutex> lock(mutex_);
    last_frames_ = *request;
    const Group* const group = GroupOf(request->parent());
    if (group == nullptr) return NoGroup();
    const bool is_first = request->page_token().empty();
    for (const auto& [name, member] : group->members) {
      if (is_first != (member.vehicle() <= request->vehicle())) continue;
      v1::FrameTransform* const transform = response->add_frame_transforms();
      transform->set_vehicle(member.vehicle() + said_);
      transform->set_recording(member.vehicle() + "/recordings/1" + said_);
      transform->set_frame_state(v1::FRAME_STATE_KNOWN);
      transform->set_loop_closure_count(3);
      transform->mutable_frame_pose()->set_x_meters(12.5);
      transform->mutable_frame_covariance()->set_form(
          v1::COVARIANCE_FORM_PLANAR_6);
      for (const double value : {4.0, 0.0, 0.0, 9.0, 0.0, 0.01}) {
        transform->mutable_frame_covariance()->add_values(value);
      }
      transform->mutable_frame_reference()->set_y_meters(7.0);
    }
    response->set_group_revision(group->group.revision() +
                                 (is_first ? 0 : revision_step_));
    if (is_first) response->set_next_page_token("2");
  }
  EndPage(request->page_token(), response->mutable_frame_transforms(),
          response);
  return NextUnaryStatus();
}

grpc::Status FakeServer::DeleteInterVehicleLoopClosure(
    grpc::ServerContext*,
    const v1::DeleteInterVehicleLoopClosureRequest* request,
    v1::DeleteInterVehicleLoopClosureResponse* response) {
  NoteDeletion(request->name());
  {
    std::lock_guard<std::mutex> lock(mutex_);
    Group* const group = GroupOf(request->name());
    if (group == nullptr) return NoGroup();
    group->links.erase(request->name());
    group->group.set_revision(group->group.revision() + 1);
    response->set_revision(group->group.revision());
  }
  return NextUnaryStatus();
}

}  // namespace revisit::client
