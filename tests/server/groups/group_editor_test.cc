#include "server/groups/group_editor.h"

#include <chrono>
#include <future>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "server/base/status.h"
#include "server/sessions/executor.h"
#include "tests/server/error_matchers.h"
#include "tests/server/memory_storage.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using ::testing::_;

absl::Status Awaited() { return absl::OkStatus(); }

GroupRecord Group(const std::string& id, const std::string& uid,
                  const std::string& payload) {
  GroupRecord group;
  group.id = id;
  group.version.uid = uid;
  group.payload = payload;
  return group;
}

class GroupEditorTest : public testing::Test {
 protected:
  absl::StatusOr<GroupRecord> Create(const GroupRecord& group) {
    std::promise<absl::StatusOr<GroupRecord>> answer;
    editor_.Create(group, Awaited, [&](absl::StatusOr<GroupRecord> created) {
      answer.set_value(std::move(created));
    });
    return answer.get_future().get();
  }
  absl::StatusOr<GroupVersion> Change(GroupOrder order, GroupPlan plan) {
    std::promise<absl::StatusOr<GroupVersion>> answer;
    editor_.Change(std::move(order), std::move(plan),
                   [&](absl::StatusOr<GroupVersion> version) {
                     answer.set_value(std::move(version));
                   });
    return answer.get_future().get();
  }
  absl::StatusOr<GroupVersion> Delete(GroupOrder order) {
    return Change(std::move(order), nullptr);
  }
  // A write that another server makes.
  void RaiseRevision() {
    storage_.Groups().ChangeGroup("g", std::nullopt, {},
                                  [](const absl::StatusOr<std::uint64_t>&) {});
  }
  std::string PayloadOf(const std::string& id) {
    const auto group = storage_.Groups().GetGroup(id);
    return group.ok() ? group->payload : "none";
  }

  MemoryStorage storage_;
  Executor executor_{"groups", 3};
  GroupEditor editor_{&storage_, &executor_};
};

// Appends a letter to the payload that there is.
GroupPlan Append(const std::string& letter) {
  return [letter](const GroupRecord& group) {
    return GroupEdit{{SetGroupPayload{group.payload + letter}}};
  };
}

TEST_F(GroupEditorTest, GroupThatIsCreatedAgainIsTheOneThatIsThere) {
  const auto created = Create(Group("g", "one", "a"));
  ASSERT_THAT(created, IsOk());
  EXPECT_EQ(created->version, (GroupVersion{"one", 1}));
  const auto found = Create(Group("g", "two", "b"));
  ASSERT_THAT(found, IsOk());
  EXPECT_EQ(found->version, (GroupVersion{"one", 1}));
  EXPECT_EQ(found->payload, "a");
}

TEST_F(GroupEditorTest, ChangesGiveTheNextRevision) {
  ASSERT_THAT(Create(Group("g", "one", "a")), IsOk());
  const auto changed = Change({"g", 0, Awaited}, Append("b"));
  ASSERT_THAT(changed, IsOk());
  EXPECT_EQ(*changed, (GroupVersion{"one", 2}));
  EXPECT_EQ(PayloadOf("g"), "ab");
}

TEST_F(GroupEditorTest, NothingIsWrittenWhereNothingIsToChange) {
  ASSERT_THAT(Create(Group("g", "one", "a")), IsOk());
  const auto version =
      Change({"g", 0, Awaited}, [](const GroupRecord&) { return GroupEdit(); });
  ASSERT_THAT(version, IsOk());
  EXPECT_EQ(version->revision, 1u);
}

TEST_F(GroupEditorTest, AnotherRevisionThanTheExpectedOneIsRefused) {
  ASSERT_THAT(Create(Group("g", "one", "a")), IsOk());
  const auto refused = Change({"g", 2, Awaited}, Append("b"));
  EXPECT_THAT(refused, IsError(StatusCode::kAborted, "REVISION_MISMATCH", _));
  EXPECT_EQ(MetadataOf(refused.status(), "revision"), "1");
  EXPECT_THAT(Delete({"g", 2, Awaited}),
              IsError(StatusCode::kAborted, "REVISION_MISMATCH", _));
  EXPECT_EQ(PayloadOf("g"), "a");
  EXPECT_THAT(Change({"g", 1, Awaited}, Append("b")), IsOk());
  EXPECT_THAT(Delete({"g", 2, Awaited}), IsOk());
  EXPECT_EQ(PayloadOf("g"), "none");
}

TEST_F(GroupEditorTest, ExpectedRevisionHoldsUntilTheWrite) {
  ASSERT_THAT(Create(Group("g", "one", "a")), IsOk());
  EXPECT_THAT(Change({"g", 1, Awaited},
                     [&](const GroupRecord& group) {
                       RaiseRevision();
                       return Append("b")(group);
                     }),
              IsError(StatusCode::kAborted, "REVISION_MISMATCH", _));
  EXPECT_EQ(PayloadOf("g"), "a");
}

TEST_F(GroupEditorTest, PlanIsMadeAnewWhereAnotherServerWasFaster) {
  ASSERT_THAT(Create(Group("g", "one", "a")), IsOk());
  int plans = 0;
  const auto changed = Change({"g", 0, Awaited}, [&](const GroupRecord& group) {
    if (++plans < 3) RaiseRevision();
    return Append("b")(group);
  });
  ASSERT_THAT(changed, IsOk());
  EXPECT_EQ(plans, 3);
  EXPECT_EQ(changed->revision, 4u);
  EXPECT_EQ(PayloadOf("g"), "ab");
}

TEST_F(GroupEditorTest, GivesUpWhereOthersAreAlwaysFaster) {
  ASSERT_THAT(Create(Group("g", "one", "a")), IsOk());
  EXPECT_THAT(Change({"g", 0, Awaited},
                     [&](const GroupRecord& group) {
                       RaiseRevision();
                       return Append("b")(group);
                     }),
              IsError(StatusCode::kAborted, "REVISION_MISMATCH", _));
  EXPECT_EQ(PayloadOf("g"), "a");
}

TEST_F(GroupEditorTest, ChangeThatFitsAnyRevisionIsMadeOnce) {
  ASSERT_THAT(Create(Group("g", "one", "a")), IsOk());
  int plans = 0;
  EXPECT_THAT(Change({"g", 0, Awaited},
                     [&](const GroupRecord&) {
                       ++plans;
                       RaiseRevision();
                       return GroupEdit{{SetGroupPayload{"b"}}, true};
                     }),
              IsOk());
  EXPECT_EQ(plans, 1);
  EXPECT_EQ(PayloadOf("g"), "b");
}

TEST_F(GroupEditorTest, ErrorsOfPlanAndStorageEndTheOrder) {
  EXPECT_THAT(Change({"g", 0, Awaited}, Append("b")),
              IsError(StatusCode::kNotFound, "GROUP_NOT_FOUND", _));
  EXPECT_THAT(Delete({"g", 0, Awaited}),
              IsError(StatusCode::kNotFound, "GROUP_NOT_FOUND", _));
  ASSERT_THAT(Create(Group("g", "one", "a")), IsOk());
  EXPECT_THAT(Change({"g", 0, Awaited},
                     [](const GroupRecord&) -> absl::StatusOr<GroupEdit> {
                       return Error(StatusCode::kFailedPrecondition,
                                    "GROUP_LIMIT", "");
                     }),
              IsError(StatusCode::kFailedPrecondition, "GROUP_LIMIT", _));
  EXPECT_THAT(Change({"g", 0, Awaited},
                     [](const GroupRecord&) {
                       return GroupEdit{{RemoveGroupLink{"x"}}, true};
                     }),
              IsError(StatusCode::kNotFound, "LOOP_CLOSURE_NOT_FOUND", _));
}

TEST_F(GroupEditorTest, OrderThatNobodyWaitsForIsNotCarriedOut) {
  ASSERT_THAT(Create(Group("g", "one", "a")), IsOk());
  EXPECT_THAT(Change({"g", 0, CallerGaveUp}, Append("b")),
              IsError(StatusCode::kCancelled, "CANCELLED", _));
  EXPECT_EQ(PayloadOf("g"), "a");
}

TEST_F(GroupEditorTest, OrdersOfOneGroupComeOneAfterTheOther) {
  ASSERT_THAT(Create(Group("g", "one", "")), IsOk());
  std::vector<std::future<absl::StatusOr<GroupVersion>>> answers;
  std::string expected;
  int plans = 0;
  for (int i = 0; i < 60; ++i) {
    const std::string letter(1, static_cast<char>('0' + i));
    expected += letter;
    const auto answer =
        std::make_shared<std::promise<absl::StatusOr<GroupVersion>>>();
    answers.push_back(answer->get_future());
    editor_.Change(
        {"g", 0, Awaited},
        [&plans, letter](const GroupRecord& group) {
          ++plans;
          return Append(letter)(group);
        },
        [answer](absl::StatusOr<GroupVersion> version) {
          answer->set_value(std::move(version));
        });
  }
  for (auto& answer : answers) EXPECT_THAT(answer.get(), IsOk());
  // No attempt was in vain.
  EXPECT_EQ(plans, 60);
  EXPECT_EQ(PayloadOf("g"), expected);
}

TEST(GroupEditorEndTest, WaitsForAllOrders) {
  MemoryStorage storage;
  Executor executor("groups", 2);
  std::promise<void> begun;
  std::promise<void> ended;
  std::future<void> end = ended.get_future();
  bool is_done = false;
  auto editor = std::make_unique<GroupEditor>(&storage, &executor);
  editor->Create(
      Group("g", "one", "a"),
      [&] {
        begun.set_value();
        // Long enough for an end that does not wait.
        EXPECT_EQ(end.wait_for(std::chrono::milliseconds(50)),
                  std::future_status::timeout);
        return absl::OkStatus();
      },
      [&](const absl::StatusOr<GroupRecord>&) { is_done = true; });
  begun.get_future().wait();
  editor.reset();
  EXPECT_TRUE(is_done);
  ended.set_value();
}

}  // namespace
}  // namespace revisit::server
