// Commands against a server that means harm to whoever reads what it says, or
// wants them to wait for ever.
#include <unistd.h>

#include <chrono>
#include <cstdio>
#include <fstream>
#include <functional>
#include <future>
#include <limits>
#include <optional>
#include <sstream>
#include <string>
#include <utility>
#include <vector>

#include "client/cli/commands/checks_command.h"
#include "client/cli/commands/contradictions_command.h"
#include "client/cli/commands/deletions_command.h"
#include "client/cli/commands/export_command.h"
#include "client/cli/commands/find_command.h"
#include "client/cli/commands/findings_command.h"
#include "client/cli/commands/group_command.h"
#include "client/cli/commands/group_frames_command.h"
#include "client/cli/commands/info_command.h"
#include "client/cli/commands/link_command.h"
#include "client/cli/commands/map_command.h"
#include "client/cli/commands/member_commands.h"
#include "client/cli/commands/poses_command.h"
#include "client/cli/commands/recordings_command.h"
#include "client/cli/commands/review_command.h"
#include "client/cli/commands/revise_command.h"
#include "client/cli/commands/show_command.h"
#include "client/cli/commands/stream_command.h"
#include "client/cli/commands/vehicle_command.h"
#include "client/cli/commands/verify_command.h"
#include "client/cli/commands/watch_command.h"
#include "client/revisit/status.h"
#include "gmock/gmock.h"
#include "google/rpc/error_details.pb.h"
#include "google/rpc/status.pb.h"
#include "nlohmann/json.hpp"
#include "tests/client/cli/commands/command_test.h"
#include "tests/client/stored_candidates.h"

namespace revisit::client {
namespace {

using std::chrono::seconds;
using ::testing::HasSubstr;

// Sets a title, clears the screen, begins a line, and turns around and hides
// what follows, in 7 and in 8 bits.
constexpr char kHostile[] =
    "\x1b]0;x\x07\x1b[2J\r\n\x7f\u009b31m\u202e\u2066\u200b\u200d\ufeff\u2028"
    "\U000e0041end";

// What of a text a terminal would obey or not show; empty if nothing is.
std::string Unfit(const std::string& text) {
  for (std::size_t i = 0; i < text.size(); ++i) {
    const auto byte = static_cast<unsigned char>(text[i]);
    if ((byte < 0x20 && byte != '\n') || byte == 0x7f) {
      return "byte " + std::to_string(byte) + " at " + std::to_string(i);
    }
  }
  for (const char* sequence : {"\u0085", "\u009b", "\u202e", "\u2066", "\u200b",
                               "\u200d", "\ufeff", "\u2028", "\U000e0041"}) {
    if (text.find(sequence) != std::string::npos) return sequence;
  }
  return "";
}

struct NamedCommand {
  std::string name;
  std::function<absl::Status(const Terminal&)> run;
};

class HostileServerTest : public CommandTest {
 protected:
  void SetUp() override {
    path_ =
        ::testing::TempDir() + std::to_string(getpid()) + "_hostile_drive.csv";
    std::ofstream file(path_);
    file << "t_s,est_x,est_y,est_yaw\n";
    for (int i = 0; i < 30; ++i) file << i << "," << 0.5 * i << ",0,0\n";
    optimised_ = ::testing::TempDir() + std::to_string(getpid()) +
                 "_hostile_optimised.g2o";
    std::ofstream(optimised_) << "VERTEX_SE2 1 1 0 0\n";
    std::vector<v1::Recording> recordings(2);
    for (int i = 0; i < 2; ++i) {
      const std::uint64_t first = static_cast<std::uint64_t>(i) + 1;
      recordings[first - 1].set_first_sequence(first);
      recordings[first - 1].set_frame_state(v1::FRAME_STATE_NONE);
    }
    server_.set_recordings(std::move(recordings));
    server_.set_checks({CheckOf("a", 90, {v1::CANDIDATE_STATE_OPEN})});
    v1::FindContradictionsResponse found;
    found.add_contradictions()->set_loop_closure("vehicles/a/loopClosures/1");
    server_.set_contradictions(found);
    server_.AddEvent(EventOf("a", 1));
    // Watches end once they were told something.
    server_.FailWatches(
        [this](const WatchStep& step) -> std::optional<grpc::Status> {
          if (step.told == 0) return std::nullopt;
          return MakeStatus(grpc::StatusCode::PERMISSION_DENIED, kHostile);
        });
  }
  void TearDown() override {
    std::remove(path_.c_str());
    std::remove(optimised_.c_str());
  }

  std::vector<NamedCommand> Commands() {
    v1::FindCandidatesRequest find;
    find.set_vehicle("shuttle");
    VehicleDescription description;
    description.display_name = "x";
    StreamOptions stream;
    stream.files = {path_};
    stream.vehicle = "other";
    const auto exporting = [this](ExportFormat format) {
      return [this, format](const Terminal& terminal) {
        ExportOptions options;
        options.vehicle = "shuttle";
        options.format = format;
        return RunExport(client_, options, terminal);
      };
    };
    const auto drawing = [this](MapFormat format) {
      return [this, format](const Terminal& terminal) {
        MapOptions options;
        options.vehicle = "shuttle";
        options.format = format;
        return RunMap(client_, options, terminal);
      };
    };
    return {
        {"vehicle create",
         [this](const Terminal& c) {
           return RunVehicleCreate(client_, "a", {}, {}, c);
         }},
        {"vehicle get",
         [this](const Terminal& c) { return RunVehicleGet(client_, "a", c); }},
        {"vehicle list",
         [this](const Terminal& c) { return RunVehicleList(client_, c); }},
        {"vehicle update",
         [=](const Terminal& c) {
           return RunVehicleUpdate(client_, "a", {}, description, c);
         }},
        {"info",
         [this](const Terminal& c) { return RunInfo(client_, "a:1", c); }},
        {"show",
         [this](const Terminal& c) { return RunShow(client_, "a", c); }},
        {"find", [=](const Terminal& c) { return RunFind(client_, find, c); }},
        {"checks",
         [this](const Terminal& c) {
           return RunChecksList(client_, {"-", {}}, c);
         }},
        {"checks by value",
         [this](const Terminal& c) {
           ChecksOptions options = {"a", {}};
           options.order = v1::LIST_CHECKS_ORDER_BY_VALUE;
           return RunChecksList(client_, options, c);
         }},
        {"review",
         [this](const Terminal& c) {
           ReviewOptions options;
           options.vehicle = "a";
           std::istringstream answers("\x1b[2J\nr\nu\ns\n");
           return RunReview(client_, options, answers, c);
         }},
        {"contradictions",
         [this](const Terminal& c) {
           return RunContradictions(client_, "a", c);
         }},
        {"checks, one",
         [this](const Terminal& c) {
           return RunChecksGet(client_, "a", 90, c);
         }},
        {"watch",
         [this](const Terminal& c) {
           WatchOptions options;
           options.from_start = true;
           options.command = "exit 3";
           return RunWatch(channel_, client_, options, c);
         }},
        {"closures list",
         [this](const Terminal& c) {
           return RunClosuresList(client_, "a", c);
         }},
        {"rejections list",
         [this](const Terminal& c) {
           return RunRejectionsList(client_, "a", c);
         }},
        {"deletions list",
         [this](const Terminal& c) {
           return RunDeletionsList(client_, "a", c);
         }},
        {"closures delete",
         [this](const Terminal& c) {
           return RunClosuresDelete(client_, {"a", {"150", "20"}}, c);
         }},
        {"closures delete, of two",
         [this](const Terminal& c) {
           return RunClosuresDelete(client_, {"a", {"160", "30"}}, c);
         }},
        {"confirm",
         [this](const Terminal& c) {
           return RunConfirm(client_, {"a", 150, 20}, {}, c);
         }},
        {"reject",
         [this](const Terminal& c) {
           return RunReject(client_, {"a", 150, 20}, "", c);
         }},
        {"group create",
         [this](const Terminal& c) {
           return RunGroupCreate(client_, "g", {}, c);
         }},
        {"group get",
         [this](const Terminal& c) { return RunGroupGet(client_, "g", c); }},
        {"group list",
         [this](const Terminal& c) { return RunGroupList(client_, c); }},
        {"group add",
         [this](const Terminal& c) {
           return RunMemberAdd(client_, {"g", "a"}, {}, c);
         }},
        {"group frames",
         [this](const Terminal& c) {
           v1::ListFrameTransformsRequest request;
           request.set_parent("g");
           request.set_vehicle("a");
           return RunGroupFrames(client_, request, c);
         }},
        {"group members",
         [this](const Terminal& c) { return RunMembers(client_, "g", c); }},
        {"link add",
         [this](const Terminal& c) {
           return RunLinkAdd(client_, {"g", {"a", 1}, {"b", 2}, {}, ""}, c);
         }},
        {"link reject",
         [this](const Terminal& c) {
           return RunLinkReject(client_, {"g", {"a", 1}, {"b", 2}, "", ""}, c);
         }},
        {"link list --rejected",
         [this](const Terminal& c) {
           return RunLinkRejections(client_, "g", c);
         }},
        {"link list",
         [this](const Terminal& c) { return RunLinkList(client_, "g", c); }},
        {"link delete",
         [this](const Terminal& c) {
           return RunLinkDelete(client_, {"g", {"a@1", "b@2"}}, c);
         }},
        {"poses list",
         [this](const Terminal& c) { return RunPosesList(client_, {"a"}, c); }},
        {"recordings list",
         [this](const Terminal& c) {
           return RunRecordingsList(client_, "a", c);
         }},
        {"export jsonl", exporting(ExportFormat::kJsonLines)},
        {"export g2o", exporting(ExportFormat::kG2o)},
        {"export tum", exporting(ExportFormat::kTum)},
        {"export csv", exporting(ExportFormat::kCsv)},
        {"export geojson", exporting(ExportFormat::kGeoJson)},
        {"map html", drawing(MapFormat::kHtml)},
        {"map svg", drawing(MapFormat::kSvg)},
        {"map geojson", drawing(MapFormat::kGeoJson)},
        {"revise",
         [this](const Terminal& c) {
           return RunRevise(client_, {"a", optimised_, OptimisedFormat::kG2o},
                            c);
         }},
        {"stream",
         [=](const Terminal& c) { return RunStream(channel_, stream, c); }}};
  }

  std::string path_;
  std::string optimised_;
};

TEST_F(HostileServerTest, NoCommandPrintsWhatATerminalWouldObeyOrHide) {
  server_.Say(kHostile);
  for (const NamedCommand& command : Commands()) {
    for (const bool as_json : {false, true}) {
      SCOPED_TRACE(command.name + (as_json ? " --json" : ""));
      Append(3);
      out_.str("");
      progress_.str("");
      const absl::Status status = command.run(as_json ? Json() : Text());
      EXPECT_EQ(Unfit(out_.str()), "") << out_.str();
      EXPECT_EQ(Unfit(progress_.str()), "") << progress_.str();
      EXPECT_EQ(Unfit(ErrorText(status)), "") << ErrorText(status);
      EXPECT_EQ(Unfit(ErrorToJson(status)), "") << ErrorToJson(status);
    }
  }
}

TEST_F(HostileServerTest, SearchInAGroupPrintsNothingThatATerminalWouldObey) {
  v1::CandidateSet set;
  set.set_group_revision(1);
  set.add_candidates()->set_matched_vehicle(kHostile);
  set.add_searched()->set_vehicle(kHostile);
  set.mutable_searched(0)->mutable_lag()->set_seconds(
      std::numeric_limits<std::int64_t>::min());
  set.add_unsearched()->set_vehicle(kHostile);
  set.mutable_unsearched(0)->set_reason(static_cast<v1::UnsearchedReason>(77));
  server_.set_candidates(set);
  for (const OutputFormat format : {OutputFormat::kText, OutputFormat::kWide,
                                    OutputFormat::kName, OutputFormat::kJson}) {
    out_.str("");
    ASSERT_TRUE(RunFind(client_, {}, As(format)).ok());
    EXPECT_EQ(Unfit(out_.str()), "") << out_.str();
  }
}

TEST_F(HostileServerTest, NoErrorPrintsWhatATerminalWouldObeyOrHide) {
  for (const NamedCommand& command : Commands()) {
    SCOPED_TRACE(command.name);
    Append(3);
    server_.FailUnaryCalls({MakeStatus(
        grpc::StatusCode::NOT_FOUND, kHostile,
        {kHostile, {{kHostile, kHostile}}, {{kHostile, kHostile}}})});
    const absl::Status status = command.run(Text());
    EXPECT_EQ(Unfit(ErrorText(status)), "") << ErrorText(status);
    EXPECT_EQ(Unfit(ErrorToJson(status)), "") << ErrorToJson(status);
    server_.FailUnaryCalls({});
  }
}

TEST_F(HostileServerTest, JsonHasTheValuesAsTheyAre) {
  server_.Say(kHostile);
  ASSERT_TRUE(RunVehicleGet(client_, "a", Json()).ok());
  const auto vehicle = nlohmann::json::parse(out_.str());
  EXPECT_EQ(vehicle["displayName"], kHostile);
  EXPECT_EQ(vehicle["labels"][kHostile], kHostile);
}

TEST_F(HostileServerTest, WarningsAndLostConnectionsAreToldOnTheirLines) {
  server_.Say(kHostile);
  int batch = 0;
  server_.FailBatches([&batch] {
    StreamFault fault;
    if (++batch == 1) {
      fault.kind = StreamFault::Kind::kBefore;
      fault.status = MakeStatus(grpc::StatusCode::UNAVAILABLE, kHostile);
    }
    return fault;
  });
  StreamOptions stream;
  stream.files = {path_};
  stream.vehicle = "a";
  ASSERT_TRUE(RunStream(channel_, stream, Text()).ok());
  EXPECT_EQ(Unfit(progress_.str()), "") << progress_.str();
  EXPECT_THAT(progress_.str(),
              HasSubstr("hostile_drive: warning: <U+001B>]0;x<U+0007>"));
  EXPECT_THAT(progress_.str(), HasSubstr("<U+000D><U+000A><U+007F><U+009B>31m"
                                         "<U+202E><U+2066><U+200B><U+200D>"
                                         "<U+FEFF><U+2028><U+E0041>end\n"));
  for (const char* begun : {"connection lost", "warning"}) {
    EXPECT_THAT(progress_.str(), HasSubstr(begun));
  }
}

TEST_F(HostileServerTest, ListsThatDoNotGoOnEndWithAnError) {
  std::vector<NamedCommand> commands;
  for (NamedCommand& command : Commands()) {
    for (const char* name :
         {"vehicle list",    "checks",         "checks by value",
          "contradictions",  "review",         "closures list",
          "rejections list", "deletions list", "closures delete",
          "group list",      "group members",  "link list",
          "link delete",     "poses list",     "recordings list",
          "export g2o",      "export tum",     "export csv",
          "map html",        "revise"}) {
      if (command.name == name) commands.push_back(command);
    }
  }
  ASSERT_EQ(commands.size(), 20u);
  Append(3);
  ASSERT_TRUE(RunGroupCreate(client_, "g", {}, Text()).ok());
  ASSERT_TRUE(RunMemberAdd(client_, {"g", "a"}, {}, Text()).ok());
  ASSERT_TRUE(
      RunLinkAdd(client_, {"g", {"a", 1}, {"b", 2}, {}, ""}, Text()).ok());
  for (const ListEnd end :
       {ListEnd::kRepeats, ListEnd::kRepeatsUnderFreshTokens,
        ListEnd::kEmptyPages}) {
    server_.EndListsLike(end);
    for (const NamedCommand& command : commands) {
      SCOPED_TRACE(command.name + " " + std::to_string(static_cast<int>(end)));
      auto done =
          std::async(std::launch::async, [&] { return command.run(Text()); });
      ASSERT_EQ(done.wait_for(seconds(120)), std::future_status::ready)
          << "it goes on for ever";
      const absl::Status status = done.get();
      EXPECT_TRUE(absl::IsInternal(status) ||
                  // A pose that has no stamp comes before the second page.
                  command.name == "export tum")
          << status;
      if (absl::IsInternal(status)) {
        EXPECT_THAT(ErrorText(status),
                    HasSubstr("the server's list does not go on"));
      }
    }
  }
}

// RESOURCE_EXHAUSTED with a wait of so many seconds and nanoseconds.
grpc::Status Busy(std::int64_t wait_seconds, std::int32_t nanos) {
  google::rpc::RetryInfo retry;
  retry.mutable_retry_delay()->set_seconds(wait_seconds);
  retry.mutable_retry_delay()->set_nanos(nanos);
  google::rpc::Status status;
  status.add_details()->PackFrom(retry);
  return grpc::Status(grpc::StatusCode::RESOURCE_EXHAUSTED, "busy",
                      status.SerializeAsString());
}

TEST_F(HostileServerTest, MapGivesUpWhereASearchIsPutOffForEver) {
  MapOptions options;
  options.vehicle = "shuttle";
  // The vehicle, two lists of two pages each, the graph and the recordings come
  // first.
  std::vector<grpc::Status> statuses(7, grpc::Status::OK);
  statuses.push_back(Busy(9'000'000'000, 0));
  server_.FailUnaryCalls(statuses);
  auto done = std::async(std::launch::async,
                         [&] { return RunMap(client_, options, Text()); });
  ASSERT_EQ(done.wait_for(seconds(120)), std::future_status::ready)
      << "it waits for ever";
  const absl::Status status = done.get();
  EXPECT_TRUE(absl::IsResourceExhausted(status)) << status;
}

TEST_F(HostileServerTest, CallsDoNotWaitBeyondTheirDeadline) {
  for (const std::int64_t wait :
       {std::int64_t{9'000'000'000}, std::int64_t{315'576'000'000},
        std::numeric_limits<std::int64_t>::max()}) {
    grpc::Status status = Busy(wait, 999'999'999);
    status = grpc::Status(grpc::StatusCode::UNAVAILABLE, "down",
                          status.error_details());
    server_.FailUnaryCalls({status});
    auto done = std::async(std::launch::async,
                           [&] { return RunVehicleGet(client_, "a", Text()); });
    ASSERT_EQ(done.wait_for(seconds(120)), std::future_status::ready)
        << "it waits for ever";
    EXPECT_TRUE(absl::IsUnavailable(done.get()));
  }
}

TEST_F(HostileServerTest, StreamGivesUpInItsTimeWhateverWaitIsAsked) {
  server_.FailBatches([] {
    StreamFault fault;
    fault.kind = StreamFault::Kind::kBefore;
    fault.status = Busy(9'000'000'000, 0);
    return fault;
  });
  StreamOptions stream;
  stream.files = {path_};
  stream.vehicle = "a";
  stream.give_up_after = seconds(1);
  auto done = std::async(std::launch::async,
                         [&] { return RunStream(channel_, stream, Text()); });
  ASSERT_EQ(done.wait_for(seconds(120)), std::future_status::ready)
      << "it waits for ever";
  EXPECT_TRUE(absl::IsResourceExhausted(done.get()));
}

TEST_F(HostileServerTest, StampsThatAreNoTimesArePrintedAllTheSame) {
  v1::CandidateSet set;
  for (const auto& [stamp_seconds, nanos] :
       std::vector<std::pair<std::int64_t, std::int32_t>>{
           {0, 2'147'483'647},
           {0, -2'147'483'647},
           {std::numeric_limits<std::int64_t>::max(), 999'999'999},
           {std::numeric_limits<std::int64_t>::min(), 1}}) {
    auto* const candidate = set.add_candidates();
    candidate->mutable_matched()->mutable_stamp()->set_seconds(stamp_seconds);
    candidate->mutable_matched()->mutable_stamp()->set_nanos(nanos);
    *set.mutable_query()->mutable_stamp() = candidate->matched().stamp();
  }
  server_.set_candidates(set);
  v1::FindCandidatesRequest request;
  request.set_vehicle("a");
  EXPECT_TRUE(RunFind(client_, request, Text()).ok());
  EXPECT_EQ(Unfit(out_.str()), "");
}

}  // namespace
}  // namespace revisit::client
