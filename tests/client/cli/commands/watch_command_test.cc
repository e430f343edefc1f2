#include "client/cli/commands/watch_command.h"

#include <sys/stat.h>
#include <unistd.h>

#include <chrono>
#include <csignal>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <functional>
#include <future>
#include <iterator>
#include <optional>
#include <string>
#include <thread>
#include <vector>

#include "gmock/gmock.h"
#include "nlohmann/json.hpp"
#include "tests/client/cli/commands/command_test.h"
#include "tests/client/stored_candidates.h"

namespace revisit::client {
namespace {

namespace fs = std::filesystem;

using nlohmann::json;
using std::chrono::milliseconds;
using std::chrono::seconds;
using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::IsEmpty;
using ::testing::SizeIs;

class WatchCommandTest : public CommandTest {
 protected:
  WatchCommandTest()
      : folder_(
            ::testing::TempDir() + std::to_string(getpid()) + "_" +
            ::testing::UnitTest::GetInstance()->current_test_info()->name()) {
    fs::remove_all(folder_);
    fs::create_directory(folder_);
    options_.cursor_file = (folder_ / "cursor").string();
    options_.backoff.initial = milliseconds(1);
    // A watch goes on for ever.
    EndAfter(3);
  }
  ~WatchCommandTest() override { fs::remove_all(folder_); }

  // Ends watches once the cursor is behind so many events.
  void EndAfter(int events) {
    server_.FailWatches(
        [events](const WatchStep& step) -> std::optional<grpc::Status> {
          const int begun = step.cursor.rfind("at ", 0) == 0
                                ? std::stoi(step.cursor.substr(3))
                                : 0;
          if (begun + step.told < events) return std::nullopt;
          return MakeStatus(grpc::StatusCode::PERMISSION_DENIED, "enough",
                            {"NOT_GRANTED"});
        });
  }

  // Ends with "enough" unless something goes wrong before.
  absl::Status Run() { return RunWatch(channel_, client_, options_, Text()); }

  std::string Cursor() {
    std::ifstream file(options_.cursor_file);
    return {std::istreambuf_iterator<char>(file),
            std::istreambuf_iterator<char>()};
  }
  void SetCursor(const std::string& text) {
    std::ofstream(options_.cursor_file) << text;
  }

  // The lines that were printed.
  std::vector<json> Lines() {
    std::vector<json> lines;
    std::istringstream text(out_.str());
    for (std::string line; std::getline(text, line);) {
      lines.push_back(json::parse(line));
    }
    return lines;
  }

  const fs::path folder_;
  WatchOptions options_;
};

TEST_F(WatchCommandTest, PrintsALineOfJsonForEachEvent) {
  v1::WatchCandidatesResponse deleted;
  deleted.mutable_vehicle_deleted()->set_vehicle("vehicles/a");
  deleted.mutable_vehicle_deleted()->set_number(3);
  server_.AddEvent(EventOf("a", 1));
  server_.AddEvent(EventOf("b", 2, v1::CANDIDATE_STATE_CONFIRMED));
  server_.AddEvent(deleted);
  SetCursor("at 0");
  EXPECT_EQ(ExitCodeOf(Run()), 71);
  const std::vector<json> lines = Lines();
  ASSERT_THAT(lines, SizeIs(3));
  EXPECT_EQ(lines[0]["cursor"], "at 1");
  EXPECT_EQ(lines[0]["resynchronised"], false);
  EXPECT_EQ(lines[0]["candidate"]["number"], 1);
  EXPECT_EQ(lines[0]["candidate"]["evidence"]["matched"]["sequence"], 1);
  EXPECT_EQ(lines[1]["candidate"]["candidate"]["state"],
            "CANDIDATE_STATE_CONFIRMED");
  EXPECT_EQ(lines[2]["vehicleDeleted"]["vehicle"], "vehicles/a");
  EXPECT_FALSE(lines[2].contains("candidate"));
}

TEST_F(WatchCommandTest, GoesOnWhereTheFileSaysAndKeepsWhereItIs) {
  for (std::uint64_t i = 1; i <= 3; ++i) server_.AddEvent(EventOf("a", i));
  SetCursor("at 1\n");
  EXPECT_EQ(ExitCodeOf(Run()), 71);
  ASSERT_THAT(Lines(), SizeIs(2));
  EXPECT_EQ(Lines()[0]["candidate"]["number"], 2);
  EXPECT_EQ(Cursor(), "at 3\n");
  EXPECT_EQ(*ReadCursorFile(options_.cursor_file), "at 3");
}

TEST_F(WatchCommandTest, ListsWhatIsOpenFromTheStartWhereThereIsNoCursor) {
  server_.set_checks(
      {CheckOf("a", 100,
               {v1::CANDIDATE_STATE_CONFIRMED, v1::CANDIDATE_STATE_OPEN}),
       CheckOf("b", 20, {v1::CANDIDATE_STATE_WITHDRAWN})});
  EndAfter(0);
  options_.from_start = true;
  EXPECT_EQ(ExitCodeOf(Run()), 71);
  ASSERT_THAT(Lines(), SizeIs(1));
  EXPECT_EQ(Lines()[0]["resynchronised"], true);
  EXPECT_EQ(Lines()[0]["cursor"], "");
  EXPECT_EQ(Lines()[0]["candidate"]["candidate"]["name"],
            "vehicles/a/checks/100/candidates/2");
  EXPECT_EQ(Cursor(), "at 0\n");
  // The next run has a cursor.
  EXPECT_EQ(ExitCodeOf(Run()), 71);
  EXPECT_THAT(Lines(), SizeIs(1));
}

TEST_F(WatchCommandTest, TellsThatEventsAreLost) {
  server_.set_checks({CheckOf("a", 100, {v1::CANDIDATE_STATE_OPEN})});
  server_.FailWatches([](const WatchStep& step) -> std::optional<grpc::Status> {
    if (step.cursor == "old") {
      return MakeStatus(grpc::StatusCode::OUT_OF_RANGE, "kept no longer",
                        {"CURSOR_TOO_OLD"});
    }
    return MakeStatus(grpc::StatusCode::PERMISSION_DENIED, "enough");
  });
  SetCursor("old");
  EXPECT_EQ(ExitCodeOf(Run()), 71);
  EXPECT_EQ(progress_.str(),
            "events are lost, listing what there is: OUT_OF_RANGE "
            "(CURSOR_TOO_OLD): kept no longer\n");
  ASSERT_THAT(Lines(), SizeIs(1));
  EXPECT_EQ(Lines()[0]["resynchronised"], true);
  EXPECT_EQ(Cursor(), "at 0\n");
}

TEST_F(WatchCommandTest, FileThatHoldsNoCursorIsToldWithAWayOut) {
  server_.FailWatches(nullptr);
  SetCursor("{}");
  const absl::Status status = Run();
  EXPECT_EQ(ExitCodeOf(status), 67);
  EXPECT_THAT(ErrorText(status), HasSubstr(options_.cursor_file));
  EXPECT_THAT(ErrorText(status), HasSubstr("--from-start begins anew"));
}

TEST_F(WatchCommandTest, EndsWhereTheCursorCannotBeKept) {
  server_.AddEvent(EventOf("a", 1));
  options_.cursor_file = (folder_ / "none" / "cursor").string();
  const absl::Status status = Run();
  EXPECT_EQ(ExitCodeOf(status), 1) << status;
  EXPECT_THAT(ErrorText(status), HasSubstr("No such file or directory"));
}

TEST_F(WatchCommandTest, CursorFileIsReplacedAsAWhole) {
  const std::string path = options_.cursor_file;
  EXPECT_EQ(*ReadCursorFile(path), "");
  ASSERT_TRUE(WriteCursorFile(path, "first").ok());
  // Whoever has the file open goes on reading what it was.
  std::ifstream opened(path);
  ASSERT_TRUE(WriteCursorFile(path, "second").ok());
  std::string before;
  opened >> before;
  EXPECT_EQ(before, "first");
  EXPECT_EQ(*ReadCursorFile(path), "second");
  // Nothing is left beside it.
  EXPECT_EQ(std::distance(fs::directory_iterator(folder_), {}), 1);
  // A link goes on leading to it.
  const std::string link = (folder_ / "link").string();
  fs::create_symlink("cursor", link);
  ASSERT_TRUE(WriteCursorFile(link, "third").ok());
  EXPECT_TRUE(fs::is_symlink(link));
  EXPECT_EQ(*ReadCursorFile(path), "third");
}

TEST_F(WatchCommandTest, CursorFileThatCannotBeReplacedStaysAsItIs) {
  if (geteuid() == 0) {
    // Root may write anywhere but into a file that is none.
    fs::create_directory(options_.cursor_file);
    EXPECT_EQ(ExitCodeOf(WriteCursorFile(options_.cursor_file, "x")), 1);
  } else {
    SetCursor("first");
    fs::permissions(folder_, fs::perms::owner_read | fs::perms::owner_exec);
    EXPECT_EQ(ExitCodeOf(WriteCursorFile(options_.cursor_file, "x")), 1);
    fs::permissions(folder_, fs::perms::owner_all);
    EXPECT_EQ(*ReadCursorFile(options_.cursor_file), "first");
  }
  EXPECT_EQ(std::distance(fs::directory_iterator(folder_), {}), 1);
}

TEST_F(WatchCommandTest, ExitCodesOfTheCommandDecide) {
  for (std::uint64_t i = 1; i <= 3; ++i) server_.AddEvent(EventOf("a", i));
  SetCursor("at 0");
  // Exits with ten times the number of the event less one.
  options_.command =
      "exit $((($(grep -o '\"number\":[0-9]*' | cut -d: -f2) - 1) * 10))";
  EXPECT_EQ(ExitCodeOf(Run()), 71);
  EXPECT_THAT(server_.Decisions(),
              ElementsAre("confirm vehicles/a/checks/100/candidates/1 100-1",
                          "reject vehicles/a/checks/200/candidates/1 200-2"));
  EXPECT_EQ(Cursor(), "at 3\n");
}

TEST_F(WatchCommandTest, CommandThatEndsOtherwiseStopsBeforeItsEvent) {
  server_.AddEvent(EventOf("a", 1));
  server_.AddEvent(EventOf("a", 2));
  EndAfter(2);
  for (const auto& [command, words] :
       {std::pair("exit 1", "exit code 1"), std::pair("exit 2", "exit code 2"),
        std::pair("exit 127", "127"),
        std::pair("kill -9 $$", "signal 9 (Killed)")}) {
    SetCursor("at 1");
    options_.command = command;
    const absl::Status status = Run();
    EXPECT_EQ(ExitCodeOf(status), 1) << status;
    EXPECT_THAT(ErrorText(status), HasSubstr(words));
    EXPECT_THAT(ErrorText(status),
                HasSubstr("vehicles/a/checks/200/candidates/1"));
    EXPECT_EQ(Cursor(), "at 1");
  }
  EXPECT_THAT(server_.Decisions(), IsEmpty());
  // The event comes again.
  options_.command = "exit 0";
  EXPECT_EQ(ExitCodeOf(Run()), 71);
  EXPECT_THAT(server_.Decisions(), SizeIs(1));
  EXPECT_EQ(Cursor(), "at 2\n");
}

TEST_F(WatchCommandTest, CommandIsGivenTheLineAndAskedAboutOpenOnesAlone) {
  server_.set_checks({CheckOf("a", 90, {v1::CANDIDATE_STATE_OPEN})});
  server_.AddEvent(EventOf("a", 1, v1::CANDIDATE_STATE_CONFIRMED));
  server_.AddEvent(EventOf("a", 2, v1::CANDIDATE_STATE_WITHDRAWN));
  const fs::path given = folder_ / "given";
  options_.command = "cat >> " + given.string();
  SetCursor("at 0");
  EndAfter(2);
  EXPECT_EQ(ExitCodeOf(Run()), 71);
  EXPECT_FALSE(fs::exists(given));
  // Those of a list are open as well, and a command need not read its input.
  fs::remove(options_.cursor_file);
  options_.from_start = true;
  out_.str("");
  EXPECT_EQ(ExitCodeOf(Run()), 71);
  std::ifstream file(given);
  EXPECT_EQ(std::string(std::istreambuf_iterator<char>(file),
                        std::istreambuf_iterator<char>()),
            out_.str());
  EXPECT_THAT(server_.Decisions(),
              ElementsAre("confirm vehicles/a/checks/90/candidates/1 90-10"));
}

TEST_F(WatchCommandTest, EventsTellTheValue) {
  v1::WatchCandidatesResponse event = EventOf("a", 1);
  event.mutable_candidate()->mutable_candidate()->set_value_square_meters(2.5);
  server_.AddEvent(event);
  SetCursor("at 0");
  EndAfter(1);
  EXPECT_EQ(ExitCodeOf(Run()), 71);
  EXPECT_EQ(Lines()[0]["candidate"]["candidate"]["valueSquareMeters"], 2.5);
}

class ContradictedTest : public WatchCommandTest {
 protected:
  // The candidate 150-20, whose loop closure others contradict.
  ContradictedTest() {
    v1::WatchCandidatesResponse event = EventOf("a", 1);
    v1::CandidateEvent* const told = event.mutable_candidate();
    told->mutable_candidate()->set_cause(v1::CANDIDATE_CAUSE_CONTRADICTION);
    told->mutable_candidate()->set_decision("vehicles/a/loopClosures/150-20");
    told->mutable_evidence()->mutable_query()->set_sequence(150);
    told->mutable_evidence()->mutable_matched()->set_sequence(20);
    event_ = event;
    SetCursor("at 0");
    EndAfter(1);
  }

  v1::WatchCandidatesResponse event_;
};

TEST_F(ContradictedTest, ConfirmationUpholdsTheClosureAsItIs) {
  server_.AddEvent(event_);
  options_.command = "exit 0";
  EXPECT_EQ(ExitCodeOf(Run()), 71);
  ASSERT_THAT(server_.AddedClosures(), SizeIs(1));
  const v1::AddLoopClosureRequest added = server_.AddedClosures()[0];
  EXPECT_EQ(added.loop_closure_id(), "150-20");
  EXPECT_EQ(added.loop_closure().decided_by(), "token:eva");
  EXPECT_EQ(added.candidate(), "vehicles/a/checks/100/candidates/1");
}

TEST_F(ContradictedTest, RejectionDeletesTheClosureFirst) {
  server_.AddEvent(event_);
  options_.command = "exit 10";
  EXPECT_EQ(ExitCodeOf(Run()), 71);
  EXPECT_THAT(server_.Deleted(), ElementsAre("vehicles/a/loopClosures/150-20"));
  EXPECT_THAT(server_.Decisions(),
              ElementsAre("reject vehicles/a/checks/100/candidates/1 150-20"));
}

TEST_F(ContradictedTest, CandidateWhoseClosureIsGoneIsConfirmedAsAnyOther) {
  event_.mutable_candidate()->mutable_candidate()->set_decision(
      "vehicles/a/loopClosures/gone");
  server_.AddEvent(event_);
  options_.command = "exit 0";
  EXPECT_EQ(ExitCodeOf(Run()), 71);
  ASSERT_THAT(server_.AddedClosures(), SizeIs(1));
  EXPECT_EQ(server_.AddedClosures()[0].loop_closure_id(), "");
  EXPECT_EQ(server_.AddedClosures()[0].loop_closure().matched_sequence(), 20u);
}

TEST_F(ContradictedTest, ClosureThatTheCandidateNamesIsTheOne) {
  event_.mutable_candidate()->mutable_candidate()->set_decision(
      "vehicles/a/loopClosures/again");
  server_.AddEvent(event_);
  options_.command = "exit 0";
  EXPECT_EQ(ExitCodeOf(Run()), 71);
  ASSERT_THAT(server_.AddedClosures(), SizeIs(1));
  EXPECT_EQ(server_.AddedClosures()[0].loop_closure_id(), "again");
}

TEST_F(WatchCommandTest, DecisionThatFailsStopsBeforeItsEvent) {
  server_.AddEvent(EventOf("a", 1));
  SetCursor("at 0");
  options_.command = "exit 0";
  server_.FailUnaryCalls({MakeStatus(grpc::StatusCode::PERMISSION_DENIED,
                                     "not you", {"NOT_GRANTED"})});
  const absl::Status status = Run();
  EXPECT_EQ(ExitCodeOf(status), 71);
  EXPECT_THAT(ErrorText(status), HasSubstr("not you"));
  EXPECT_EQ(Cursor(), "at 0");
}

TEST_F(WatchCommandTest, DecisionThatComesTooLateIsToldAndLeft) {
  for (std::uint64_t i = 1; i <= 3; ++i) server_.AddEvent(EventOf("a", i));
  SetCursor("at 0");
  options_.command = "exit 10";
  server_.FailUnaryCalls(
      {MakeStatus(grpc::StatusCode::FAILED_PRECONDITION, "it is a closure",
                  {"POSE_PAIR_CONFLICT"}),
       MakeStatus(grpc::StatusCode::NOT_FOUND, "gone", {"CHECK_NOT_FOUND"}),
       MakeStatus(grpc::StatusCode::OUT_OF_RANGE, "old", {"POSES_DROPPED"})});
  EXPECT_THAT(ErrorText(Run()), HasSubstr("enough"));
  EXPECT_EQ(Cursor(), "at 3\n");
  EXPECT_THAT(progress_.str(),
              HasSubstr("too late for vehicles/a/checks/100/candidates/1: "
                        "FAILED_PRECONDITION (POSE_PAIR_CONFLICT)"));
}

// Sends the signal once `ready` says so, while the command watches.
absl::Status Interrupted(int signal, const std::function<bool()>& ready,
                         const std::function<absl::Status()>& watch) {
  auto run = std::async(std::launch::async, watch);
  while (!ready()) std::this_thread::sleep_for(milliseconds(1));
  kill(getpid(), signal);
  if (run.wait_for(seconds(60)) != std::future_status::ready) {
    ADD_FAILURE() << "it goes on for ever";
    std::abort();
  }
  return run.get();
}

TEST_F(WatchCommandTest, SignalsEndItWith0) {
  server_.FailWatches(nullptr);
  for (const int signal : {SIGINT, SIGTERM}) {
    server_.AddEvent(EventOf("a", 1));
    SetCursor("at 0");
    const absl::Status status = Interrupted(
        signal, [this] { return Cursor() != "at 0"; },
        [this] { return Run(); });
    EXPECT_EQ(ExitCodeOf(status), 0) << status;
  }
  EXPECT_THAT(Lines(), SizeIs(::testing::Ge(2u)));
}

TEST_F(WatchCommandTest, SignalLetsTheCommandDecideFirst) {
  server_.FailWatches(nullptr);
  server_.AddEvent(EventOf("a", 1));
  server_.AddEvent(EventOf("a", 2));
  SetCursor("at 0");
  const fs::path begun = folder_ / "begun";
  options_.command = "touch " + begun.string() + "; sleep 0.2";
  const absl::Status status = Interrupted(
      SIGINT, [&] { return fs::exists(begun); }, [this] { return Run(); });
  EXPECT_EQ(ExitCodeOf(status), 0) << status;
  EXPECT_THAT(server_.Decisions(), SizeIs(1));
  EXPECT_EQ(Cursor(), "at 1\n");
}

TEST_F(WatchCommandTest, SignalThatEndsTheCommandTooLeavesItsEvent) {
  server_.FailWatches(nullptr);
  server_.AddEvent(EventOf("a", 1));
  SetCursor("at 0");
  const fs::path begun = folder_ / "begun";
  // As a terminal that interrupts all of them.
  options_.command =
      "touch " + begun.string() + "; sleep 0.2; kill -INT $$; sleep 60";
  const absl::Status status = Interrupted(
      SIGINT, [&] { return fs::exists(begun); }, [this] { return Run(); });
  EXPECT_EQ(ExitCodeOf(status), 0) << status;
  EXPECT_THAT(server_.Decisions(), IsEmpty());
  EXPECT_EQ(Cursor(), "at 0");
}

}  // namespace
}  // namespace revisit::client
