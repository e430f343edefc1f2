#include "crash_states.h"

#include <cstdint>
#include <filesystem>
#include <fstream>
#include <map>
#include <optional>
#include <set>
#include <sstream>
#include <string>

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "tests/server/temporary_directory.h"

namespace revisit::faults {
namespace {

using ::testing::AllOf;
using ::testing::Contains;
using ::testing::ElementsAre;

constexpr std::uint64_t kRoot = 1;
constexpr std::uint64_t kFile = 2;

// Content by name.
using State = std::map<std::string, std::string>;

class CrashStates : public ::testing::Test {
 protected:
  CrashStates() { Begin(""); }

  void Begin(const std::string& dishonoured) {
    device_.emplace(dishonoured);
    Do(EventKind::kRoot, kRoot, 0, "/root");
  }

  void Do(EventKind kind, std::uint64_t inode, std::uint64_t offset = 0,
          const std::string& name = "", const std::string& data = "") {
    Event event{};
    event.header.kind = kind;
    event.header.inode = inode;
    event.header.parent = kRoot;
    event.header.target = kRoot;
    event.header.offset = offset;
    event.name = name;
    event.data = data;
    device_->Apply(event);
  }

  void Write(std::uint64_t offset, const std::string& data) {
    Do(EventKind::kWrite, kFile, offset, "", data);
  }

  void Flush(std::uint64_t inode) {
    Do(EventKind::kSyncBegin, inode);
    Do(EventKind::kSyncEnd, inode);
  }

  // Many of the states that the device may be in.
  std::set<State> States() {
    std::set<State> states;
    for (int seed = 0; seed < 500; ++seed) {
      const server::TemporaryDirectory directory;
      const std::string path = directory.File("state");
      device_->WriteState(Device::Random(seed), path);
      State state;
      for (const auto& entry : std::filesystem::directory_iterator(path)) {
        std::ostringstream content;
        content << std::ifstream(entry.path(), std::ios::binary).rdbuf();
        state[entry.path().filename().string()] = content.str();
      }
      states.insert(state);
    }
    return states;
  }

  std::optional<Device> device_;
};

TEST_F(CrashStates, AllHaveWhatWasFlushed) {
  Do(EventKind::kCreate, kFile, 0, "file");
  Write(0, "flushed");
  Flush(kFile);
  Flush(kRoot);
  EXPECT_THAT(States(), ElementsAre(State{{"file", "flushed"}}));
}

TEST_F(CrashStates, AWriteThatBeganAfterTheFlushIsNotFlushedByIt) {
  Do(EventKind::kCreate, kFile, 0, "file");
  Flush(kRoot);
  Do(EventKind::kSyncBegin, kFile);
  Write(0, "late");
  Do(EventKind::kSyncEnd, kFile);
  EXPECT_THAT(States(), AllOf(Contains(State{{"file", ""}}),
                              Contains(State{{"file", "late"}})));
}

TEST_F(CrashStates, AFlushThatDidNotEndPromisesNothing) {
  Do(EventKind::kCreate, kFile, 0, "file");
  Flush(kRoot);
  Write(0, "begun");
  Do(EventKind::kSyncBegin, kFile);
  EXPECT_THAT(States(), Contains(State{{"file", ""}}));
}

TEST_F(CrashStates, ANewFileMayBeMissingUntilItsDirectoryIsFlushed) {
  Do(EventKind::kCreate, kFile, 0, "file");
  Write(0, "flushed");
  Flush(kFile);
  EXPECT_THAT(States(), ElementsAre(State{}, State{{"file", "flushed"}}));
}

TEST_F(CrashStates, ARemovedFileMayBeBackUntilItsDirectoryIsFlushed) {
  Do(EventKind::kCreate, kFile, 0, "file");
  Write(0, "old");
  Flush(kFile);
  Flush(kRoot);
  Do(EventKind::kUnlink, kFile, 0, "file");
  EXPECT_THAT(States(), ElementsAre(State{}, State{{"file", "old"}}));
  Flush(kRoot);
  EXPECT_THAT(States(), ElementsAre(State{}));
}

TEST_F(CrashStates, ARenamedFileHasOneOfItsNames) {
  Do(EventKind::kCreate, kFile, 0, "partial");
  Write(0, "whole");
  Flush(kFile);
  Flush(kRoot);
  Do(EventKind::kRename, kFile, 0, std::string("partial\0name", 12));
  EXPECT_THAT(States(), ElementsAre(State{{"name", "whole"}},
                                    State{{"partial", "whole"}}));
}

TEST_F(CrashStates, BlocksOfAWriteGetToTheDeviceInAnyOrder) {
  Do(EventKind::kCreate, kFile, 0, "file");
  Write(0, std::string(1024, 'a'));
  Flush(kFile);
  Flush(kRoot);
  Write(0, std::string(1024, 'b'));
  const std::string a(512, 'a');
  const std::string b(512, 'b');
  EXPECT_THAT(States(),
              ElementsAre(State{{"file", a + a}}, State{{"file", a + b}},
                          State{{"file", b + a}}, State{{"file", b + b}}));
}

TEST_F(CrashStates, AFileMayBeLongerThanWhatWasWrittenOfIt) {
  Do(EventKind::kCreate, kFile, 0, "file");
  Flush(kRoot);
  Write(0, std::string(512, 'a'));
  const std::set<State> states = States();
  EXPECT_THAT(states, Contains(State{{"file", ""}}));
  EXPECT_THAT(states, Contains(State{{"file", std::string(512, '\0')}}));
  EXPECT_THAT(states, Contains(State{{"file", std::string(512, 'a')}}));
  // And garbage.
  EXPECT_GT(states.size(), 3u);
}

TEST_F(CrashStates, WhatWasWrittenBehindATruncationIsNotSeenWithoutIt) {
  Do(EventKind::kCreate, kFile, 0, "file");
  Write(0, "old");
  Flush(kFile);
  Flush(kRoot);
  Do(EventKind::kTruncate, kFile, 0);
  Write(0, "new");
  const std::set<State> states = States();
  EXPECT_THAT(states, AllOf(Contains(State{{"file", "old"}}),
                            Contains(State{{"file", ""}}),
                            Contains(State{{"file", "new"}})));
}

TEST_F(CrashStates, SharedMemoryHoldsAnything) {
  Do(EventKind::kCreate, kFile, 0, "store-shm");
  Flush(kRoot);
  Do(EventKind::kMapped, kFile, 0, "", "index");
  const std::set<State> states = States();
  EXPECT_THAT(states,
              AllOf(Contains(State{}), Contains(State{{"store-shm", "index"}}),
                    Contains(State{{"store-shm", std::string(5, '\0')}})));
}

TEST_F(CrashStates, AFlushThatIsNotHonouredPromisesNothing) {
  Begin("-wal");
  Do(EventKind::kCreate, kFile, 0, "store-wal");
  Write(0, "flushed");
  Flush(kFile);
  Flush(kRoot);
  EXPECT_THAT(States(), AllOf(Contains(State{{"store-wal", ""}}),
                              Contains(State{{"store-wal", "flushed"}})));
}

}  // namespace
}  // namespace revisit::faults
