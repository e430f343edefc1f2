#include "server/telemetry/audit_log.h"

#include <sys/stat.h>

#include <filesystem>
#include <fstream>
#include <nlohmann/json.hpp>
#include <sstream>
#include <string>

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "server/security/method_rules.h"
#include "tests/server/temporary_directory.h"

namespace revisit::server {
namespace {

using ::testing::HasSubstr;

std::string Contents(const std::string& path) {
  std::ifstream file(path);
  std::ostringstream text;
  text << file.rdbuf();
  return text.str();
}

class AuditLogTest : public testing::Test {
 protected:
  const TemporaryDirectory directory_;
  const std::string path_ = directory_.File("audit");
};

TEST_F(AuditLogTest, AppendsLinesToAFileForItsOwnerAlone) {
  for (const char* method : {"DeleteVehicle", "AddLoopClosure"}) {
    const auto log = AuditLog::Open(path_, LogFormat::kJson);
    ASSERT_TRUE(log.ok()) << log.status();
    (*log)->Write({{"method", method}, {"vehicle", "a\nb"}, {"id", ""}});
  }
  std::ifstream file(path_);
  std::string line;
  std::getline(file, line);
  const auto first = nlohmann::json::parse(line);
  EXPECT_EQ(first["event"], "audit");
  EXPECT_EQ(first["method"], "DeleteVehicle");
  EXPECT_EQ(first["vehicle"], "a\nb");
  EXPECT_FALSE(first.contains("id"));
  std::getline(file, line);
  EXPECT_EQ(nlohmann::json::parse(line)["method"], "AddLoopClosure");
  struct stat status;
  ASSERT_EQ(stat(path_.c_str(), &status), 0);
  EXPECT_EQ(status.st_mode & 0777, 0600u);
}

TEST_F(AuditLogTest, AfterItsFileWasRenamedALogThatIsOpenedAgainMakesANewOne) {
  const std::string renamed = path_ + ".1";
  {
    const auto log = AuditLog::Open(path_, LogFormat::kText);
    ASSERT_TRUE(log.ok()) << log.status();
    (*log)->Write({{"id", "before"}});
    std::filesystem::rename(path_, renamed);
    ASSERT_TRUE((*log)->Reopen().ok());
    (*log)->Write({{"id", "after"}});
  }
  EXPECT_THAT(Contents(path_), HasSubstr("id=after"));
  // Its writer may have come to the first line before the file was renamed, or
  // later.
  EXPECT_THAT(Contents(renamed) + Contents(path_), HasSubstr("id=before"));
}

TEST_F(AuditLogTest, AFileThatCannotBeOpenedIsNamed) {
  const auto log =
      AuditLog::Open(directory_.File("none/audit"), LogFormat::kText);
  EXPECT_EQ(log.status().code(), absl::StatusCode::kInvalidArgument);
  EXPECT_THAT(std::string(log.status().message()),
              testing::AllOf(HasSubstr("/none/audit"), HasSubstr("No such")));
}

TEST_F(AuditLogTest, GoesOnInTheFileThatIsOpenIfItCannotBeOpenedAgain) {
  const std::string folder = directory_.File("folder");
  std::filesystem::create_directory(folder);
  const std::string moved = directory_.File("moved");
  {
    const auto log = AuditLog::Open(folder + "/audit", LogFormat::kText);
    ASSERT_TRUE(log.ok()) << log.status();
    std::filesystem::rename(folder, moved);
    EXPECT_FALSE((*log)->Reopen().ok());
    (*log)->Write({{"id", "still"}});
  }
  EXPECT_THAT(Contents(moved + "/audit"), HasSubstr("id=still"));
}

TEST_F(AuditLogTest, CoversWhatChangesSomethingButStreamedPoses) {
  for (const MethodRule& rule : MethodRules()) {
    const std::string method = rule.method;
    const bool changes = rule.verb && *rule.verb != Verb::kRead;
    EXPECT_EQ(AuditLog::Covers(method),
              changes && method != "StreamPoses" && method != "AppendPoses")
        << method;
  }
}

}  // namespace
}  // namespace revisit::server
