#include "server/fleet/group_searches.h"

#include <atomic>
#include <chrono>
#include <cstdint>
#include <functional>
#include <memory>
#include <mutex>
#include <set>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "gmock/gmock.h"
#include "google/protobuf/repeated_field.h"
#include "gtest/gtest.h"
#include "server/base/metrics.h"
#include "server/fleet/history_keeper.h"
#include "server/records/group_content.h"
#include "tests/server/error_matchers.h"
#include "tests/server/fleet/group_of_vehicles.h"
#include "tests/server/fleet/histories.h"
#include "tests/server/plain_codec.h"
#include "tests/server/sessions/session_testing.h"
#include "tests/server/storage_testing.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using ::testing::_;
using ::testing::ElementsAre;
using ::testing::IsEmpty;
using ::testing::Pointee;

using Ready = absl::StatusOr<GroupScope>;

auto IsNotReady() {
  return IsError(StatusCode::kUnavailable, "GROUP_NOT_READY", _);
}

// Where the frame of a first recording lies.
std::string DatumAt(double x) {
  const std::string empty;
  google::protobuf::RepeatedField<double> values;
  for (const double value : {9.0, 0.0, 0.0, 9.0, 0.0, 0.01}) values.Add(value);
  RecordingStartFields fields;
  fields.label = &empty;
  fields.relation = RecordingStartFields::Relation::kDatum;
  fields.covariance = CovarianceFields{CovarianceForm::kPlanar6, values};
  fields.datum_id = &empty;
  fields.datum_pose = {x, 0.0, 0.0, 0.0};
  return EncodeMemberContent(&fields);
}

std::vector<std::string> IdsOf(const GroupScope& scope) {
  std::vector<std::string> ids;
  for (const auto& history : scope.joined->histories) {
    ids.push_back(history->vehicle_id);
  }
  return ids;
}

std::string TextOf(const GroupScope& scope) {
  std::string text;
  for (const auto& history : scope.joined->histories) text += ToText(*history);
  return text;
}

double ValueOf(const GroupSearches& searches, const std::string& name) {
  Metrics metrics;
  searches.CollectMetrics(&metrics);
  for (const MetricFamily& family : metrics.families()) {
    if (family.name() == name) return family.samples().at(0).value;
  }
  ADD_FAILURE() << name;
  return 0.0;
}

class GroupSearchesTest : public GroupOfVehicles {
 protected:
  Ready Prepare(const ScopeRequest& request) {
    return *BeginToPrepare(request).Get();
  }

  Answer<std::shared_ptr<Ready>> BeginToPrepare(ScopeRequest request) {
    // The asking vehicle is in memory.
    const auto session = fleet_->Session(request.asking);
    EXPECT_THAT(ReadNow(*session), IsOk());
    return BeginToPrepareUnheld(std::move(request));
  }

  Answer<std::shared_ptr<Ready>> BeginToPrepareUnheld(ScopeRequest request) {
    if (!request.may_read) {
      request.may_read = [](const std::string&) { return true; };
    }
    Answer<std::shared_ptr<Ready>> answer;
    searches_->Prepare(std::move(request), [answer](Ready ready) {
      answer.Set(std::make_shared<Ready>(std::move(ready)));
    });
    return answer;
  }

  // Writes poses elsewhere.
  void AppendToStore(const std::string& id, std::uint64_t first,
                     std::uint32_t count) {
    const VehicleRecord row = *memory_.GetVehicle(id);
    EXPECT_THAT(BlockingWrites(&memory_).Append(row.key,
                                                {first, count, row.revision + 1,
                                                 SquareBatch(first, count)}),
                IsOk());
  }

  // Until searches use nothing that is known as it is.
  static void LetAllGetOld() {
    std::this_thread::sleep_for(kFreshHistory + std::chrono::milliseconds(200));
  }

  static ScopeRequest Asking(const std::string& id) {
    ScopeRequest request;
    request.group = "site";
    request.asking = id;
    return request;
  }

  // Once the histories are there.
  GroupScope Await(const ScopeRequest& request) {
    Ready ready = Prepare(request);
    while (absl::IsUnavailable(ready.status())) ready = Prepare(request);
    EXPECT_THAT(ready, IsOk());
    return *ready;
  }

  // Whether searches come to see this.
  bool ComeToSee(const ScopeRequest& request,
                 const std::function<bool(const GroupScope&)>& holds) {
    return Eventually([&] { return holds(Await(request)); });
  }
};

TEST_F(GroupSearchesTest, TakesVehiclesInMemoryAtOnce) {
  const Ready ready = Prepare(Asking("b"));
  ASSERT_THAT(ready, IsOk());
  EXPECT_THAT(IdsOf(*ready), ElementsAre("a", "b", "c"));
  EXPECT_EQ(ready->scope.asking, 1u);
  EXPECT_THAT(ready->absent, IsEmpty());
  EXPECT_EQ(ready->joined->group->version.revision, 4u);
}

TEST_F(GroupSearchesTest, ReadsOthersFromTheStoreWithTheSameBits) {
  const std::string in_memory = TextOf(*Prepare(Asking("b")));
  Start();
  memory_.HoldAllBut(KeyOf("b"));
  EXPECT_THAT(Prepare(Asking("b")), IsNotReady());
  memory_.Release();
  const GroupScope scope = Await(Asking("b"));
  EXPECT_EQ(TextOf(scope), in_memory);
  EXPECT_EQ(fleet_->SessionIfLoaded("a"), nullptr);
  EXPECT_EQ(fleet_->SessionIfLoaded("c"), nullptr);
}

TEST_F(GroupSearchesTest, AnswersInPartWhereThatIsAllowed) {
  Start();
  memory_.HoldAllBut(KeyOf("b"));
  ScopeRequest request = Asking("b");
  request.allow_partial = true;
  const Ready ready = Prepare(request);
  memory_.Release();
  ASSERT_THAT(ready, IsOk());
  EXPECT_THAT(IdsOf(*ready), ElementsAre("b"));
  ASSERT_EQ(ready->absent.size(), 2u);
  EXPECT_EQ(ready->absent[0].vehicle_id, "a");
  EXPECT_EQ(ready->absent[0].absence, Absence::kNotReady);
}

// Nobody holds a session of the asking vehicle.
TEST_F(GroupSearchesTest, ANeededVehicleIsReadFromTheStoreAsOthersAre) {
  Start();
  memory_.HoldAllBut(KeyOf("a"));
  ScopeRequest request = Asking("b");
  request.needs_asking = true;
  request.allow_partial = true;
  const auto prepare = [&] { return *BeginToPrepareUnheld(request).Get(); };
  EXPECT_THAT(prepare(), IsNotReady());
  memory_.Release();
  Ready ready = prepare();
  while (absl::IsUnavailable(ready.status())) ready = prepare();
  ASSERT_THAT(ready, IsOk());
  EXPECT_EQ(ready->joined->histories[*ready->scope.asking]->vehicle_id, "b");
  EXPECT_EQ(fleet_->SessionIfLoaded("b"), nullptr);
}

TEST_F(GroupSearchesTest, ANeededVehicleIsAMemberThatMayBeRead) {
  Create("d");
  AppendToStore("d", 1, 200);
  ScopeRequest request = Asking("d");
  EXPECT_THAT(BeginToPrepareUnheld(request).Get(), Pointee(IsOk()));
  request.needs_asking = true;
  EXPECT_THAT(BeginToPrepareUnheld(request).Get(),
              Pointee(IsError(StatusCode::kNotFound, "MEMBER_NOT_FOUND", _)));
  request.asking = "b";
  request.may_read = [](const std::string& id) { return id != "b"; };
  EXPECT_THAT(BeginToPrepareUnheld(request).Get(),
              Pointee(IsError(StatusCode::kNotFound, "MEMBER_NOT_FOUND", _)));
}

TEST_F(GroupSearchesTest, KeepsUpWithVehiclesWhereverTheyAre) {
  Start();
  EXPECT_EQ(Await(Asking("b")).joined->histories[0]->last_sequence, 200u);
  // In memory here from now on.
  Append("a", 201, 20);
  // And still elsewhere.
  AppendToStore("c", 201, 30);
  EXPECT_TRUE(ComeToSee(Asking("b"), [](const GroupScope& scope) {
    return scope.joined->histories[0]->last_sequence == 220 &&
           scope.joined->histories[2]->last_sequence == 230;
  }));
  EXPECT_EQ(fleet_->SessionIfLoaded("c"), nullptr);
}

TEST_F(GroupSearchesTest, ReadsTheRowsOfAllMembersTogether) {
  for (const char* id : {"d", "e", "f", "g"}) Make(id);
  Start();
  Await(Asking("b"));
  LetAllGetOld();
  const int alone = memory_.reads_of_one_row();
  const int together = memory_.reads_of_rows();
  EXPECT_THAT(Prepare(Asking("b")), IsOk());
  EXPECT_EQ(memory_.reads_of_rows(), together + 1);
  EXPECT_EQ(memory_.reads_of_one_row(), alone);
  // The asking one is in memory.
  EXPECT_THAT(memory_.last_rows(), ElementsAre("a", "c", "d", "e", "f", "g"));
}

TEST_F(GroupSearchesTest, ReadsARowOnceASecondAtMost) {
  Start();
  Await(Asking("b"));
  const auto begin = std::chrono::steady_clock::now();
  const int before = memory_.rows_read();
  for (int i = 0; i < 100; ++i) {
    EXPECT_THAT(Prepare(Asking("b")), IsOk());
  }
  const auto seconds =
      (std::chrono::steady_clock::now() - begin) / kFreshHistory;
  EXPECT_LE(memory_.rows_read() - before, 2 * (seconds + 1));
}

TEST_F(GroupSearchesTest, RowsThatAreReadTogetherSayWhatWasAdded) {
  Start();
  Await(Asking("b"));
  AppendToStore("a", 201, 20);
  AppendToStore("c", 201, 30);
  LetAllGetOld();
  const int alone = memory_.reads_of_one_row();
  const Ready ready = Prepare(Asking("b"));
  ASSERT_THAT(ready, IsOk());
  EXPECT_EQ(ready->joined->histories[0]->last_sequence, 220u);
  EXPECT_EQ(ready->joined->histories[2]->last_sequence, 230u);
  EXPECT_EQ(memory_.reads_of_one_row(), alone);
}

TEST_F(GroupSearchesTest, SeesVehiclesThatGoAndComeAgain) {
  Start();
  Await(Asking("b"));
  const auto is_gone = [](const GroupScope& scope) {
    return IdsOf(scope) == std::vector<std::string>{"a", "b"} &&
           scope.absent.empty();
  };
  const double bytes = ValueOf(*searches_, "revisit_followed_bytes");
  // Deleted after the group was read.
  memory_.LoseRowOf("c");
  EXPECT_TRUE(ComeToSee(Asking("b"), is_gone));
  EXPECT_LT(ValueOf(*searches_, "revisit_followed_bytes"), bytes);
  ASSERT_THAT(BlockingWrites(&memory_).Delete(KeyOf("c")), IsOk());
  memory_.LoseRowOf("");
  EXPECT_TRUE(ComeToSee(Asking("b"), is_gone));
  Create("c");
  AppendToStore("c", 1, 200);
  Join("c");
  const VehicleKey key = KeyOf("c");
  EXPECT_TRUE(ComeToSee(Asking("b"), [key](const GroupScope& scope) {
    return scope.joined->histories.size() == 3 &&
           scope.joined->histories[2]->key == key;
  }));
}

TEST_F(GroupSearchesTest, AStoreThatCannotBeReadLeavesWhatWasKnown) {
  Start();
  const GroupScope known = Await(Asking("b"));
  AppendToStore("c", 201, 30);
  LetAllGetOld();
  memory_.FailRows(true);
  const Ready ready = Prepare(Asking("b"));
  ASSERT_THAT(ready, IsOk());
  ASSERT_EQ(TextOf(*ready), TextOf(known));
  EXPECT_EQ(ready->as_of[2], known.as_of[2]);
  memory_.FailRows(false);
  EXPECT_TRUE(ComeToSee(Asking("b"), [&](const GroupScope& seen) {
    return seen.as_of[0] > known.as_of[0] &&
           seen.joined->histories[2]->last_sequence == 230;
  }));
}

// Else the poses that came with the old row would be those of another state.
TEST_F(GroupSearchesTest, ARowThatGotOldWhileItWaitedIsReadAgain) {
  for (const char* id : {"d", "e"}) Make(id);
  Start();
  Await(Asking("b"));
  for (const char* id : {"a", "c", "d", "e"}) AppendToStore(id, 201, 30);
  const std::uint64_t appended = memory_.GetVehicle("e")->revision;
  LetAllGetOld();
  memory_.HoldAllBut(KeyOf("b"));
  const Answer<std::shared_ptr<Ready>> answer = BeginToPrepare(Asking("b"));
  // No thread is left for the last one.
  ASSERT_TRUE(Eventually([&] { return memory_.held() == 3; }));
  ASSERT_THAT(BlockingWrites(&memory_).Revise(
                  KeyOf("e"), {{201, 30, appended + 1, SquareBatch(201, 30)}},
                  appended + 1),
              IsOk());
  LetAllGetOld();
  memory_.Release();
  const Ready ready = *answer.Get();
  ASSERT_THAT(ready, IsOk());
  EXPECT_NE(ready->joined->histories[4]->revision, appended);
  EXPECT_TRUE(ComeToSee(Asking("b"), [appended](const GroupScope& scope) {
    return scope.joined->histories[4]->revision == appended + 1;
  }));
}

TEST_F(GroupSearchesTest, SharesWhatIsJoinedWhileNothingChanges) {
  const GroupScope scope = Await(Asking("b"));
  EXPECT_EQ(Await(Asking("b")).joined, scope.joined);
  EXPECT_EQ(Await(Asking("a")).joined, scope.joined);
}

TEST_F(GroupSearchesTest, CallersSeeWhatTheyMayRead) {
  ScopeRequest some = Asking("b");
  some.may_read = [](const std::string& id) { return id != "a"; };
  EXPECT_THAT(IdsOf(Await(some)), ElementsAre("b", "c"));
  EXPECT_THAT(IdsOf(Await(Asking("b"))), ElementsAre("a", "b", "c"));
  EXPECT_THAT(IdsOf(Await(some)), ElementsAre("b", "c"));
  some.vehicles = {"a"};
  EXPECT_THAT(Prepare(some),
              IsError(StatusCode::kNotFound, "MEMBER_NOT_FOUND", _));
}

TEST_F(GroupSearchesTest, RefusesWhatIsNotThere) {
  ScopeRequest request = Asking("b");
  request.vehicles = {"a", "z"};
  EXPECT_THAT(Prepare(request),
              IsError(StatusCode::kNotFound, "MEMBER_NOT_FOUND", _));
  request = Asking("b");
  request.group = "elsewhere";
  EXPECT_THAT(Prepare(request),
              IsError(StatusCode::kNotFound, "GROUP_NOT_FOUND", _));
}

TEST_F(GroupSearchesTest, LooksInTheVehiclesThatAreNamed) {
  ScopeRequest request = Asking("b");
  request.vehicles = {"c"};
  const GroupScope scope = Await(request);
  // The others tie frames.
  EXPECT_THAT(IdsOf(scope), ElementsAre("a", "b", "c"));
  EXPECT_FALSE(scope.scope.Searches(0));
  EXPECT_TRUE(scope.scope.Searches(2));
}

TEST_F(GroupSearchesTest, AVehicleThatIsNoMemberMayAsk) {
  EXPECT_THAT(groups_.Change("site", {RemoveGroupMember{KeyOf("b")}}), IsOk());
  const GroupScope scope = Await(Asking("b"));
  EXPECT_THAT(IdsOf(scope), ElementsAre("a", "c"));
  EXPECT_FALSE(scope.scope.asking.has_value());
}

TEST_F(GroupSearchesTest, SeesChangesOfTheGroup) {
  const auto state_of_c = [](const GroupScope& scope) {
    const core::DriveView& asking = scope.joined->drives->view(1);
    const core::SeenFrames seen = scope.joined->drives->SeenFrom(
        asking.nodes(), asking.recordings, asking.graph.size() - 1, {},
        scope.scope.asking);
    const auto ties = seen.relations.From(seen.own);
    return ties[*scope.joined->drives->FrameOf(2, asking.nodes())].state;
  };
  EXPECT_EQ(state_of_c(Await(Asking("b"))), core::FrameState::kNone);
  ASSERT_THAT(
      groups_.Change("site", {SetGroupMember{{KeyOf("b"), DatumAt(5)}},
                              SetGroupMember{{KeyOf("c"), DatumAt(7)}}}),
      IsOk());
  EXPECT_TRUE(ComeToSee(Asking("b"), [&](const GroupScope& scope) {
    return state_of_c(scope) == core::FrameState::kDatum;
  }));
  GroupLinkRecord link;
  link.id = "link";
  link.query = {KeyOf("b"), 100};
  link.matched = {KeyOf("c"), 20};
  link.payload = EncodeLinkContent({});
  ASSERT_THAT(groups_.Change("site", {AddGroupLink{link}}), IsOk());
  EXPECT_TRUE(ComeToSee(Asking("b"), [&](const GroupScope& scope) {
    return state_of_c(scope) == core::FrameState::kProvisional;
  }));
  ASSERT_THAT(groups_.Change("site", {RemoveGroupMember{KeyOf("c")}}), IsOk());
  EXPECT_TRUE(ComeToSee(Asking("b"), [](const GroupScope& scope) {
    return IdsOf(scope) == std::vector<std::string>{"a", "b"};
  }));
}

TEST_F(GroupSearchesTest, NamesDamagedMembers) {
  memory_.DamagePose("c", 50);
  Start();
  const GroupScope scope = Await(Asking("b"));
  EXPECT_THAT(IdsOf(scope), ElementsAre("a", "b"));
  ASSERT_EQ(scope.absent.size(), 1u);
  EXPECT_EQ(scope.absent[0].vehicle_id, "c");
  EXPECT_EQ(scope.absent[0].absence, Absence::kDamaged);
}

// The mark is no change of the vehicle that its revision counts.
TEST_F(GroupSearchesTest, SeesThatDamageWasFoundInAMember) {
  Start();
  Await(Asking("b"));
  const VehicleRecord record = *memory_.GetVehicle("c");
  VehicleConfig config = *codec_.DecodeVehicle(record);
  config.damaged = true;
  ASSERT_THAT(BlockingWrites(&memory_).Update(record.key,
                                              codec_.EncodeVehicle(config), 0),
              IsOk());
  EXPECT_TRUE(ComeToSee(Asking("b"), [](const GroupScope& scope) {
    return scope.absent.size() == 1 &&
           scope.absent[0].absence == Absence::kDamaged;
  }));
}

TEST_F(GroupSearchesTest, NamesMembersForWhichThereIsNoRoom) {
  Start();
  Await(Asking("b"));
  EXPECT_EQ(ValueOf(*searches_, "revisit_followed_vehicles"), 2.0);
  options_.most_bytes = static_cast<std::int64_t>(
      ValueOf(*searches_, "revisit_followed_bytes") * 0.75);
  Start();
  // Two that are read at one time may both find no room at first.
  EXPECT_TRUE(ComeToSee(Asking("b"), [](const GroupScope& scope) {
    return scope.joined->histories.size() == 2 && scope.absent.size() == 1 &&
           scope.absent[0].absence == Absence::kMemory;
  }));
}

TEST_F(GroupSearchesTest, LetsGoWhatNobodyAsksFor) {
  Start();
  const auto joined =
      std::weak_ptr<const JoinedGroup>(Await(Asking("b")).joined);
  searches_->UnloadIdle(std::chrono::steady_clock::now());
  EXPECT_FALSE(joined.expired());
  EXPECT_TRUE(Eventually([&] {
    searches_->UnloadIdle(std::chrono::steady_clock::now() +
                          std::chrono::hours(1));
    // What the search held goes a moment after its answer.
    return joined.expired() &&
           ValueOf(*searches_, "revisit_followed_bytes") == 0.0;
  }));
}

}  // namespace
}  // namespace revisit::server
