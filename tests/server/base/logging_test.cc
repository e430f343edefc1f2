#include "server/base/logging.h"

#include <fcntl.h>
#include <signal.h>
#include <unistd.h>

#include <cmath>
#include <cstdint>
#include <cstdio>
#include <nlohmann/json.hpp>
#include <sstream>
#include <string>
#include <thread>
#include <vector>

#include "gmock/gmock.h"
#include "gtest/gtest.h"

namespace revisit::server {
namespace {

using ::testing::ContainsRegex;
using ::testing::HasSubstr;

std::vector<std::string> Lines(const std::string& text) {
  std::vector<std::string> lines;
  std::istringstream stream(text);
  for (std::string line; std::getline(stream, line);) lines.push_back(line);
  return lines;
}

std::string Written(LogFormat format, LogLevel level,
                    const std::string& value) {
  std::ostringstream stream;
  const Log log(format, level, &stream);
  log.Write(LogLevel::kInfo, "call", {{"value", value}});
  return stream.str();
}

// A value as a line of JSON holds it, without its quotes.
std::string Literal(const std::string& value) {
  const std::string line = Written(LogFormat::kJson, LogLevel::kInfo, value);
  const std::string before = "\"value\":\"";
  const std::size_t start = line.find(before) + before.size();
  return line.substr(start, line.rfind('"') - start);
}

TEST(LogTest, LevelMayChangeWhileItIsWritten) {
  std::ostringstream stream;
  Log log(LogFormat::kText, LogLevel::kError, &stream);
  const auto write = [&](const char* event) {
    log.Write(LogLevel::kInfo, event, {});
  };
  write("before");
  log.SetLevel(LogLevel::kInfo);
  write("while");
  log.SetLevel(LogLevel::kWarning);
  write("after");
  ASSERT_EQ(Lines(stream.str()).size(), 1u);
  EXPECT_THAT(stream.str(), HasSubstr("info while"));
  EXPECT_EQ(log.dropped(), 0);
  EXPECT_STREQ(NameOf(LogLevel::kWarning), "warning");
}

TEST(LogTest, PrintableAsciiIsNotEscaped) {
  EXPECT_EQ(Literal("a B~ {}'/:"), "a B~ {}'/:");
}

TEST(LogTest, AllElseIsEscaped) {
  EXPECT_EQ(Literal("\"\\\n\r\t"), "\\\"\\\\\\n\\r\\t");
  EXPECT_EQ(Literal(std::string("\0\x1b\x7f", 3)), "\\u0000\\u001b\\u007f");
  // U+00E4, U+202E (right-to-left override), U+1F600.
  EXPECT_EQ(Literal("\xc3\xa4\xe2\x80\xae\xf0\x9f\x98\x80"),
            "\\u00e4\\u202e\\ud83d\\ude00");
}

TEST(LogTest, WhatIsNoUtf8IsReplaced) {
  // A lone continuation, a truncated sequence, an overlong slash, a surrogate,
  // a code point beyond the last, and bytes that never occur.
  EXPECT_EQ(Literal("\x80"), "\\ufffd");
  EXPECT_EQ(Literal("\xc3"), "\\ufffd");
  EXPECT_EQ(Literal("\xe2\x80x"), "\\ufffdx");
  EXPECT_EQ(Literal("\xc0\xaf"), "\\ufffd\\ufffd");
  EXPECT_EQ(Literal("\xed\xa0\x80"), "\\ufffd\\ufffd\\ufffd");
  EXPECT_EQ(Literal("\xf4\x90\x80\x80"), "\\ufffd\\ufffd\\ufffd\\ufffd");
  EXPECT_EQ(Literal("\xff\xfe"), "\\ufffd\\ufffd");
}

TEST(LogTest, JsonLineHoldsWhatWasWritten) {
  std::ostringstream stream;
  const Log log(LogFormat::kJson, LogLevel::kInfo, &stream);
  const std::string nasty = "quote \" backslash \\ newline \n \xf0\x9f\x98\x80";
  log.Write(LogLevel::kWarning, "call",
            {{"text", nasty},
             {"empty", std::string()},
             {"count", std::int64_t{-7}},
             {"ratio", 0.25},
             {"nothing", std::nan("")}});
  ASSERT_EQ(Lines(stream.str()).size(), 1u);
  const auto line = nlohmann::json::parse(stream.str());
  EXPECT_EQ(line["level"], "warning");
  EXPECT_EQ(line["event"], "call");
  EXPECT_EQ(line["text"], nasty);
  EXPECT_FALSE(line.contains("empty"));
  EXPECT_EQ(line["count"], -7);
  EXPECT_EQ(line["ratio"], 0.25);
  EXPECT_TRUE(line["nothing"].is_null());
  EXPECT_THAT(line["time"].get<std::string>(),
              ContainsRegex("^[0-9-]{10}T[0-9:]{8}\\.[0-9]{3}Z$"));
}

TEST(LogTest, TextLineQuotesWhatIsNotPlain) {
  EXPECT_THAT(Written(LogFormat::kText, LogLevel::kInfo, "127.0.0.1:1/a_b@c+d"),
              HasSubstr("Z info call value=127.0.0.1:1/a_b@c+d\n"));
  EXPECT_THAT(Written(LogFormat::kText, LogLevel::kInfo, "a b"),
              HasSubstr(" value=\"a b\"\n"));
  EXPECT_THAT(Written(LogFormat::kText, LogLevel::kInfo, "x code=OK"),
              HasSubstr(" value=\"x code=OK\"\n"));
}

TEST(LogTest, NothingACallerSendsMakesASecondLine) {
  const std::string forged =
      "a\n2026-01-01T00:00:00.000Z info call code=OK\r\n";
  for (const LogFormat format : {LogFormat::kText, LogFormat::kJson}) {
    const std::string text = Written(format, LogLevel::kInfo, forged);
    EXPECT_EQ(Lines(text).size(), 1u) << text;
    EXPECT_EQ(text.find('\r'), std::string::npos);
  }
}

TEST(LogTest, BracesAndPercentSignsAreNoFormats) {
  EXPECT_THAT(Written(LogFormat::kJson, LogLevel::kInfo, "{} {0} %v %Y"),
              HasSubstr("{} {0} %v %Y"));
}

TEST(LogTest, LevelsBelowTheOneAskedForAreLeftOut) {
  EXPECT_NE(Written(LogFormat::kText, LogLevel::kDebug, "x"), "");
  EXPECT_EQ(Written(LogFormat::kText, LogLevel::kWarning, "x"), "");
  EXPECT_EQ(Written(LogFormat::kText, LogLevel::kOff, "x"), "");
}

// The number of dropped lines that a line of the log reports; 0 if it reports
// none.
std::int64_t Dropped(LogFormat format, const std::string& line) {
  if (line.find("log_lines_dropped") == std::string::npos) return 0;
  if (format == LogFormat::kJson) {
    const auto event = nlohmann::json::parse(line);
    EXPECT_EQ(event["level"], "warning");
    return event["count"];
  }
  EXPECT_THAT(line,
              ContainsRegex("Z warning log_lines_dropped count=[0-9]+\n$"));
  return std::stoll(line.substr(line.find("count=") + 6));
}

TEST(LogTest, NobodyWaitsForAPipeThatNobodyReads) {
  signal(SIGPIPE, SIG_IGN);
  for (const LogFormat format : {LogFormat::kText, LogFormat::kJson}) {
    int ends[2];
    ASSERT_EQ(pipe2(ends, O_CLOEXEC), 0);
    constexpr std::int64_t kWritten = 20'000;
    {
      const Log log(format, LogLevel::kInfo, ends[1]);
      for (std::int64_t i = 0; i < kWritten; ++i) {
        log.Write(LogLevel::kInfo, "call",
                  {{"number", i}, {"value", std::string(100, 'a')}});
      }
      // Once the pipe is read again, the log reports all dropped lines.
      std::FILE* const reader = fdopen(ends[0], "r");
      std::int64_t seen = 0;
      std::int64_t told = 0;
      while (seen + told < kWritten) {
        char line[1000];
        ASSERT_NE(std::fgets(line, sizeof(line), reader), nullptr);
        const std::int64_t dropped = Dropped(format, line);
        told += dropped;
        if (dropped == 0) ++seen;
      }
      EXPECT_EQ(seen + told, kWritten);
      EXPECT_GT(told, 0);
      std::fclose(reader);
    }
    close(ends[1]);
  }
}

TEST(LogTest, LinesOfManyThreadsStayWhole) {
  std::ostringstream stream;
  {
    const Log log(LogFormat::kJson, LogLevel::kInfo, &stream);
    std::vector<std::thread> threads;
    for (int t = 0; t < 4; ++t) {
      threads.emplace_back([&log, t] {
        for (int i = 0; i < 250; ++i) {
          log.Write(LogLevel::kInfo, "call",
                    {{"thread", std::int64_t{t}}, {"value", "\n"}});
        }
      });
    }
    for (std::thread& thread : threads) thread.join();
  }
  const std::vector<std::string> lines = Lines(stream.str());
  ASSERT_EQ(lines.size(), 1000u);
  for (const std::string& line : lines) {
    EXPECT_EQ(nlohmann::json::parse(line)["value"], "\n");
  }
}

}  // namespace
}  // namespace revisit::server
