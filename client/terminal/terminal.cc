#include "client/terminal/terminal.h"

#include <sys/ioctl.h>

#include <algorithm>
#include <charconv>
#include <cstdlib>
#include <utility>

#include "absl/strings/cord.h"
#include "absl/strings/str_cat.h"
#include "client/revisit/printable_text.h"
#include "client/revisit/status.h"
#include "google/protobuf/descriptor.h"
#include "google/protobuf/message.h"
#include "google/protobuf/util/json_util.h"
#include "nlohmann/json.hpp"

namespace revisit::client {
namespace {

constexpr char kLocalUrl[] = "revisit.client/LocalError";
constexpr char kUsageUrl[] = "revisit.client/UsageError";
constexpr char kHintUrl[] = "revisit.client/Hint";

bool IsLocal(const absl::Status& status) {
  return status.GetPayload(kLocalUrl).has_value();
}

bool IsUsage(const absl::Status& status) {
  return status.GetPayload(kUsageUrl).has_value();
}

std::string HintOf(const absl::Status& status) {
  const auto hint = status.GetPayload(kHintUrl);
  return hint.has_value() ? std::string(*hint) : "";
}

// "1:02:05 left", or "2:05 left" within the hour.
std::string TimeLeft(double seconds) {
  constexpr double kMost = 1e7;
  const auto whole = static_cast<std::int64_t>(std::min(seconds, kMost));
  const auto two = [](std::int64_t value) {
    return absl::StrCat(value < 10 ? "0" : "", value);
  };
  const std::int64_t hours = whole / 3600;
  const std::int64_t minutes = whole / 60 % 60;
  return absl::StrCat(hours > 0 ? absl::StrCat(hours, ":", two(minutes))
                                : absl::StrCat(minutes),
                      ":", two(whole % 60), " left");
}

using Json = nlohmann::ordered_json;

// Makes numbers of the texts as which protobuf writes whole numbers of 64 bits.
void MakeNumbers(const google::protobuf::Descriptor* type, Json* json);

void MakeNumber(const google::protobuf::FieldDescriptor* field, Json* value) {
  using Field = google::protobuf::FieldDescriptor;
  if (field->cpp_type() == Field::CPPTYPE_MESSAGE) {
    MakeNumbers(field->message_type(), value);
  } else if (field->cpp_type() == Field::CPPTYPE_INT64) {
    *value =
        std::strtoll(value->get_ref<const std::string&>().c_str(), nullptr, 10);
  } else if (field->cpp_type() == Field::CPPTYPE_UINT64) {
    *value = std::strtoull(value->get_ref<const std::string&>().c_str(),
                           nullptr, 10);
  }
}

void MakeNumbers(const google::protobuf::Descriptor* type, Json* json) {
  // The well-known types are texts, and no message here has maps.
  if (!json->is_object()) return;
  for (int i = 0; i < type->field_count(); ++i) {
    const google::protobuf::FieldDescriptor* const field = type->field(i);
    const auto found = json->find(field->json_name());
    if (found == json->end() || found->is_null()) continue;
    if (!field->is_repeated()) {
      MakeNumber(field, &*found);
      continue;
    }
    for (Json& element : *found) MakeNumber(field, &element);
  }
}

}  // namespace

std::size_t TerminalWidth(int descriptor) {
  if (const char* columns = std::getenv("COLUMNS")) {
    const long width = std::strtol(columns, nullptr, 10);
    if (width > 0) return static_cast<std::size_t>(width);
  }
  winsize size = {};
  return ioctl(descriptor, TIOCGWINSZ, &size) == 0 ? size.ws_col : 0;
}

absl::Status WithHint(const absl::Status& status, const std::string& hint) {
  const std::string before = HintOf(status);
  absl::Status with_hint = status;
  with_hint.SetPayload(
      kHintUrl,
      absl::Cord(absl::StrCat(before, before.empty() ? "" : "\n", hint)));
  return with_hint;
}

absl::Status UsageError(const std::string& problem, const std::string& hint) {
  absl::Status error =
      WithHint(absl::InvalidArgumentError(absl::StrCat(problem)), hint);
  error.SetPayload(kUsageUrl, absl::Cord());
  return error;
}

absl::Status LocalError(const absl::Status& status) {
  absl::Status local = status;
  local.SetPayload(kLocalUrl, absl::Cord());
  return local;
}

int ExitCodeOf(const absl::Status& status) {
  if (status.ok()) return kExitOk;
  if (IsUsage(status)) return kExitUsage;
  if (IsLocal(status)) return kExitLocalError;
  return kExitUsage + static_cast<int>(status.code());
}

std::string ErrorText(const absl::Status& status) {
  // A wrong usage is told on several lines, and says nothing of a server.
  const std::string text = IsUsage(status) ? std::string(status.message())
                           : IsLocal(status)
                               ? Printable(std::string(status.message()))
                               : Describe(status);
  const std::string hint = HintOf(status);
  return hint.empty() ? text : absl::StrCat(text, "\n", hint);
}

std::string JsonText(const nlohmann::ordered_json& json, bool pretty) {
  return PrintableJson(
      json.dump(pretty ? 1 : -1, ' ', false, Json::error_handler_t::replace));
}

std::string ToJson(const google::protobuf::Message& message, bool pretty) {
  google::protobuf::util::JsonPrintOptions options;
  options.always_print_primitive_fields = true;
  std::string text;
  const auto status =
      google::protobuf::util::MessageToJsonString(message, &text, options);
  // Only messages with Any fields of unknown types cannot be printed.
  if (!status.ok()) return "null";
  Json json = Json::parse(text, nullptr, /*allow_exceptions=*/false);
  MakeNumbers(message.GetDescriptor(), &json);
  return JsonText(json, pretty);
}

std::string ErrorToJson(const absl::Status& status) {
  const ErrorDetails details = DetailsOf(status);
  Json error;
  error["code"] = absl::StatusCodeToString(status.code());
  error["message"] = std::string(status.message());
  error["reason"] = IsUsage(status) ? "USAGE" : details.reason;
  error["metadata"] = details.metadata;
  error["fieldViolations"] = Json::array();
  for (const FieldViolation& violation : details.field_violations) {
    error["fieldViolations"].push_back(
        {{"field", violation.field}, {"description", violation.description}});
  }
  const std::string hint = HintOf(status);
  if (!hint.empty()) error["hint"] = hint;
  Json whole;
  whole["error"] = std::move(error);
  return JsonText(whole, false);
}

void PrintFields(const std::vector<std::pair<std::string, std::string>>& fields,
                 std::ostream& out) {
  std::vector<std::pair<std::string, std::string>> printable;
  std::size_t width = 0;
  for (const auto& [name, value] : fields) {
    printable.emplace_back(Printable(name), Printable(value));
    width = std::max(width, printable.back().first.size());
  }
  for (const auto& [name, value] : printable) {
    std::string line = name + std::string(width + 2 - name.size(), ' ') + value;
    line.erase(line.find_last_not_of(' ') + 1);
    out << line << '\n';
  }
}

std::string Fixed(double value, int digits) {
  char buffer[512];
  const auto [end, error] = std::to_chars(
      buffer, buffer + sizeof(buffer), value, std::chars_format::fixed, digits);
  return error == std::errc() ? std::string(buffer, end) : "?";
}

Progress::Progress(const Terminal& terminal, const std::string& label,
                   std::uint64_t total, std::string unit)
    : terminal_(terminal.progress_is_terminal),
      label_(Printable(label)),
      total_(total),
      unit_(std::move(unit)),
      start_(Clock::now()),
      out_(terminal.progress),
      last_draw_(start_) {}

Progress::~Progress() {
  const MutexLock lock(&mutex_);
  if (!bar_shown_) return;
  Draw();
  out_ << '\n' << std::flush;
}

void Progress::Update(std::uint64_t done) {
  constexpr auto kTerminalInterval = std::chrono::milliseconds(100);
  constexpr auto kLineInterval = std::chrono::seconds(5);
  const MutexLock lock(&mutex_);
  done_ = done;
  const auto now = Clock::now();
  const Clock::duration interval = terminal_
                                       ? Clock::duration(kTerminalInterval)
                                       : Clock::duration(kLineInterval);
  if (now - last_draw_ < interval) return;
  last_draw_ = now;
  Draw();
}

void Progress::Note(const std::string& text) {
  const MutexLock lock(&mutex_);
  EraseBar();
  out_ << label_ << ": " << text << '\n' << std::flush;
}

void Progress::EraseBar() {
  if (bar_shown_) out_ << "\r\x1b[K";
  bar_shown_ = false;
}

void Progress::Draw() {
  constexpr int kWidth = 30;
  const double seconds =
      std::chrono::duration<double>(Clock::now() - start_).count();
  const double rate =
      seconds > 0.0 ? static_cast<double>(done_) / seconds : 0.0;
  std::string figures =
      absl::StrCat(done_, total_ == 0 ? "" : absl::StrCat("/", total_).c_str(),
                   " ", unit_, "  ", Fixed(rate, 0), "/s");
  if (done_ < total_ && rate > 0.0) {
    absl::StrAppend(&figures, "  ",
                    TimeLeft(static_cast<double>(total_ - done_) / rate));
  }
  if (total_ == 0) {
    out_ << (terminal_ ? "\r\x1b[K" : "") << label_ << ": " << figures
         << (terminal_ ? "" : "\n") << std::flush;
    bar_shown_ = terminal_;
    return;
  }
  const double share =
      std::min(1.0, static_cast<double>(done_) / static_cast<double>(total_));
  if (!terminal_) {
    out_ << label_ << ": " << Fixed(100.0 * share, 0) << " %  " << figures
         << '\n'
         << std::flush;
    return;
  }
  const int filled = static_cast<int>(share * kWidth);
  out_ << "\r\x1b[K" << label_ << " [" << std::string(filled, '=')
       << std::string(kWidth - filled, ' ') << "] " << Fixed(100.0 * share, 0)
       << " %  " << figures << std::flush;
  bar_shown_ = true;
}

}  // namespace revisit::client
