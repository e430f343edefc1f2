#include "server/base/logging.h"

#include <spdlog/logger.h>
#include <spdlog/pattern_formatter.h>
#include <spdlog/sinks/base_sink.h>
#include <spdlog/sinks/ostream_sink.h>

#include <algorithm>
#include <cmath>
#include <mutex>
#include <nlohmann/json.hpp>
#include <ostream>

#include "absl/strings/str_cat.h"
#include "server/base/line_writer.h"
#include "server/base/metrics.h"

namespace revisit::server {
namespace {

constexpr char kTextPattern[] = "%Y-%m-%dT%H:%M:%S.%eZ %l %v";
constexpr char kJsonPattern[] =
    R"({"time":"%Y-%m-%dT%H:%M:%S.%eZ","level":"%l",%v})";

spdlog::level::level_enum ToSpdlog(LogLevel level) {
  switch (level) {
    case LogLevel::kDebug:
      return spdlog::level::debug;
    case LogLevel::kInfo:
      return spdlog::level::info;
    case LogLevel::kWarning:
      return spdlog::level::warn;
    case LogLevel::kError:
      return spdlog::level::err;
    case LogLevel::kOff:
      return spdlog::level::off;
  }
  return spdlog::level::off;
}

// Whether a string literal of JSON holds the text as it is.
bool IsPlainLiteral(const std::string& text) {
  return std::all_of(text.begin(), text.end(), [](char c) {
    return c >= ' ' && c <= '~' && c != '"' && c != '\\';
  });
}

// Whether text mode shows the text without quotes.
bool StandsBare(const std::string& text) {
  return !text.empty() && std::all_of(text.begin(), text.end(), [](char c) {
    return (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z') ||
           (c >= '0' && c <= '9') || c == '.' || c == '_' || c == ':' ||
           c == '/' || c == '@' || c == '+' || c == '-';
  });
}

// The text as a string literal of JSON, in ASCII.
std::string Literal(const std::string& text) {
  if (IsPlainLiteral(text)) return absl::StrCat("\"", text, "\"");
  return nlohmann::json(text).dump(-1, ' ', true,
                                   nlohmann::json::error_handler_t::replace);
}

std::unique_ptr<spdlog::formatter> MakeFormatter(LogFormat format) {
  return std::make_unique<spdlog::pattern_formatter>(
      format == LogFormat::kJson ? kJsonPattern : kTextPattern,
      spdlog::pattern_time_type::utc);
}

std::string ValueText(LogFormat format, const LogField& field) {
  if (const auto* text = std::get_if<std::string>(&field.value)) {
    const bool bare = format == LogFormat::kText && StandsBare(*text);
    return bare ? *text : Literal(*text);
  }
  if (const auto* integer = std::get_if<std::int64_t>(&field.value)) {
    return absl::StrCat(*integer);
  }
  const double number = std::get<double>(field.value);
  // JSON has no word for a number that is not finite.
  return std::isfinite(number) ? absl::StrCat(number) : "null";
}

// The event and its fields, as both patterns continue with them.
std::string Render(LogFormat format, const char* event,
                   std::initializer_list<LogField> fields) {
  const bool json = format == LogFormat::kJson;
  std::string line =
      json ? absl::StrCat("\"event\":\"", event, "\"") : std::string(event);
  for (const LogField& field : fields) {
    const auto* text = std::get_if<std::string>(&field.value);
    if (text != nullptr && text->empty()) continue;
    absl::StrAppend(&line, json ? ",\"" : " ", field.key, json ? "\":" : "=",
                    ValueText(format, field));
  }
  return line;
}

std::string ToString(const spdlog::memory_buf_t& buffer) {
  return std::string(buffer.data(), buffer.size());
}

// The line that stands in the place of so many dropped ones.
std::string GapLine(LogFormat format, std::int64_t dropped) {
  const std::string text =
      Render(format, "log_lines_dropped", {{"count", dropped}});
  spdlog::memory_buf_t line;
  MakeFormatter(format)->format(
      spdlog::details::log_msg("revisitd", spdlog::level::warn, text), line);
  return ToString(line);
}

}  // namespace

class Log::LineSink final : public spdlog::sinks::base_sink<std::mutex> {
 public:
  LineSink(LogFormat format, int descriptor)
      : writer_(descriptor, LineWriter::Options(),
                [format](std::int64_t dropped) {
                  return GapLine(format, dropped);
                }) {}

  std::int64_t dropped() const { return writer_.dropped(); }

 private:
  void sink_it_(const spdlog::details::log_msg& message) override {
    spdlog::memory_buf_t line;
    formatter_->format(message, line);
    writer_.Write(ToString(line));
  }
  void flush_() override {}

  LineWriter writer_;
};

const char* NameOf(LogLevel level) {
  constexpr const char* kNames[] = {"debug", "info", "warning", "error", "off"};
  return kNames[static_cast<int>(level)];
}

struct Log::Sink {
  explicit Sink(spdlog::sink_ptr sink) : logger("revisitd", std::move(sink)) {}
  // Null for a stream.
  std::shared_ptr<LineSink> lines;
  // Mutable, since Log::Write() is const: logging changes nothing that a caller
  // could see.
  mutable spdlog::logger logger;
};

Log::Log(LogFormat format, LogLevel level, std::unique_ptr<Sink> sink)
    : format_(format), sink_(std::move(sink)) {
  sink_->logger.set_level(ToSpdlog(level));
  sink_->logger.flush_on(spdlog::level::info);
  sink_->logger.set_formatter(MakeFormatter(format));
}

Log::Log(LogFormat format, LogLevel level, int descriptor)
    : Log(format, level, [&] {
        auto lines = std::make_shared<LineSink>(format, descriptor);
        auto sink = std::make_unique<Sink>(lines);
        sink->lines = std::move(lines);
        return sink;
      }()) {}

Log::Log(LogFormat format, LogLevel level, std::ostream* stream)
    : Log(format, level,
          std::make_unique<Sink>(
              std::make_shared<spdlog::sinks::ostream_sink_mt>(*stream))) {}

Log::~Log() = default;

void Log::Write(LogLevel level, const char* event,
                std::initializer_list<LogField> fields) const {
  if (!sink_->logger.should_log(ToSpdlog(level))) return;
  sink_->logger.log(ToSpdlog(level), Render(format_, event, fields));
}

void Log::SetLevel(LogLevel level) { sink_->logger.set_level(ToSpdlog(level)); }

std::int64_t Log::dropped() const {
  return sink_->lines == nullptr ? 0 : sink_->lines->dropped();
}

void Log::CollectMetrics(const char* name, Metrics* metrics) const {
  metrics
      ->Counter("revisit_log_lines_dropped_total",
                "Lines of a log that were lost, for it was not read or "
                "written as fast as they came.")
      .Add(dropped(), {{"log", name}});
}

}  // namespace revisit::server
