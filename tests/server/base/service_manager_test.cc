#include "server/base/service_manager.h"

#include <poll.h>
#include <stdlib.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <unistd.h>

#include <atomic>
#include <chrono>
#include <optional>
#include <sstream>
#include <string>

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "tests/server/temporary_directory.h"

namespace revisit::server {
namespace {

using ::testing::HasSubstr;

// The manager's end of the socket, named in the environment.
class ServiceManagerTest : public testing::Test {
 protected:
  void SetUp() override {
    const std::string path = directory_.File("notify");
    sockaddr_un address{};
    address.sun_family = AF_UNIX;
    ASSERT_LT(path.size(), sizeof(address.sun_path));
    path.copy(address.sun_path, path.size());
    socket_ = socket(AF_UNIX, SOCK_DGRAM | SOCK_CLOEXEC, 0);
    ASSERT_EQ(bind(socket_, reinterpret_cast<const sockaddr*>(&address),
                   sizeof(address)),
              0);
    setenv("NOTIFY_SOCKET", path.c_str(), 1);
  }

  void TearDown() override {
    unsetenv("NOTIFY_SOCKET");
    unsetenv("WATCHDOG_USEC");
    close(socket_);
  }

  // The report that came; nothing if nothing comes within the time.
  std::optional<std::string> Next(std::chrono::milliseconds limit) {
    pollfd readable = {socket_, POLLIN, 0};
    if (poll(&readable, 1, static_cast<int>(limit.count())) != 1) return {};
    char text[256];
    const ssize_t size = recv(socket_, text, sizeof(text), 0);
    if (size < 0) return {};
    return std::string(text, static_cast<std::size_t>(size));
  }

  const TemporaryDirectory directory_;
  int socket_ = -1;
  std::ostringstream text_;
};

constexpr std::chrono::seconds kLong{30};
constexpr std::chrono::milliseconds kMoment{100};

TEST_F(ServiceManagerTest, HearsOfTheStartAndTheEnd) {
  ReportReady();
  EXPECT_EQ(Next(kLong), "READY=1");
  ReportStopping();
  EXPECT_EQ(Next(kLong), "STOPPING=1");
}

TEST_F(ServiceManagerTest, IsNotLookedForWhereTheEnvironmentNamesNone) {
  unsetenv("NOTIFY_SOCKET");
  ReportReady();
  EXPECT_EQ(Next(kMoment), std::nullopt);
}

TEST_F(ServiceManagerTest, HearsFourTimesInItsTimeOfAServiceThatWorks) {
  setenv("WATCHDOG_USEC", "200000", 1);
  const Log log(LogFormat::kText, LogLevel::kInfo, &text_);
  std::atomic<std::int64_t> patience_ms{0};
  const Watchdog watchdog(
      [&](std::chrono::milliseconds patience) {
        patience_ms = patience.count();
        return true;
      },
      &log);
  for (int i = 0; i < 4; ++i) EXPECT_EQ(Next(kLong), "WATCHDOG=1");
  EXPECT_EQ(patience_ms, 50);
}

TEST_F(ServiceManagerTest, HearsNothingOfAServiceThatDoesNotWork) {
  setenv("WATCHDOG_USEC", "20000", 1);
  {
    const Log log(LogFormat::kText, LogLevel::kInfo, &text_);
    const Watchdog watchdog([](std::chrono::milliseconds) { return false; },
                            &log);
    EXPECT_EQ(Next(kMoment), std::nullopt);
  }
  EXPECT_THAT(text_.str(), HasSubstr("watchdog_not_answered waited_ms=5"));
}

TEST_F(ServiceManagerTest, IsNotAskedForWhereThereIsNoWatchdog) {
  const Log log(LogFormat::kText, LogLevel::kInfo, &text_);
  std::atomic<bool> asked{false};
  const Watchdog watchdog(
      [&](std::chrono::milliseconds) {
        asked = true;
        return true;
      },
      &log);
  EXPECT_EQ(Next(kMoment), std::nullopt);
  EXPECT_FALSE(asked);
}

}  // namespace
}  // namespace revisit::server
