#include "server/settings/settings.h"

#include <cstdint>
#include <fstream>
#include <sstream>
#include <string>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "core/base/build_info.h"
#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "tests/server/temporary_directory.h"

namespace revisit::server {
namespace {

using ::testing::AllOf;
using ::testing::HasSubstr;
using ::testing::Not;
using ::testing::StartsWith;

using Words = std::vector<std::string>;

class SettingsTest : public ::testing::Test {
 protected:
  std::string WriteFile(const std::string& text) {
    const std::string path = directory_.File("revisitd.conf");
    std::ofstream(path) << text;
    return path;
  }

  // Parses settings that must be valid.
  static ServerSettings Parse(const Words& arguments,
                              const Words& environment = {}) {
    const auto parsed = ParseSettings(arguments, environment);
    EXPECT_TRUE(parsed.ok()) << parsed.status();
    return parsed.ok() ? parsed->settings : ServerSettings();
  }

  // Parses settings that must be refused; returns the message.
  static std::string Refusal(const Words& arguments,
                             const Words& environment = {}) {
    const auto parsed = ParseSettings(arguments, environment);
    EXPECT_EQ(parsed.status().code(), absl::StatusCode::kInvalidArgument);
    return std::string(parsed.status().message());
  }

 private:
  TemporaryDirectory directory_;
};

TEST_F(SettingsTest, DefaultsListenOnTheLoopbackOnly) {
  const ServerSettings settings = Parse({});
  EXPECT_EQ(settings.listen, "127.0.0.1:50051");
  EXPECT_EQ(settings.limits.max_message_bytes, 4 << 20);
  EXPECT_EQ(settings.log_format, LogFormat::kText);
}

TEST_F(SettingsTest, FlagsWinOverEnvironmentOverFileOverDefaults) {
  const std::string file = WriteFile(
      "# All of these are given.\n"
      "\n"
      "  listen=127.0.0.3:1\n"
      "store = \"of the file\"\n"
      "log-level = debug\n");
  const Words environment = {"REVISIT_CONFIG=" + file,
                             "REVISIT_LISTEN=environment:1",
                             "REVISIT_STORE=of the environment", "HOME=/"};
  const ServerSettings settings =
      Parse({"--listen", "127.0.0.2:1"}, environment);
  EXPECT_EQ(settings.listen, "127.0.0.2:1");
  EXPECT_EQ(settings.store, "of the environment");
  EXPECT_EQ(settings.log_level, LogLevel::kDebug);
  EXPECT_EQ(settings.limits.max_batch_poses, 4096);
  // The same holds for a flag that is given with an equals sign.
  EXPECT_EQ(Parse({"--listen=127.0.0.2:1"}, environment).listen, "127.0.0.2:1");
  // The flag that names the file wins over the variable that does.
  EXPECT_EQ(Parse({"--config", file}, {"REVISIT_CONFIG=/no/such/file"}).listen,
            "127.0.0.3:1");
}

TEST_F(SettingsTest, EmptyValueTakesNoOtherWord) {
  const ServerSettings settings =
      Parse({"--policy=", "--listen=127.0.0.1:1"}, {"REVISIT_POLICY=p"});
  EXPECT_EQ(settings.policy, "");
  EXPECT_EQ(settings.listen, "127.0.0.1:1");
}

TEST_F(SettingsTest, EmptyValueIsRefusedWhereAnotherIsNeeded) {
  for (const Words& words :
       {Words{"--store=", "--listen=127.0.0.1:1"}, Words{"verify", "--store="},
        Words{"--worker-threads=", "--listen=127.0.0.1:1"},
        Words{"backup", "--to="}, Words{"import", "--from="}}) {
    EXPECT_THAT(Refusal(words), HasSubstr("got \"\"; allowed is "));
  }
  EXPECT_THAT(Refusal({}, {"REVISIT_STORE="}), HasSubstr("store: got \"\""));
}

TEST_F(SettingsTest, ValueIsRefusedOfAFlagThatTakesNone) {
  EXPECT_EQ(Refusal({"--print-config=yes"}),
            "--print-config: got \"yes\"; allowed is no value");
}

TEST_F(SettingsTest, MistypedWordIsToldWithWhatMayBeMeant) {
  EXPECT_EQ(Refusal({"--lisen=127.0.0.1:1"}),
            "got \"--lisen\", which is no flag of revisitd; did you mean "
            "--listen?");
  EXPECT_EQ(Refusal({"backup", "--too", "x"}),
            "got \"--too\", which is no flag of revisitd backup; did you mean "
            "--to?");
  EXPECT_EQ(Refusal({"bakup"}),
            "got \"bakup\"; did you mean backup? allowed is backup, verify, "
            "compact, migrate, import");
}

TEST_F(SettingsTest, UnknownKeysAreRefusedByName) {
  EXPECT_THAT(Refusal({"--no-such-flag"}), HasSubstr("--no-such-flag"));
  EXPECT_THAT(Refusal({"stray"}), HasSubstr("stray"));
  EXPECT_THAT(Refusal({}, {"REVISIT_NO_SUCH=1"}), HasSubstr("REVISIT_NO_SUCH"));
  const std::string file = WriteFile("listen = a:1\nno-such-key = 1\n");
  EXPECT_THAT(Refusal({"--config", file}),
              AllOf(HasSubstr(file + ":2"), HasSubstr("\"no-such-key\"")));
  // Arguments that ask for something else than a server are no settings.
  for (const std::string key : {"config", "print-config", "help", "version"}) {
    const std::string asking = WriteFile(key + " = 1\n");
    EXPECT_THAT(Refusal({"--config", asking}), HasSubstr("\"" + key + "\""));
  }
}

TEST_F(SettingsTest, VariablesOfOtherProgramsAreLeftAlone) {
  Parse({}, {"REVISIT_CONTEXT=x", "REVISIT_CONTEXTS_FILE=x", "REVISIT_SERVER=x",
             "REVISIT_TLS_CA=x", "REVISIT_TOKEN_FILE=x", "REVISIT_PROGRAM=x",
             "REVISIT_SERVER_PROGRAM=x", "REVISIT_METRICS=x",
             "REVISIT_BASE_MAP=x", "REVISIT_CONSOLE_LISTEN=x", "REVISIT_BIN=x",
             "REVISIT_TEST_SEED=1", "REVISITD=1", "X=", "no equals sign"});
}

TEST_F(SettingsTest, ValuesOutOfRangeAreRefusedWithTheRange) {
  EXPECT_THAT(Refusal({"--worker-threads=-1"}),
              AllOf(HasSubstr("--worker-threads"), HasSubstr("\"-1\""),
                    HasSubstr("[0, 1024]")));
  EXPECT_THAT(
      Refusal({}, {"REVISIT_MAX_BATCH_POSES=0"}),
      AllOf(HasSubstr("REVISIT_MAX_BATCH_POSES"), HasSubstr("[1, 1000000]")));
  const std::string file = WriteFile("idle-unload-minutes = nan\n");
  EXPECT_THAT(Refusal({"--config", file}),
              AllOf(HasSubstr(file + ":1"), HasSubstr("\"nan\"")));
  EXPECT_THAT(Refusal({"--log-format", "xml"}),
              AllOf(HasSubstr("\"xml\""), HasSubstr("text|json")));
  for (const std::string value : {"", "4x", "1e3", "99999999999999999999"}) {
    EXPECT_THAT(Refusal({}, {"REVISIT_WORKER_THREADS=" + value}),
                HasSubstr("REVISIT_WORKER_THREADS"))
        << value;
  }
}

TEST_F(SettingsTest, MalformedFilesAreRefusedWithTheLine) {
  const std::vector<std::pair<std::string, std::string>> cases = {
      {"listen\n", ":1: expected KEY = VALUE"},
      {"\n[section]\n", ":2: expected KEY = VALUE"},
      {"listen = \"a\n", ":1: listen: malformed string"},
      {"listen = \"a\" b\n", ":1: listen: malformed string"},
      {"listen = \"\\x\"\n", ":1: listen: malformed string"},
      {"listen = \"a\\\"\n", ":1: listen: malformed string"},
      {"listen = 127.0.0.1:1 # mine\n",
       ":1: listen: got 127.0.0.1:1 # mine; a comment has a line of its own"},
      {"listen = a\nlisten = b\n", ":2: listen stands twice"}};
  for (const auto& [text, message] : cases) {
    EXPECT_THAT(Refusal({"--config", WriteFile(text)}), HasSubstr(message))
        << text;
  }
}

TEST_F(SettingsTest, ListeningBeyondTheMachineNeedsTlsAndIdentities) {
  const Words tls = {"--tls-cert=c", "--tls-key=k"};
  const Words tokens = {"--token-keys=j", "--token-issuer=i",
                        "--token-audience=a", "--policy=p"};
  const auto with = [](Words words, const Words& more) {
    words.insert(words.end(), more.begin(), more.end());
    return words;
  };
  for (const std::string listen :
       {"127.0.0.1:1", "127.1.2.3:1", "localhost:1", "[::1]:1", "unix:/tmp/a",
        "unix-abstract:a"}) {
    Parse({"--listen", listen});
  }
  for (const std::string listen :
       {"0.0.0.0:1", "[::]:1", "128.0.0.1:1", "127.0.0.1.example:1",
        "localhost.example:1", "127.1:1", "example:1", "*:1",
        "[::ffff:10.0.0.1]:1"}) {
    const Words remote = {"--listen=" + listen};
    const auto open = HasSubstr("could read and change all vehicles");
    EXPECT_THAT(Refusal(remote), open) << listen;
    EXPECT_THAT(Refusal(with(remote, tls)), open) << listen;
    EXPECT_THAT(Refusal(with(remote, tokens)),
                HasSubstr("could read and take tokens"))
        << listen;
    Parse(with(remote, with(tls, tokens)));
    Parse(with(remote, with(tls, {"--tls-client-ca=a", "--policy=p"})));
    Parse(with(remote, {"--insecure-allow-remote=on"}));
  }
}

TEST_F(SettingsTest, FormOfAnAddressComesBeforeWhoMayReachIt) {
  for (const std::string key : {"listen", "admin-listen"}) {
    for (const auto& [address, allowed] :
         std::vector<std::pair<std::string, std::string>>{
             {"foo", "HOST:PORT, such as 127.0.0.1:50051, or [ADDRESS]:PORT"},
             {":50051", "HOST:PORT; 0.0.0.0 stands for all"},
             {"[]:50051", "HOST:PORT; 0.0.0.0 stands for all"},
             {"::1:50051", "HOST:PORT, or [ADDRESS]:PORT for IPv6"},
             {"dns:///127.0.0.1:1", "HOST:PORT, or [ADDRESS]:PORT for IPv6"},
             {"0.0.0.0:", "HOST:PORT with a port from 0 to 65535"},
             {"0.0.0.0:65536", "HOST:PORT with a port from 0 to 65535"}}) {
      EXPECT_THAT(
          Refusal({"--" + key + "=" + address}),
          StartsWith(key + ": got \"" + address + "\"; allowed is " + allowed));
    }
  }
  EXPECT_THAT(Refusal({"--listen="}), StartsWith("listen: got \"\"; allowed"));
  EXPECT_EQ(Parse({"--admin-listen="}).admin_listen, "");
}

TEST_F(SettingsTest, SecuritySettingsThatDoNotGoTogetherAreRefused) {
  const std::vector<std::pair<Words, std::string>> cases = {
      {{"--tls-cert=c"}, "tls-cert and tls-key are needed together"},
      {{"--tls-key=c"}, "tls-cert and tls-key are needed together"},
      {{"--tls-client-ca=c", "--policy=p"}, "tls-client-ca needs tls-cert"},
      {{"--token-keys=k", "--policy=p"}, "token-issuer"},
      {{"--token-keys=k", "--policy=p", "--token-issuer=i"}, "token-audience"},
      {{"--token-issuer=i", "--token-audience=a"}, "token-keys"},
      {{"--token-keys=k", "--token-issuer=i", "--token-audience=a"},
       "need policy"},
      {{"--tls-cert=c", "--tls-key=k", "--tls-client-ca=a"}, "need policy"},
      {{"--policy=p"}, "policy needs token-keys or tls-client-ca"},
      {{"--tls-client-certs=maybe"}, "require|optional"},
      {{"--token-leeway-seconds=301"}, "[0, 300]"},
      {{"--security-check-seconds=61"}, "[0.05, 60]"},
      {{"--serve-health=no"}, "on|off"}};
  for (const auto& [arguments, message] : cases) {
    EXPECT_THAT(Refusal(arguments), HasSubstr(message)) << message;
  }
}

TEST_F(SettingsTest, FileThatIsNotThereIsRefusedByName) {
  EXPECT_THAT(Refusal({"--config", "/no/such/file"}),
              HasSubstr("/no/such/file"));
  EXPECT_THAT(Refusal({"--config", "/"}), HasSubstr("/"));
}

TEST_F(SettingsTest, PrintedSettingsReadBackAsTheSame) {
  const Words arguments = {"--listen",
                           "[::1]:0",
                           "--store",
                           "a \"quoted\" \\ path\nwith a line break # and more",
                           "--worker-threads",
                           "3",
                           "--drain-timeout-seconds",
                           "0.1",
                           "--drain-notice-seconds",
                           "2.5",
                           "--max-stream-age-seconds",
                           "3600",
                           "--max-revision-bytes",
                           "68719476736",
                           "--log-format",
                           "json",
                           "--log-level",
                           "off"};
  const std::string printed = PrintSettings(Parse(arguments));
  const ServerSettings again = Parse({"--config", WriteFile(printed)});
  EXPECT_EQ(PrintSettings(again), printed);
  EXPECT_EQ(again.store, arguments[3]);
  EXPECT_EQ(again.worker_threads, 3);
  EXPECT_EQ(again.drain_timeout_seconds, 0.1);
  EXPECT_EQ(again.drain_notice_seconds, 2.5);
  EXPECT_EQ(again.limits.max_stream_age_seconds, 3600.0);
  EXPECT_EQ(again.limits.max_revision_bytes, std::int64_t{1} << 36);
  EXPECT_EQ(again.log_format, LogFormat::kJson);
  EXPECT_EQ(again.log_level, LogLevel::kOff);
}

TEST_F(SettingsTest, PrintConfigTellsWhatWouldBeUsed) {
  const auto parsed = ParseSettings(
      {"--print-config", "--listen", "127.0.0.2:1"}, {"REVISIT_STORE=there"});
  ASSERT_TRUE(parsed.ok()) << parsed.status();
  ASSERT_TRUE(parsed->print.has_value());
  EXPECT_THAT(*parsed->print, AllOf(HasSubstr("listen = \"127.0.0.2:1\"\n"),
                                    HasSubstr("store = \"there\"\n")));
}

TEST_F(SettingsTest, HelpNamesEverySettingAndFitsATerminal) {
  const auto parsed = ParseSettings({"--help"}, {});
  ASSERT_TRUE(parsed.ok()) << parsed.status();
  ASSERT_TRUE(parsed->print.has_value());
  std::istringstream settings(PrintSettings({}));
  for (std::string line; std::getline(settings, line);) {
    EXPECT_THAT(*parsed->print,
                HasSubstr("--" + line.substr(0, line.find(' '))));
  }
  std::istringstream help(*parsed->print);
  for (std::string line; std::getline(help, line);) {
    EXPECT_LE(line.size(), 80u) << line;
  }
  EXPECT_THAT(*parsed->print, HasSubstr("Exit codes:"));
}

TEST_F(SettingsTest, TasksTakeTheStoreFromTheSameSettings) {
  const auto served = ParseSettings({"--store", "here"}, {});
  ASSERT_TRUE(served.ok()) << served.status();
  EXPECT_FALSE(served->task.has_value());
  const auto backup =
      ParseSettings({"backup", "--store", "here", "--to", "copy.sqlite"}, {});
  ASSERT_TRUE(backup.ok()) << backup.status();
  ASSERT_TRUE(backup->task.has_value());
  EXPECT_EQ(backup->task->kind, StoreTask::Kind::kBackup);
  EXPECT_EQ(backup->task->other, "copy.sqlite");
  EXPECT_EQ(backup->settings.store, "here");
  const auto verify = ParseSettings({"verify"}, {"REVISIT_STORE=there"});
  ASSERT_TRUE(verify.ok()) << verify.status();
  ASSERT_TRUE(verify->task.has_value());
  EXPECT_EQ(verify->task->kind, StoreTask::Kind::kVerify);
  EXPECT_EQ(verify->settings.store, "there");
  const auto compact = ParseSettings({"compact", "--store", "here"}, {});
  ASSERT_TRUE(compact.ok()) << compact.status();
  ASSERT_TRUE(compact->task.has_value());
  EXPECT_EQ(compact->task->kind, StoreTask::Kind::kCompact);
  const auto migrate =
      ParseSettings({"migrate", "--store", "postgresql://db/revisit"}, {});
  ASSERT_TRUE(migrate.ok()) << migrate.status();
  ASSERT_TRUE(migrate->task.has_value());
  EXPECT_EQ(migrate->task->kind, StoreTask::Kind::kMigrate);
  const auto import = ParseSettings(
      {"import", "--store", "postgresql://db/revisit", "--from", "here"}, {});
  ASSERT_TRUE(import.ok()) << import.status();
  ASSERT_TRUE(import->task.has_value());
  EXPECT_EQ(import->task->kind, StoreTask::Kind::kImport);
  EXPECT_EQ(import->task->other, "here");
  EXPECT_THAT(Refusal({"import", "--store", "here"}), HasSubstr("--from"));
}

TEST_F(SettingsTest, SharedStoreHasSettingsOfItsOwn) {
  const std::string database = "postgresql://db.example/revisit";
  const ServerSettings shared =
      Parse({"--store", database, "--require-replicated", "on",
             "--advertise-address", "a:1", "--store-connections", "4",
             "--lease-seconds", "2.5", "--store-wait-seconds", "0.5"});
  EXPECT_EQ(shared.store, database);
  EXPECT_TRUE(shared.require_replicated);
  EXPECT_EQ(shared.advertise_address, "a:1");
  EXPECT_EQ(shared.store_connections, 4);
  EXPECT_EQ(shared.lease_seconds, 2.5);
  EXPECT_EQ(StoreWaitTime(shared), std::chrono::milliseconds(500));
  EXPECT_THAT(Refusal({"--store-connections", "17"}), HasSubstr("[1, 16]"));
  EXPECT_THAT(Refusal({"--lease-seconds", "0.5"}), HasSubstr("[1, 3600]"));
  EXPECT_THAT(Refusal({"--store-wait-seconds", "-1"}), HasSubstr("[0, 86400]"));
}

TEST_F(SettingsTest, BackupWithoutAFileToMakeIsRefused) {
  EXPECT_THAT(Refusal({"backup", "--store", "here"}), HasSubstr("--to"));
}

TEST_F(SettingsTest, DamagedLogIsRefusedUnlessToldOtherwise) {
  EXPECT_EQ(Parse({}).damaged_log, DamagedLog::kRefuse);
  EXPECT_EQ(Parse({"--damaged-log", "drop"}).damaged_log, DamagedLog::kDrop);
  EXPECT_THAT(Refusal({"--damaged-log", "ignore"}),
              AllOf(HasSubstr("ignore"), HasSubstr("refuse|drop")));
}

TEST_F(SettingsTest, VersionIsPrinted) {
  const auto parsed = ParseSettings({"--version"}, {});
  ASSERT_TRUE(parsed.ok()) << parsed.status();
  EXPECT_THAT(parsed->print.value_or(""),
              StartsWith(absl::StrCat("revisitd ", kVersion, " (")));
}

}  // namespace
}  // namespace revisit::server
