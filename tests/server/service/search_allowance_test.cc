#include "server/service/search_allowance.h"

#include <chrono>
#include <cstdint>
#include <optional>

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "tests/server/error_matchers.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using ::testing::_;

constexpr auto kNoDeadline = std::chrono::system_clock::time_point::max();

Limits OneSearch() {
  Limits limits;
  limits.max_searches_per_vehicle = 1;
  return limits;
}

std::int64_t NoMemory() { return 0; }

class SearchAllowanceTest : public testing::Test {
 protected:
  SearchAllowanceTest() {
    for (SearchAllowance* const call : {&first_, &second_}) {
      call->Enter("tenant", /*steps_per_second=*/100.0);
      call->ChooseVehicle("v");
    }
  }

  Admission admission_{OneSearch(), 1, NoMemory};
  SearchAllowance first_{&admission_, kNoDeadline};
  SearchAllowance second_{&admission_, kNoDeadline};
};

TEST_F(SearchAllowanceTest, SearchKeepsItsRoomUntilItIsGivenBack) {
  ASSERT_THAT(first_.TakeRoom(), IsOk());
  EXPECT_THAT(second_.TakeRoom(),
              IsError(StatusCode::kResourceExhausted, "SEARCH_QUOTA", _));
  first_.GiveBack();
  EXPECT_THAT(second_.TakeRoom(), IsOk());
}

TEST_F(SearchAllowanceTest, SearchOfACallThatWasGivenUpKeepsNoRoom) {
  first_.GiveBack();
  EXPECT_THAT(first_.TakeRoom(), IsOk());
  EXPECT_THAT(second_.TakeRoom(), IsOk());
}

TEST_F(SearchAllowanceTest, CallsOfATenantShareItsBudgetOfSteps) {
  ASSERT_THAT(first_.CheckSteps(), IsOk());
  first_.Took(std::chrono::milliseconds(1), 1'000'000);
  EXPECT_THAT(second_.CheckSteps(),
              IsError(StatusCode::kResourceExhausted, "SEARCH_QUOTA", _));
  EXPECT_THAT(second_.TakeRoom(),
              IsError(StatusCode::kResourceExhausted, "SEARCH_QUOTA", _));
}

TEST_F(SearchAllowanceTest, CallerWithoutABudgetMayTakeAnySteps) {
  SearchAllowance call(&admission_, kNoDeadline);
  call.Enter("other", std::nullopt);
  call.Took(std::chrono::milliseconds(1), 1'000'000'000);
  EXPECT_THAT(call.CheckSteps(), IsOk());
}

TEST_F(SearchAllowanceTest, FlowsAreTheCallersAndApartFromThoseOfChecks) {
  EXPECT_EQ(first_.search_flow(), second_.search_flow());
  EXPECT_NE(first_.search_flow(), first_.check_flow());
  SearchAllowance call(&admission_, kNoDeadline);
  call.Enter("other", std::nullopt);
  EXPECT_NE(call.search_flow(), first_.search_flow());
}

}  // namespace
}  // namespace revisit::server
