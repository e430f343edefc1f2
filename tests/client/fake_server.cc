#include "tests/client/fake_server.h"

#include <algorithm>

#include "client/revisit/pose_columns.h"
#include "google/protobuf/util/field_mask_util.h"
#include "google/rpc/error_details.pb.h"
#include "google/rpc/status.pb.h"
#include "grpcpp/security/server_credentials.h"
#include "grpcpp/server_builder.h"
#include "tests/client/expanded_poses.h"

namespace revisit::client {

grpc::Status MakeStatus(grpc::StatusCode code, const std::string& message,
                        const StatusDetails& details) {
  google::rpc::Status status;
  status.set_code(code);
  status.set_message(message);
  if (!details.reason.empty()) {
    google::rpc::ErrorInfo info;
    info.set_reason(details.reason);
    info.set_domain("revisit");
    for (const auto& [key, value] : details.metadata) {
      (*info.mutable_metadata())[key] = value;
    }
    status.add_details()->PackFrom(info);
  }
  if (!details.violations.empty()) {
    google::rpc::BadRequest bad;
    for (const auto& [field, description] : details.violations) {
      auto* violation = bad.add_field_violations();
      violation->set_field(field);
      violation->set_description(description);
    }
    status.add_details()->PackFrom(bad);
  }
  if (details.retry_delay.has_value()) {
    google::rpc::RetryInfo retry;
    const auto ms = details.retry_delay->count();
    retry.mutable_retry_delay()->set_seconds(ms / 1000);
    retry.mutable_retry_delay()->set_nanos(
        static_cast<std::int32_t>(ms % 1000) * 1'000'000);
    status.add_details()->PackFrom(retry);
  }
  return grpc::Status(code, message, status.SerializeAsString());
}

FakeServer::FakeServer() {
  candidates_.set_empty_reason(v1::EMPTY_REASON_PATH_TOO_SHORT);
  Start();
}

FakeServer::~FakeServer() { Stop(); }

void FakeServer::Start() {
  grpc::ServerBuilder builder;
  int port = 0;
  builder.AddListeningPort(address_.empty() ? "127.0.0.1:0" : address_,
                           grpc::InsecureServerCredentials(), &port);
  builder.RegisterService(this);
  {
    std::lock_guard<std::mutex> lock(mutex_);
    stopping_ = false;
  }
  server_ = builder.BuildAndStart();
  if (address_.empty()) address_ = "127.0.0.1:" + std::to_string(port);
}

void FakeServer::Stop() {
  if (server_ == nullptr) return;
  {
    std::lock_guard<std::mutex> lock(mutex_);
    stopping_ = true;
  }
  changed_.notify_all();
  server_->Shutdown(std::chrono::system_clock::now());
  server_->Wait();
  server_.reset();
}

void FakeServer::FailOpens(std::function<StreamFault()> faults) {
  std::lock_guard<std::mutex> lock(mutex_);
  open_faults_ = std::move(faults);
}

void FakeServer::FailBatches(std::function<StreamFault()> faults) {
  std::lock_guard<std::mutex> lock(mutex_);
  batch_faults_ = std::move(faults);
}

void FakeServer::FailUnaryCalls(std::vector<grpc::Status> statuses) {
  std::lock_guard<std::mutex> lock(mutex_);
  unary_statuses_.assign(statuses.begin(), statuses.end());
}

void FakeServer::HoldStreams(bool held) {
  std::lock_guard<std::mutex> lock(mutex_);
  held_ = held;
  changed_.notify_all();
}

void FakeServer::Replace(const std::string& uid, const v1::PoseBatch& poses) {
  std::lock_guard<std::mutex> lock(mutex_);
  uid_ = uid;
  stored_.clear();
  for (const v1::Pose& pose : poses.poses()) {
    stored_.push_back(pose.SerializeAsString());
  }
}

void FakeServer::CheckUid(bool check) {
  std::lock_guard<std::mutex> lock(mutex_);
  check_uid_ = check;
}

void FakeServer::Forget(std::uint64_t durable_sequence) {
  std::lock_guard<std::mutex> lock(mutex_);
  stored_.resize(durable_sequence);
}

void FakeServer::CheckAckedSequence(bool check) {
  std::lock_guard<std::mutex> lock(mutex_);
  check_acked_ = check;
}

void FakeServer::set_check_interval(std::uint64_t poses) {
  std::lock_guard<std::mutex> lock(mutex_);
  check_interval_ = poses;
}

void FakeServer::set_max_batch_poses(int poses) {
  std::lock_guard<std::mutex> lock(mutex_);
  max_batch_poses_ = poses;
}

void FakeServer::set_candidates(const v1::CandidateSet& candidates) {
  std::lock_guard<std::mutex> lock(mutex_);
  candidates_ = candidates;
}

std::vector<std::string> FakeServer::Stored() const {
  std::lock_guard<std::mutex> lock(mutex_);
  return stored_;
}

std::uint64_t FakeServer::durable_sequence() const {
  std::lock_guard<std::mutex> lock(mutex_);
  return stored_.size();
}

std::vector<std::uint64_t> FakeServer::Opens() const {
  std::lock_guard<std::mutex> lock(mutex_);
  return opens_;
}

std::vector<std::string> FakeServer::OpenUids() const {
  std::lock_guard<std::mutex> lock(mutex_);
  return open_uids_;
}

std::vector<std::int64_t> FakeServer::FirstSteps() const {
  std::lock_guard<std::mutex> lock(mutex_);
  return first_steps_;
}

int FakeServer::unary_calls() const {
  std::lock_guard<std::mutex> lock(mutex_);
  return unary_calls_;
}

std::vector<std::string> FakeServer::Routes() const {
  std::lock_guard<std::mutex> lock(mutex_);
  return routes_;
}

std::vector<std::string> FakeServer::Deleted() const {
  std::lock_guard<std::mutex> lock(mutex_);
  return deleted_;
}

void FakeServer::TakeColumns(bool take) {
  std::lock_guard<std::mutex> lock(mutex_);
  takes_columns_ = take;
}

int FakeServer::column_batches() const {
  std::lock_guard<std::mutex> lock(mutex_);
  return column_batches_;
}

int FakeServer::column_pages() const {
  std::lock_guard<std::mutex> lock(mutex_);
  return column_pages_;
}

int FakeServer::largest_batch() const {
  std::lock_guard<std::mutex> lock(mutex_);
  return largest_batch_;
}

grpc::Status FakeServer::NextUnaryStatus() {
  std::lock_guard<std::mutex> lock(mutex_);
  ++unary_calls_;
  if (unary_statuses_.empty()) return grpc::Status::OK;
  grpc::Status status = unary_statuses_.front();
  unary_statuses_.pop_front();
  return status;
}

void FakeServer::NoteRoute(const grpc::ServerContext& context) {
  const auto& headers = context.client_metadata();
  const auto route = headers.find("x-revisit-owner");
  routes_.push_back(route == headers.end() ? ""
                                           : std::string(route->second.data(),
                                                         route->second.size()));
}

void FakeServer::EndListsLike(ListEnd end) {
  std::lock_guard<std::mutex> lock(mutex_);
  list_end_ = end;
}

void FakeServer::Say(const std::string& text) {
  std::lock_guard<std::mutex> lock(mutex_);
  said_ = text;
}

std::string FakeServer::Said() const {
  std::lock_guard<std::mutex> lock(mutex_);
  return said_;
}

void FakeServer::Describe(v1::Vehicle* vehicle) const {
  const std::string said = Said();
  if (said.empty()) return;
  vehicle->set_name(vehicle->name() + said);
  vehicle->set_display_name(said);
  (*vehicle->mutable_labels())[said] = said;
  vehicle->add_findings()->set_message(said);
}

void FakeServer::Describe(v1::Check* check) const {
  const std::string said = Said();
  check->set_name(check->name() + said);
  for (v1::CheckCandidate& candidate : *check->mutable_states()) {
    candidate.set_name(candidate.name() + said);
    candidate.set_actor(candidate.actor() + said);
    candidate.set_decision(candidate.decision() + said);
  }
}

void FakeServer::Describe(v1::WatchCandidatesResponse* event) const {
  const std::string said = Said();
  event->set_cursor(event->cursor() + said);
  if (!event->has_candidate()) return;
  v1::CandidateEvent* const told = event->mutable_candidate();
  told->set_check(told->check() + said);
  told->mutable_candidate()->set_name(told->candidate().name() + said);
}

namespace {

template <typename Change>
void ForCandidates(std::vector<v1::Check>* checks, const Change& change) {
  for (v1::Check& check : *checks) {
    for (v1::CheckCandidate& one : *check.mutable_states()) change(&one);
  }
}

// The value of the most valuable open candidate; below 0 if there is none.
double ValueOf(const v1::Check& check) {
  double value = -1.0;
  for (const v1::CheckCandidate& one : check.states()) {
    if (one.state() == v1::CANDIDATE_STATE_OPEN) {
      // As the real one.
      value = std::max(value, one.cause() == v1::CANDIDATE_CAUSE_CONTRADICTION
                                  ? 1e300
                                  : one.value_square_meters());
    }
  }
  return value;
}

}  // namespace

template <typename Pair>
void FakeServer::NoteDecision(const std::string& decision,
                              const std::string& candidate, const Pair& pair,
                              const std::string& made) {
  std::lock_guard<std::mutex> lock(mutex_);
  if (candidate.empty()) return;
  ForCandidates(&checks_, [&](v1::CheckCandidate* one) {
    if (one->name() != candidate) return;
    const bool confirms = decision == "confirm";
    one->set_state(confirms ? v1::CANDIDATE_STATE_CONFIRMED
                            : v1::CANDIDATE_STATE_REJECTED);
    one->set_cause(confirms ? v1::CANDIDATE_CAUSE_LOOP_CLOSURE
                            : v1::CANDIDATE_CAUSE_REJECTION);
    one->set_decision(made);
  });
  decisions_.push_back(decision + " " + candidate + " " +
                       std::to_string(pair.query_sequence()) + "-" +
                       std::to_string(pair.matched_sequence()));
}

void FakeServer::NoteDeletion(const std::string& name) {
  std::lock_guard<std::mutex> lock(mutex_);
  deleted_.push_back(name);
  ForCandidates(&checks_, [&name](v1::CheckCandidate* one) {
    if (one->decision() != name) return;
    one->set_state(v1::CANDIDATE_STATE_OPEN);
    one->set_cause(v1::CANDIDATE_CAUSE_DELETION);
    one->clear_decision();
  });
}

grpc::Status FakeServer::CreateVehicle(grpc::ServerContext*,
                                       const v1::CreateVehicleRequest* request,
                                       v1::CreateVehicleResponse* response) {
  *response->mutable_vehicle() = request->vehicle();
  response->mutable_vehicle()->set_name("vehicles/" + request->vehicle_id());
  Describe(response->mutable_vehicle());
  return NextUnaryStatus();
}

grpc::Status FakeServer::GetVehicle(grpc::ServerContext* context,
                                    const v1::GetVehicleRequest* request,
                                    v1::GetVehicleResponse* response) {
  {
    std::lock_guard<std::mutex> lock(mutex_);
    NoteRoute(*context);
  }
  v1::Vehicle* vehicle = response->mutable_vehicle();
  vehicle->set_name(request->name());
  vehicle->mutable_settings()->set_state_space(v1::STATE_SPACE_PLANAR);
  vehicle->set_state(v1::VEHICLE_STATE_ACTIVE);
  vehicle->set_durable_sequence(durable_sequence());
  Describe(vehicle);
  return NextUnaryStatus();
}

grpc::Status FakeServer::UpdateVehicle(grpc::ServerContext*,
                                       const v1::UpdateVehicleRequest* request,
                                       v1::UpdateVehicleResponse* response) {
  google::protobuf::util::FieldMaskUtil::MergeMessageTo(
      request->vehicle(), request->update_mask(),
      google::protobuf::util::FieldMaskUtil::MergeOptions(),
      response->mutable_vehicle());
  response->mutable_vehicle()->set_name(request->vehicle().name());
  Describe(response->mutable_vehicle());
  return NextUnaryStatus();
}

grpc::Status FakeServer::ListVehicles(grpc::ServerContext*,
                                      const v1::ListVehiclesRequest* request,
                                      v1::ListVehiclesResponse* response) {
  // Two pages.
  if (request->page_token().empty()) {
    response->add_vehicles()->set_name("vehicles/first");
    response->set_next_page_token("second page");
  } else {
    response->add_vehicles()->set_name("vehicles/second");
  }
  Describe(response->mutable_vehicles(0));
  EndPage(request->page_token(), response->mutable_vehicles(), response);
  return NextUnaryStatus();
}

grpc::Status FakeServer::DeleteVehicle(grpc::ServerContext* context,
                                       const v1::DeleteVehicleRequest* request,
                                       v1::DeleteVehicleResponse*) {
  {
    std::lock_guard<std::mutex> lock(mutex_);
    NoteRoute(*context);
  }
  NoteDeletion(request->name());
  return NextUnaryStatus();
}

std::vector<v1::FindCandidatesRequest> FakeServer::Searches() const {
  std::lock_guard<std::mutex> lock(mutex_);
  return searches_;
}

grpc::Status FakeServer::FindCandidates(
    grpc::ServerContext*, const v1::FindCandidatesRequest* request,
    v1::FindCandidatesResponse* response) {
  {
    std::lock_guard<std::mutex> lock(mutex_);
    searches_.push_back(*request);
    *response->mutable_candidates() = candidates_;
  }
  return NextUnaryStatus();
}

void FakeServer::set_checks(std::vector<v1::Check> checks) {
  std::lock_guard<std::mutex> lock(mutex_);
  checks_ = std::move(checks);
}

void FakeServer::AddEvent(v1::WatchCandidatesResponse event) {
  std::lock_guard<std::mutex> lock(mutex_);
  event.set_cursor("at " + std::to_string(events_.size() + 1));
  events_.push_back(std::move(event));
  changed_.notify_all();
}

void FakeServer::FailWatches(
    std::function<std::optional<grpc::Status>(const WatchStep&)> faults) {
  std::lock_guard<std::mutex> lock(mutex_);
  watch_faults_ = std::move(faults);
}

std::vector<std::string> FakeServer::WatchCursors() const {
  std::lock_guard<std::mutex> lock(mutex_);
  return watch_cursors_;
}

std::vector<v1::ListChecksRequest> FakeServer::CheckLists() const {
  std::lock_guard<std::mutex> lock(mutex_);
  return check_lists_;
}

void FakeServer::ChangeChecks(
    std::function<void(std::vector<v1::Check>*)> change) {
  std::lock_guard<std::mutex> lock(mutex_);
  change_checks_ = std::move(change);
}

void FakeServer::set_contradictions(
    const v1::FindContradictionsResponse& found) {
  std::lock_guard<std::mutex> lock(mutex_);
  contradictions_ = found;
}

std::vector<v1::AddLoopClosureRequest> FakeServer::AddedClosures() const {
  std::lock_guard<std::mutex> lock(mutex_);
  return added_closures_;
}

grpc::Status FakeServer::FindContradictions(
    grpc::ServerContext*, const v1::FindContradictionsRequest*,
    v1::FindContradictionsResponse* response) {
  {
    std::lock_guard<std::mutex> lock(mutex_);
    *response = contradictions_;
  }
  for (v1::Contradiction& one : *response->mutable_contradictions()) {
    one.set_loop_closure(one.loop_closure() + Said());
  }
  return NextUnaryStatus();
}

std::vector<std::string> FakeServer::Decisions() const {
  std::lock_guard<std::mutex> lock(mutex_);
  return decisions_;
}

grpc::Status FakeServer::GetCheck(grpc::ServerContext*,
                                  const v1::GetCheckRequest* request,
                                  v1::GetCheckResponse* response) {
  {
    std::lock_guard<std::mutex> lock(mutex_);
    if (change_checks_) change_checks_(&checks_);
    for (const v1::Check& check : checks_) {
      if (check.name() == request->name()) *response->mutable_check() = check;
    }
  }
  if (!response->has_check()) {
    return MakeStatus(grpc::StatusCode::NOT_FOUND, "no such check",
                      {"CHECK_NOT_FOUND"});
  }
  Describe(response->mutable_check());
  return NextUnaryStatus();
}

grpc::Status FakeServer::ListChecks(grpc::ServerContext*,
                                    const v1::ListChecksRequest* request,
                                    v1::ListChecksResponse* response) {
  constexpr int kPage = 2;
  const auto matches = [request](const v1::Check& check) {
    const auto& states = request->filter().states();
    return std::any_of(check.states().begin(), check.states().end(),
                       [&states](const v1::CheckCandidate& candidate) {
                         return states.empty() ||
                                std::find(states.begin(), states.end(),
                                          candidate.state()) != states.end();
                       });
  };
  {
    std::lock_guard<std::mutex> lock(mutex_);
    check_lists_.push_back(*request);
    std::size_t next =
        request->page_token().empty() ? 0 : std::stoul(request->page_token());
    if (next == 0) {
      response->set_watch_cursor("at " + std::to_string(events_.size()));
    }
    if (change_checks_) change_checks_(&checks_);
    std::vector<v1::Check> checks = checks_;
    if (request->order() == v1::LIST_CHECKS_ORDER_BY_VALUE) {
      std::stable_sort(checks.begin(), checks.end(),
                       [](const v1::Check& a, const v1::Check& b) {
                         return ValueOf(a) > ValueOf(b);
                       });
    }
    while (next < checks.size() && response->checks_size() < kPage) {
      if (matches(checks[next])) *response->add_checks() = checks[next];
      ++next;
    }
    if (next < checks.size()) {
      response->set_next_page_token(std::to_string(next));
    }
  }
  for (v1::Check& check : *response->mutable_checks()) Describe(&check);
  EndPage(request->page_token(), response->mutable_checks(), response);
  return NextUnaryStatus();
}

grpc::Status FakeServer::WatchCandidates(
    grpc::ServerContext* context, const v1::WatchCandidatesRequest* request,
    grpc::ServerWriter<v1::WatchCandidatesResponse>* writer) {
  std::unique_lock<std::mutex> lock(mutex_);
  watch_cursors_.push_back(request->cursor());
  changed_.notify_all();
  WatchStep step = {request->cursor()};
  if (watch_faults_) {
    if (const auto status = watch_faults_(step)) return *status;
  }
  std::size_t next = events_.size();
  if (request->cursor().rfind("at ", 0) == 0) {
    next = std::stoul(request->cursor().substr(3));
  } else if (!request->cursor().empty()) {
    return MakeStatus(grpc::StatusCode::INVALID_ARGUMENT, "no cursor",
                      {"INVALID_CURSOR"});
  }
  v1::WatchCandidatesResponse beat;
  beat.set_cursor("at " + std::to_string(next));
  beat.mutable_beat();
  lock.unlock();
  writer->Write(beat);
  lock.lock();
  while (!context->IsCancelled() && !stopping_) {
    if (next >= events_.size()) {
      changed_.wait_for(lock, std::chrono::milliseconds(2));
      continue;
    }
    v1::WatchCandidatesResponse event = events_[next++];
    lock.unlock();
    Describe(&event);
    writer->Write(event);
    lock.lock();
    ++step.told;
    if (!watch_faults_) continue;
    if (const auto status = watch_faults_(step)) return *status;
  }
  return grpc::Status::CANCELLED;
}

grpc::Status FakeServer::AddLoopClosure(
    grpc::ServerContext*, const v1::AddLoopClosureRequest* request,
    v1::AddLoopClosureResponse* response) {
  const std::string id =
      request->loop_closure_id().empty() ? "new" : request->loop_closure_id();
  const std::string name = request->parent() + "/loopClosures/" + id;
  {
    std::lock_guard<std::mutex> lock(mutex_);
    added_closures_.push_back(*request);
  }
  NoteDecision("confirm", request->candidate(), request->loop_closure(), name);
  *response->mutable_loop_closure() = request->loop_closure();
  response->mutable_loop_closure()->set_name(name + Said());
  response->set_revision(7);
  return NextUnaryStatus();
}

grpc::Status FakeServer::RejectCandidate(
    grpc::ServerContext*, const v1::RejectCandidateRequest* request,
    v1::RejectCandidateResponse* response) {
  NoteDecision("reject", request->candidate(), request->rejected_candidate(),
               request->parent() + "/rejectedCandidates/new");
  *response->mutable_rejected_candidate() = request->rejected_candidate();
  response->mutable_rejected_candidate()->set_name(
      request->parent() + "/rejectedCandidates/new" + Said());
  response->set_revision(8);
  return NextUnaryStatus();
}

grpc::Status FakeServer::ListRejectedCandidates(
    grpc::ServerContext*, const v1::ListRejectedCandidatesRequest* request,
    v1::ListRejectedCandidatesResponse* response) {
  v1::RejectedCandidate* rejected = response->add_rejected_candidates();
  const std::string names = request->parent() + "/rejectedCandidates/";
  if (request->page_token().empty()) {
    rejected->set_name(names + "first");
    response->set_next_page_token("second page");
  } else {
    rejected->set_name(names + "second");
    rejected->set_note("a bridge\n\tabove" + Said());
  }
  rejected->set_name(rejected->name() + Said());
  EndPage(request->page_token(), response->mutable_rejected_candidates(),
          response);
  return NextUnaryStatus();
}

grpc::Status FakeServer::DeleteRejectedCandidate(
    grpc::ServerContext*, const v1::DeleteRejectedCandidateRequest* request,
    v1::DeleteRejectedCandidateResponse* response) {
  NoteDeletion(request->name());
  response->set_revision(9);
  return NextUnaryStatus();
}

grpc::Status FakeServer::ListLoopClosures(
    grpc::ServerContext*, const v1::ListLoopClosuresRequest* request,
    v1::ListLoopClosuresResponse* response) {
  const auto add = [&](const std::string& id, std::uint64_t query,
                       std::uint64_t matched) {
    v1::LoopClosure* closure = response->add_loop_closures();
    closure->set_name(request->parent() + "/loopClosures/" + id + Said());
    closure->set_note(Said());
    closure->set_query_sequence(query);
    closure->set_matched_sequence(matched);
  };
  if (request->page_token().empty()) {
    add("150-20", 150, 20);
    response->mutable_loop_closures(0)->set_decided_by("token:eva" + Said());
    response->set_next_page_token("second page");
  } else {
    add("160-30", 160, 30);
    add("again", 160, 30);
  }
  EndPage(request->page_token(), response->mutable_loop_closures(), response);
  return NextUnaryStatus();
}

grpc::Status FakeServer::DeleteLoopClosure(
    grpc::ServerContext*, const v1::DeleteLoopClosureRequest* request,
    v1::DeleteLoopClosureResponse* response) {
  NoteDeletion(request->name());
  response->set_revision(10);
  return NextUnaryStatus();
}

grpc::Status FakeServer::ListDeletedPosePairs(
    grpc::ServerContext*, const v1::ListDeletedPosePairsRequest* request,
    v1::ListDeletedPosePairsResponse* response) {
  const std::string names = request->parent() + Said() + "/deletedPosePairs/";
  v1::DeletedPosePair* const deleted = response->add_deleted_pose_pairs();
  if (request->page_token().empty()) {
    deleted->set_name(names + "10");
    deleted->set_deleted_by("token:tom" + Said());
    v1::LoopClosure* const closure = deleted->mutable_loop_closure();
    closure->set_query_sequence(150);
    closure->set_matched_sequence(20);
    closure->set_decided_by("token:eva" + Said());
    response->set_next_page_token("second page");
  } else {
    deleted->set_name(names + "9");
    deleted->mutable_rejected_candidate()->set_query_sequence(160);
    deleted->mutable_rejected_candidate()->set_note("a bridge\n\tabove" +
                                                    Said());
  }
  EndPage(request->page_token(), response->mutable_deleted_pose_pairs(),
          response);
  return NextUnaryStatus();
}

void FakeServer::AnswerColumns(v1::ListPosesResponse* page) {
  std::lock_guard<std::mutex> lock(mutex_);
  if (!takes_columns_ || page->poses().empty()) return;
  std::vector<const v1::Pose*> poses;
  for (const v1::Pose& pose : page->poses()) poses.push_back(&pose);
  if (const auto whole = PoseColumnsOf(poses)) {
    *page->add_columns() = *whole;
  } else {
    for (const v1::Pose* const pose : poses) {
      const auto alone = PoseColumnsOf({pose});
      if (!alone) return page->clear_columns();
      *page->add_columns() = *alone;
    }
  }
  page->clear_poses();
  ++column_pages_;
}

grpc::Status FakeServer::ListPoses(grpc::ServerContext*,
                                   const v1::ListPosesRequest* request,
                                   v1::ListPosesResponse* response) {
  {
    std::lock_guard<std::mutex> lock(mutex_);
    std::size_t next =
        request->page_token().empty()
            ? std::max<std::uint64_t>(request->first_sequence(), 1) - 1
            : std::stoul(request->page_token());
    while (next < stored_.size() &&
           response->poses_size() < request->page_size()) {
      response->add_poses()->ParseFromString(stored_[next++]);
    }
    if (next < stored_.size()) {
      response->set_next_page_token(std::to_string(next));
    }
  }
  EndPage(request->page_token(), response->mutable_poses(), response);
  if (request->as_columns()) AnswerColumns(response);
  return NextUnaryStatus();
}

void FakeServer::set_recordings(std::vector<v1::Recording> recordings) {
  std::lock_guard<std::mutex> lock(mutex_);
  recordings_ = std::move(recordings);
}

grpc::Status FakeServer::ListRecordings(
    grpc::ServerContext*, const v1::ListRecordingsRequest* request,
    v1::ListRecordingsResponse* response) {
  constexpr int kPage = 2;
  {
    const std::string said = Said();
    std::lock_guard<std::mutex> lock(mutex_);
    std::size_t next =
        request->page_token().empty() ? 0 : std::stoul(request->page_token());
    while (next < recordings_.size() && response->recordings_size() < kPage) {
      v1::Recording* const recording = response->add_recordings();
      *recording = recordings_[next++];
      recording->set_name(recording->name() + said);
      recording->set_label(recording->label() + said);
    }
    if (next < recordings_.size()) {
      response->set_next_page_token(std::to_string(next));
    }
  }
  EndPage(request->page_token(), response->mutable_recordings(), response);
  return NextUnaryStatus();
}

grpc::Status FakeServer::GetServerInfo(grpc::ServerContext*,
                                       const v1::GetServerInfoRequest*,
                                       v1::GetServerInfoResponse* response) {
  response->set_version("1.2.3" + Said());
  response->set_over_all_tenants(true);
  response->set_durability(v1::DURABILITY_LOCAL);
  response->set_max_message_bytes(4194304);
  response->set_durability_settings("fsync=on" + Said());
  v1::StoreServer* const server = response->add_servers();
  server->set_address("10.0.0.2:50051" + Said());
  server->set_owned_vehicle_count(12);
  return NextUnaryStatus();
}

grpc::Status FakeServer::ExportPoseGraph(
    grpc::ServerContext*, const v1::ExportPoseGraphRequest* request,
    grpc::ServerWriter<v1::ExportPoseGraphResponse>* writer) {
  v1::ExportPoseGraphResponse part;
  part.mutable_vehicle()->set_name(request->vehicle());
  Describe(part.mutable_vehicle());
  writer->Write(part);
  part.Clear();
  for (int i = 0; i < 2; ++i) {
    v1::Node* node = part.add_nodes();
    node->set_index(i);
    node->set_sequence(static_cast<std::uint64_t>(i) + 1);
    node->set_travelled_meters(2.0 * i);
    node->mutable_pose()->set_x_meters(2.0 * i);
    node->mutable_covariance()->set_form(v1::COVARIANCE_FORM_PLANAR_6);
    for (const double value : {0.25, 0.0, 0.0, 0.25, 0.0, 1e-4}) {
      node->mutable_covariance()->add_values(value);
    }
  }
  v1::Edge* edge = part.add_edges();
  edge->set_to_index(1);
  edge->set_kind(v1::EDGE_KIND_CONSECUTIVE);
  writer->Write(part);
  return NextUnaryStatus();
}

grpc::Status FakeServer::Store(const v1::PoseBatch& batch) {
  largest_batch_ = std::max(largest_batch_, batch.poses_size());
  for (const v1::Pose& pose : batch.poses()) {
    if (pose.sequence() > stored_.size() + 1) {
      return MakeStatus(grpc::StatusCode::FAILED_PRECONDITION, "gap",
                        {"SEQUENCE_GAP", {}, {}, {}});
    }
    const std::string bytes = pose.SerializeAsString();
    if (pose.sequence() == stored_.size() + 1) {
      stored_.push_back(bytes);
    } else if (stored_[pose.sequence() - 1] != bytes) {
      return MakeStatus(grpc::StatusCode::ALREADY_EXISTS, "other content",
                        {"SEQUENCE_CONTENT_MISMATCH", {}, {}, {}});
    }
  }
  return grpc::Status::OK;
}

grpc::Status FakeServer::StreamPoses(
    grpc::ServerContext* context,
    grpc::ServerReaderWriter<v1::StreamPosesResponse, v1::StreamPosesRequest>*
        stream) {
  using Kind = StreamFault::Kind;
  v1::StreamPosesRequest request;
  v1::StreamPosesResponse response;
  if (!stream->Read(&request)) return grpc::Status::OK;
  const v1::StreamPosesOpen open = request.open();
  std::unique_lock<std::mutex> lock(mutex_);
  const auto go_on = [this] { return !held_ || stopping_; };
  const auto silence = [&] {
    while (!context->IsCancelled() && !stopping_) {
      changed_.wait_for(lock, std::chrono::milliseconds(2));
    }
    return grpc::Status::CANCELLED;
  };
  NoteRoute(*context);
  opens_.push_back(open.acked_sequence());
  open_uids_.push_back(open.vehicle_uid());
  if (open_faults_) {
    const StreamFault fault = open_faults_();
    if (fault.kind == Kind::kSilence) return silence();
    if (fault.kind != Kind::kNone) return fault.status;
  }
  if (check_uid_ && !open.vehicle_uid().empty() && open.vehicle_uid() != uid_) {
    return MakeStatus(grpc::StatusCode::FAILED_PRECONDITION,
                      "another vehicle of this name",
                      {"VEHICLE_REPLACED", {}, {}, {}});
  }
  if (check_acked_ && open.acked_sequence() > stored_.size()) {
    return MakeStatus(grpc::StatusCode::DATA_LOSS,
                      "acknowledged poses are gone",
                      {"DURABLE_SEQUENCE_REGRESSED", {}, {}, {}});
  }
  const std::uint64_t told = stored_.size();
  bool first = opens_.size() > 1;
  response.mutable_opened()->set_durable_sequence(told);
  response.mutable_opened()->set_max_batch_poses(max_batch_poses_);
  response.mutable_opened()->set_vehicle_uid(uid_);
  response.mutable_opened()->set_takes_pose_columns(takes_columns_);
  lock.unlock();
  stream->Write(response);
  while (stream->Read(&request)) {
    lock.lock();
    if (request.batch().has_columns()) ++column_batches_;
    *request.mutable_batch() = Expanded(request.batch());
    changed_.wait(lock, go_on);
    if (first) {
      first = false;
      first_steps_.push_back(
          static_cast<std::int64_t>(request.batch().poses(0).sequence()) -
          static_cast<std::int64_t>(told));
    }
    const StreamFault fault = batch_faults_ ? batch_faults_() : StreamFault();
    if (fault.kind == Kind::kBefore) return fault.status;
    if (fault.kind == Kind::kSilence) return silence();
    const std::uint64_t before = stored_.size();
    const grpc::Status status = Store(request.batch());
    if (!status.ok()) return status;
    if (fault.kind == Kind::kLoseAck) return fault.status;
    const std::uint64_t after = stored_.size();
    const std::uint64_t interval = check_interval_;
    const v1::CandidateSet candidates = candidates_;
    const std::string said = said_;
    lock.unlock();
    response.mutable_ack()->set_durable_sequence(after);
    if (!said.empty())
      response.mutable_ack()->add_warnings()->set_message(said);
    stream->Write(response);
    if (fault.kind == Kind::kAfterAck) return fault.status;
    if (!open.send_candidates() || interval == 0) continue;
    for (std::uint64_t check = (before / interval + 1) * interval;
         check <= after; check += interval) {
      *response.mutable_candidates() = candidates;
      response.mutable_candidates()->mutable_query()->set_sequence(check);
      stream->Write(response);
    }
  }
  return context->IsCancelled() ? grpc::Status::CANCELLED : grpc::Status::OK;
}

}  // namespace revisit::client
