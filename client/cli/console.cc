#include "client/cli/console.h"

#include <algorithm>
#include <charconv>
#include <utility>

#include "absl/strings/cord.h"
#include "absl/strings/str_cat.h"
#include "client/revisit/status.h"
#include "google/protobuf/util/json_util.h"
#include "nlohmann/json.hpp"

namespace revisit::client {
namespace {

constexpr char kLocalUrl[] = "revisit.client/LocalError";

bool IsLocal(const absl::Status& status) {
  return status.GetPayload(kLocalUrl).has_value();
}

std::string Padded(const std::string& text, std::size_t width,
                   Table::Align align) {
  const std::string blanks(width - std::min(width, text.size()), ' ');
  return align == Table::Align::kLeft ? text + blanks : blanks + text;
}

void PrintLine(std::string line, std::ostream& out) {
  line.erase(line.find_last_not_of(' ') + 1);
  out << line << '\n';
}

}  // namespace

absl::Status LocalError(const absl::Status& status) {
  absl::Status local = status;
  local.SetPayload(kLocalUrl, absl::Cord());
  return local;
}

int ExitCodeOf(const absl::Status& status) {
  if (status.ok()) return kExitOk;
  if (IsLocal(status)) return kExitLocalError;
  return kExitUsage + static_cast<int>(status.code());
}

std::string ErrorText(const absl::Status& status) {
  return IsLocal(status) ? std::string(status.message()) : Describe(status);
}

std::string ToJson(const google::protobuf::Message& message, bool pretty) {
  google::protobuf::util::JsonPrintOptions options;
  options.add_whitespace = pretty;
  options.always_print_primitive_fields = true;
  std::string json;
  const auto status =
      google::protobuf::util::MessageToJsonString(message, &json, options);
  // Only messages with Any fields of unknown types cannot be printed.
  if (!status.ok()) return "null";
  while (!json.empty() && json.back() == '\n') json.pop_back();
  return json;
}

std::string ErrorToJson(const absl::Status& status) {
  const ErrorDetails details = DetailsOf(status);
  nlohmann::ordered_json error;
  error["code"] = absl::StatusCodeToString(status.code());
  error["message"] = std::string(status.message());
  error["reason"] = details.reason;
  error["metadata"] = details.metadata;
  error["fieldViolations"] = nlohmann::ordered_json::array();
  for (const FieldViolation& violation : details.field_violations) {
    error["fieldViolations"].push_back(
        {{"field", violation.field}, {"description", violation.description}});
  }
  nlohmann::ordered_json whole;
  whole["error"] = std::move(error);
  return whole.dump(-1, ' ', false,
                    nlohmann::ordered_json::error_handler_t::replace);
}

Table::Table(std::vector<Column> columns) : columns_(std::move(columns)) {}

void Table::AddRow(std::vector<std::string> cells) {
  rows_.push_back(std::move(cells));
}

void Table::AddRule() { rows_.emplace_back(); }

void Table::Print(std::ostream& out) const {
  std::vector<std::size_t> widths;
  std::size_t across = 2 * (columns_.size() - 1);
  for (std::size_t i = 0; i < columns_.size(); ++i) {
    std::size_t width = columns_[i].title.size();
    for (const auto& row : rows_) {
      if (!row.empty()) width = std::max(width, row[i].size());
    }
    widths.push_back(width);
    across += width;
  }
  std::string line;
  for (std::size_t i = 0; i < columns_.size(); ++i) {
    if (i > 0) line += "  ";
    line += Padded(columns_[i].title, widths[i], columns_[i].align);
  }
  PrintLine(line, out);
  for (const auto& row : rows_) {
    if (row.empty()) {
      out << std::string(across, '-') << '\n';
      continue;
    }
    line.clear();
    for (std::size_t i = 0; i < columns_.size(); ++i) {
      if (i > 0) line += "  ";
      line += Padded(row[i], widths[i], columns_[i].align);
    }
    PrintLine(line, out);
  }
}

void PrintFields(const std::vector<std::pair<std::string, std::string>>& fields,
                 std::ostream& out) {
  std::size_t width = 0;
  for (const auto& [name, value] : fields) {
    width = std::max(width, name.size());
  }
  for (const auto& [name, value] : fields) {
    PrintLine(Padded(name, width + 2, Table::Align::kLeft) + value, out);
  }
}

std::string Fixed(double value, int digits) {
  char buffer[512];
  const auto [end, error] = std::to_chars(
      buffer, buffer + sizeof(buffer), value, std::chars_format::fixed, digits);
  return error == std::errc() ? std::string(buffer, end) : "?";
}

Progress::Progress(const Console& console, std::string label,
                   std::uint64_t total, std::string unit)
    : terminal_(console.progress_is_terminal),
      label_(std::move(label)),
      total_(total),
      unit_(std::move(unit)),
      start_(Clock::now()),
      out_(console.progress),
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
  const std::string figures =
      absl::StrCat(done_, total_ == 0 ? "" : absl::StrCat("/", total_).c_str(),
                   " ", unit_, "  ", Fixed(rate, 0), "/s");
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
