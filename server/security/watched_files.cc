#include "server/security/watched_files.h"

#include <cerrno>
#include <cstddef>
#include <cstdio>
#include <cstring>
#include <memory>
#include <utility>

#include "absl/status/status.h"
#include "server/base/metrics.h"

namespace revisit::server {
namespace {

constexpr std::size_t kMaxBytes = std::size_t{1} << 20;

absl::StatusOr<std::string> ReadFile(const std::string& path) {
  const auto close = [](std::FILE* file) { std::fclose(file); };
  const std::unique_ptr<std::FILE, decltype(close)> file(
      std::fopen(path.c_str(), "rbe"), close);
  if (file == nullptr) {
    return absl::InvalidArgumentError(
        ("cannot read " + path + ": " + std::strerror(errno)).c_str());
  }
  std::string text(kMaxBytes + 1, '\0');
  text.resize(std::fread(text.data(), 1, text.size(), file.get()));
  if (std::ferror(file.get()) != 0) {
    return absl::InvalidArgumentError(
        ("cannot read " + path + ": " + std::strerror(errno)).c_str());
  }
  if (text.size() > kMaxBytes) {
    return absl::InvalidArgumentError(
        (path + " is larger than " + std::to_string(kMaxBytes) + " bytes")
            .c_str());
  }
  return text;
}

absl::StatusOr<std::vector<std::string>> ReadFiles(
    const std::vector<std::string>& paths) {
  std::vector<std::string> contents;
  for (const std::string& path : paths) {
    absl::StatusOr<std::string> text = ReadFile(path);
    if (!text.ok()) return text.status();
    contents.push_back(*std::move(text));
  }
  return contents;
}

}  // namespace

WatchedFiles::WatchedFiles(std::vector<std::string> paths)
    : paths_(std::move(paths)),
      contents_(absl::InvalidArgumentError("not looked at yet")) {}

bool WatchedFiles::Look() {
  absl::StatusOr<std::vector<std::string>> now = ReadFiles(paths_);
  const bool same =
      looked_ && now.ok() == contents_.ok() &&
      (now.ok() ? *now == *contents_ : now.status() == contents_.status());
  looked_ = true;
  if (!same) contents_ = std::move(now);
  return !same;
}

void CollectFilesMetrics(const char* files, const FilesState& state,
                         Metrics* metrics) {
  metrics
      ->Gauge("revisit_security_files_loaded_timestamp_seconds",
              "When the files in use were taken up, since the Unix epoch.")
      .Add(state.loaded, {{"files", files}});
  metrics
      ->Gauge("revisit_security_files_refused",
              "Whether the files have changed since into what was refused.")
      .Add(state.refused, {{"files", files}});
}

}  // namespace revisit::server
