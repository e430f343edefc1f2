#include "server/service/call_record.h"

#include <chrono>
#include <sstream>
#include <string>

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "server/base/status.h"
#include "server/telemetry/service_counters.h"

namespace revisit::server {
namespace {

using std::chrono::seconds;
using ::testing::AllOf;
using ::testing::Contains;
using ::testing::HasSubstr;
using ::testing::IsEmpty;
using ::testing::Not;
using ::testing::Pair;

class CallRecordTest : public testing::Test {
 protected:
  CallRecordTest() {
    service_.log = &log_;
    service_.counts = &counts_;
    service_.slow_call = seconds(1);
    caller_.tenant = "a";
  }

  CallRecord RecordOf(const char* method) {
    return CallRecord(service_, method, FindMethodRule(method),
                      {"request-1", {}, "ipv4:127.0.0.1:4711"});
  }

  static core::CandidateSet Searched() {
    core::CandidateSet set;
    set.comparisons = 4242;
    return set;
  }

  std::uint64_t searches() const {
    std::uint64_t sum = 0;
    for (const auto& [outcome, count] : counts_.Read().searches) sum += count;
    return sum;
  }

  std::string lines() const { return out_.str(); }

  Caller caller_;
  ServiceContext service_;

 private:
  std::ostringstream out_;
  Log log_{LogFormat::kText, LogLevel::kInfo, &out_};
  ServiceCounters counts_;
};

TEST_F(CallRecordTest, LineOfACallNamesWhatItWasAbout) {
  CallRecord record = RecordOf("GetVehicle");
  record.NameCaller(caller_);
  record.NameVehicle("v");
  const absl::Status missing = VehicleNotFound("v");
  record.End(missing, std::string(missing.message()));
  EXPECT_THAT(lines(),
              AllOf(HasSubstr("info call request_id=request-1 "
                              "method=GetVehicle vehicle=v tenant=a"),
                    HasSubstr("code=NOT_FOUND reason=VEHICLE_NOT_FOUND")));
}

TEST_F(CallRecordTest, SlowSearchOfAStreamIsLoggedAtOnce) {
  CallRecord record = RecordOf("StreamPoses");
  record.NameCaller(caller_);
  record.Searched(Searched(), seconds(2));
  EXPECT_THAT(lines(),
              AllOf(HasSubstr("slow_search"), HasSubstr("comparisons=4242")));
}

TEST_F(CallRecordTest, QuickSearchOfAStreamIsCountedOnly) {
  CallRecord record = RecordOf("StreamPoses");
  record.NameCaller(caller_);
  record.Searched(Searched(), std::chrono::milliseconds(2));
  EXPECT_THAT(lines(), IsEmpty());
  EXPECT_EQ(searches(), 1u);
}

TEST_F(CallRecordTest, SearchOfAUnaryCallIsLoggedWithTheCallIfThatIsSlow) {
  service_.slow_call = std::chrono::nanoseconds(1);
  CallRecord record = RecordOf("FindCandidates");
  record.NameCaller(caller_);
  record.Searched(Searched(), seconds(2));
  EXPECT_THAT(lines(), IsEmpty());
  record.End(absl::OkStatus(), "");
  EXPECT_THAT(lines(),
              AllOf(HasSubstr("slow_call"), HasSubstr("comparisons=4242"),
                    Not(HasSubstr("slow_search"))));
}

TEST_F(CallRecordTest, SearchThatComesAfterTheEndOfAUnaryCallIsNotCounted) {
  CallRecord record = RecordOf("FindCandidates");
  record.NameCaller(caller_);
  record.End(DeadlinePassed(), "");
  record.Searched(Searched(), seconds(2));
  EXPECT_EQ(searches(), 0u);
}

TEST_F(CallRecordTest, CallIsOpenUntilItLeaves) {
  CallRecord record = RecordOf("StreamPoses");
  record.NameCaller(caller_);
  const auto open = [this] {
    std::int64_t sum = 0;
    for (const auto& method : service_.counts->Read().methods) {
      sum += method.open;
    }
    return sum;
  };
  EXPECT_EQ(open(), 1);
  record.End(absl::OkStatus(), "");
  EXPECT_EQ(open(), 1);
  record.Leave();
  EXPECT_EQ(open(), 0);
}

}  // namespace
}  // namespace revisit::server
