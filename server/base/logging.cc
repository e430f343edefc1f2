#include "server/base/logging.h"

#include <spdlog/logger.h>
#include <spdlog/pattern_formatter.h>
#include <spdlog/sinks/base_sink.h>
#include <spdlog/sinks/ostream_sink.h>

#include <cmath>
#include <cstdio>
#include <mutex>
#include <ostream>

#include "server/base/line_writer.h"

namespace revisit::server {
namespace {

constexpr char kTextPattern[] = "%Y-%m-%dT%H:%M:%S.%eZ %l %v";
constexpr char kJsonPattern[] =
    R"({"time":"%Y-%m-%dT%H:%M:%S.%eZ","level":"%l",%v})";

constexpr std::uint32_t kReplacement = 0xFFFD;

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

// The code point at `*at`, which moves on; kReplacement, and one byte on, for
// what is no UTF-8.
std::uint32_t NextCodePoint(const std::string& text, std::size_t* at) {
  const auto byte = [&](std::size_t i) {
    return static_cast<unsigned char>(text[i]);
  };
  const std::uint32_t first = byte(*at);
  std::size_t length = 1;
  std::uint32_t smallest = 0;
  std::uint32_t code = first;
  if (first >= 0xF0 && first < 0xF8) {
    length = 4;
    smallest = 0x10000;
    code = first & 0x07;
  } else if (first >= 0xE0 && first < 0xF0) {
    length = 3;
    smallest = 0x800;
    code = first & 0x0F;
  } else if (first >= 0xC0 && first < 0xE0) {
    length = 2;
    smallest = 0x80;
    code = first & 0x1F;
  } else if (first >= 0x80) {
    ++*at;
    return kReplacement;
  }
  if (text.size() - *at < length) {
    ++*at;
    return kReplacement;
  }
  for (std::size_t i = 1; i < length; ++i) {
    const std::uint32_t next = byte(*at + i);
    if ((next & 0xC0) != 0x80) {
      ++*at;
      return kReplacement;
    }
    code = (code << 6) | (next & 0x3F);
  }
  const bool surrogate = code >= 0xD800 && code < 0xE000;
  if (code < smallest || code > 0x10FFFF || surrogate) {
    ++*at;
    return kReplacement;
  }
  *at += length;
  return code;
}

void AppendUnicodeEscape(std::uint32_t unit, std::string* escaped) {
  char text[8];
  std::snprintf(text, sizeof(text), "\\u%04x", unit);
  *escaped += text;
}

bool StandsBare(const std::string& text) {
  for (const char c : text) {
    const bool plain = (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z') ||
                       (c >= '0' && c <= '9') || c == '.' || c == '_' ||
                       c == ':' || c == '/' || c == '@' || c == '+' || c == '-';
    if (!plain) return false;
  }
  return !text.empty();
}

std::string NumberText(double value) {
  // JSON has no word for what is not finite.
  if (!std::isfinite(value)) return "null";
  char text[32];
  std::snprintf(text, sizeof(text), "%.6g", value);
  return text;
}

}  // namespace

std::string EscapeForLog(const std::string& text) {
  std::string escaped;
  escaped.reserve(text.size());
  for (std::size_t at = 0; at < text.size();) {
    const std::uint32_t code = NextCodePoint(text, &at);
    switch (code) {
      case '"':
        escaped += "\\\"";
        continue;
      case '\\':
        escaped += "\\\\";
        continue;
      case '\n':
        escaped += "\\n";
        continue;
      case '\r':
        escaped += "\\r";
        continue;
      case '\t':
        escaped += "\\t";
        continue;
      default:
        break;
    }
    if (code >= 0x20 && code < 0x7F) {
      escaped += static_cast<char>(code);
    } else if (code < 0x10000) {
      AppendUnicodeEscape(code, &escaped);
    } else {
      AppendUnicodeEscape(0xD800 + ((code - 0x10000) >> 10), &escaped);
      AppendUnicodeEscape(0xDC00 + ((code - 0x10000) & 0x3FF), &escaped);
    }
  }
  return escaped;
}

namespace {

std::unique_ptr<spdlog::formatter> MakeFormatter(LogFormat format) {
  return std::make_unique<spdlog::pattern_formatter>(
      format == LogFormat::kJson ? kJsonPattern : kTextPattern,
      spdlog::pattern_time_type::utc);
}

std::string Render(LogFormat format, const char* event,
                   std::initializer_list<LogField> fields) {
  const bool json = format == LogFormat::kJson;
  std::string line =
      json ? std::string("\"event\":\"") + event + "\"" : std::string(event);
  for (const LogField& field : fields) {
    const auto* text = std::get_if<std::string>(&field.value);
    if (text != nullptr && text->empty()) continue;
    line += json ? std::string(",\"") + field.key + "\":"
                 : std::string(" ") + field.key + "=";
    if (text != nullptr) {
      if (!json && StandsBare(*text)) {
        line += *text;
      } else {
        line += "\"" + EscapeForLog(*text) + "\"";
      }
    } else if (const auto* integer = std::get_if<std::int64_t>(&field.value)) {
      line += std::to_string(*integer);
    } else {
      line += NumberText(std::get<double>(field.value));
    }
  }
  return line;
}

std::string ToString(const spdlog::memory_buf_t& buffer) {
  return std::string(buffer.data(), buffer.size());
}

// The line that stands for so many dropped ones.
std::string GapLine(LogFormat format, std::int64_t dropped) {
  const std::string text =
      Render(format, "log_lines_dropped", {{"count", dropped}});
  spdlog::memory_buf_t line;
  MakeFormatter(format)->format(
      spdlog::details::log_msg("revisitd", spdlog::level::warn, text), line);
  return ToString(line);
}

class LineWriterSink final : public spdlog::sinks::base_sink<std::mutex> {
 public:
  LineWriterSink(LogFormat format, int descriptor)
      : writer_(descriptor, LineWriter::Options(),
                [format](std::int64_t dropped) {
                  return GapLine(format, dropped);
                }) {}

 private:
  void sink_it_(const spdlog::details::log_msg& message) override {
    spdlog::memory_buf_t line;
    formatter_->format(message, line);
    writer_.Write(ToString(line));
  }
  void flush_() override {}

  LineWriter writer_;
};

}  // namespace

struct Log::Sink {
  explicit Sink(spdlog::sink_ptr sink) : logger("revisitd", std::move(sink)) {}
  // Logging changes nothing that a caller could see.
  mutable spdlog::logger logger;
};

Log::Log(LogFormat format, LogLevel level, std::unique_ptr<Sink> sink)
    : format_(format), sink_(std::move(sink)) {
  sink_->logger.set_level(ToSpdlog(level));
  sink_->logger.flush_on(spdlog::level::info);
  sink_->logger.set_formatter(MakeFormatter(format));
}

Log::Log(LogFormat format, LogLevel level, int descriptor)
    : Log(format, level,
          std::make_unique<Sink>(
              std::make_shared<LineWriterSink>(format, descriptor))) {}

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

}  // namespace revisit::server
