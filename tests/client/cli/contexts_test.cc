#include "client/cli/contexts.h"

#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <string>
#include <thread>
#include <vector>

#include "client/terminal/terminal.h"
#include "gmock/gmock.h"
#include "gtest/gtest.h"

namespace revisit::client {
namespace {

namespace fs = std::filesystem;
using ::testing::HasSubstr;
using ::testing::IsEmpty;
using ::testing::SizeIs;

ChannelOptions At(const std::string& address) {
  ChannelOptions server;
  server.address = address;
  return server;
}

// A folder of its own, with a file of contexts that is not there yet.
class ContextsTest : public ::testing::Test {
 protected:
  ContextsTest()
      : folder_(
            fs::path(testing::TempDir()) /
            ("contexts-" + std::to_string(getpid()) + "-" +
             testing::UnitTest::GetInstance()->current_test_info()->name())),
        path_((folder_ / "revisit" / "contexts.json").string()) {
    fs::remove_all(folder_);
  }
  ~ContextsTest() override { fs::remove_all(folder_); }

  void Write(const std::string& text) {
    fs::create_directories(fs::path(path_).parent_path());
    std::ofstream(path_) << text;
  }

  // The problem with a file of this content, which it names.
  std::string Wrong(const std::string& text) {
    Write(text);
    const auto contexts = ReadContexts(path_);
    EXPECT_EQ(ExitCodeOf(contexts.status()), kExitLocalError);
    const std::string message(contexts.status().message());
    EXPECT_EQ(message.rfind(path_ + ": ", 0), 0u) << message;
    return message.substr(std::min(message.size(), path_.size() + 2));
  }

  absl::Status Set(const std::string& name, const ChannelOptions& server) {
    return ChangeContexts(path_, [&](Contexts* contexts) {
      contexts->servers[name] = server;
      return absl::OkStatus();
    });
  }

  const fs::path folder_;
  const std::string path_;
};

TEST_F(ContextsTest, ThereAreNoneWithoutAFile) {
  const auto contexts = ReadContexts(path_);
  ASSERT_TRUE(contexts.ok());
  EXPECT_EQ(contexts->current, "");
  EXPECT_THAT(contexts->servers, IsEmpty());
}

TEST_F(ContextsTest, WhatIsWrittenIsReadAgain) {
  ASSERT_TRUE(
      ChangeContexts(path_, [](Contexts* contexts) {
        contexts->current = "plant";
        contexts->servers["plant"] = {"plant:1", "ca", "cert", "key", "token"};
        contexts->servers["yard"] = At("yard:1");
        return absl::OkStatus();
      }).ok());
  const auto contexts = ReadContexts(path_);
  ASSERT_TRUE(contexts.ok()) << contexts.status();
  EXPECT_EQ(contexts->current, "plant");
  ASSERT_THAT(contexts->servers, SizeIs(2));
  const ChannelOptions& plant = contexts->servers.at("plant");
  EXPECT_EQ(plant.address, "plant:1");
  EXPECT_EQ(plant.tls_authorities_file, "ca");
  EXPECT_EQ(plant.tls_certificate_file, "cert");
  EXPECT_EQ(plant.tls_key_file, "key");
  EXPECT_EQ(plant.token_file, "token");
}

TEST_F(ContextsTest, FileIsItsOwnersAlone) {
  ASSERT_TRUE(Set("plant", At("plant:1")).ok());
  struct stat file = {};
  ASSERT_EQ(stat(path_.c_str(), &file), 0);
  EXPECT_EQ(file.st_mode & 0777, 0600u);
}

TEST_F(ContextsTest, ChangeThatFailsLeavesTheFileAsItIs) {
  ASSERT_TRUE(Set("plant", At("plant:1")).ok());
  EXPECT_FALSE(ChangeContexts(path_, [](Contexts* contexts) {
                 contexts->servers.clear();
                 return absl::CancelledError("no");
               }).ok());
  EXPECT_THAT(ReadContexts(path_)->servers, SizeIs(1));
}

TEST_F(ContextsTest, LinkGoesOnLeadingToTheFile) {
  const fs::path target = folder_ / "kept" / "contexts.json";
  fs::create_directories(target.parent_path());
  fs::create_directories(fs::path(path_).parent_path());
  std::ofstream(target) << R"({"contexts": {}})";
  fs::create_symlink(target, path_);
  ASSERT_TRUE(Set("plant", At("plant:1")).ok());
  EXPECT_TRUE(fs::is_symlink(path_));
  EXPECT_THAT(ReadContexts(target.string())->servers, SizeIs(1));
}

TEST_F(ContextsTest, ChangesOfManyAtOnceAreAllKept) {
  std::vector<std::thread> threads;
  for (int i = 0; i < 8; ++i) {
    threads.emplace_back([this, i] {
      for (int j = 0; j < 5; ++j) {
        EXPECT_TRUE(
            Set("c" + std::to_string(5 * i + j), At("localhost:1")).ok());
      }
    });
  }
  for (std::thread& thread : threads) thread.join();
  EXPECT_THAT(ReadContexts(path_)->servers, SizeIs(40));
}

TEST_F(ContextsTest, WrongFilesAreToldWithTheKey) {
  EXPECT_THAT(Wrong("{\n  \"contexts\":"), HasSubstr("line 2"));
  EXPECT_EQ(Wrong("[]"), "allowed is an object");
  EXPECT_EQ(Wrong(R"({"curent": "a"})"),
            "key: got \"curent\"; did you mean current? allowed is current, "
            "contexts");
  EXPECT_EQ(Wrong(R"({"contexts": {"a": {"server": 1}}})"),
            "contexts.a.server: allowed is a text, got 1");
  EXPECT_THAT(Wrong(R"({"contexts": {"a": {"server": "x", "tls-caa": "y"}}})"),
              HasSubstr("contexts.a: got \"tls-caa\"; did you mean tls-ca?"));
  EXPECT_THAT(Wrong(R"({"contexts": {"a": {"server": "x", "token": "y"}}})"),
              HasSubstr("contexts.a: got \"token\"; did you mean token-file?"));
  EXPECT_EQ(Wrong(R"({"contexts": {"a": {}}})"),
            "contexts.a: server is missing");
  EXPECT_EQ(Wrong(R"({"contexts": {"a": {"server": "x", "tls-key": "y"}}})"),
            "contexts.a: tls-key requires tls-cert");
  EXPECT_THAT(Wrong(R"({"contexts": {"a b": {"server": "x"}}})"),
              HasSubstr("contexts: got \"a b\"; allowed are 1 to 63 letters"));
  EXPECT_EQ(Wrong(R"({"current": "b", "contexts": {}})"),
            "current: contexts has no \"b\"");
}

TEST_F(ContextsTest, FilesLieBesideTheFileOfContexts) {
  Write(R"({"contexts": {"a": {"server": "x", "tls-ca": "ca.pem",
            "token-file": "/etc/token"}}})");
  const auto server = ServerOf(*ReadContexts(path_), "a", path_);
  ASSERT_TRUE(server.ok());
  EXPECT_EQ(server->tls_authorities_file,
            (folder_ / "revisit" / "ca.pem").string());
  EXPECT_EQ(server->token_file, "/etc/token");
  EXPECT_EQ(server->tls_key_file, "");
}

TEST_F(ContextsTest, ContextThatThereIsNotIsToldWithThoseThatThereAre) {
  Contexts contexts;
  contexts.servers["plant"] = At("plant:1");
  contexts.servers["yard"] = At("yard:1");
  const absl::Status status = ServerOf(contexts, "plnt", path_).status();
  EXPECT_EQ(ExitCodeOf(status), kExitLocalError);
  EXPECT_EQ(ErrorText(status), path_ +
                                   " has no context \"plnt\"; did you mean "
                                   "plant?\nit has plant, yard");
}

TEST_F(ContextsTest, PlaceOfTheFileFollowsTheEnvironment) {
  setenv("HOME", "/home/me", 1);
  unsetenv("XDG_CONFIG_HOME");
  unsetenv("REVISIT_CONTEXTS_FILE");
  EXPECT_EQ(ContextsPath(), "/home/me/.config/revisit/contexts.json");
  setenv("XDG_CONFIG_HOME", "/config", 1);
  EXPECT_EQ(ContextsPath(), "/config/revisit/contexts.json");
  setenv("REVISIT_CONTEXTS_FILE", "/own.json", 1);
  EXPECT_EQ(ContextsPath(), "/own.json");
  unsetenv("REVISIT_CONTEXTS_FILE");
  unsetenv("XDG_CONFIG_HOME");
}

}  // namespace
}  // namespace revisit::client
