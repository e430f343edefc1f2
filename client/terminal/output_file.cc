#include "client/terminal/output_file.h"

#include <unistd.h>

#include <cerrno>
#include <cstdio>
#include <cstring>
#include <filesystem>
#include <system_error>
#include <utility>

#include "absl/strings/str_cat.h"
#include "client/terminal/terminal.h"

namespace revisit::client {

namespace fs = std::filesystem;

OutputFile::OutputFile(std::string path) : path_(std::move(path)) {}

OutputFile::~OutputFile() {
  if (!aside_.empty()) std::remove(aside_.c_str());
}

absl::Status OutputFile::Open() {
  std::error_code error;
  const fs::file_status before = fs::status(path_, error);
  // A name in /dev may lead to a file that somebody holds open.
  if (path_.rfind("/dev/", 0) == 0 ||
      (fs::exists(before) && !fs::is_regular_file(before))) {
    stream_.open(path_, std::ios::binary);
    return stream_ ? absl::OkStatus() : Error();
  }
  if (fs::exists(before)) {
    // A file that may not be written to is not replaced either.
    if (access(path_.c_str(), W_OK) != 0) return Error();
    // A link goes on leading to it.
    path_ = fs::canonical(path_, error).string();
  }
  aside_ = absl::StrCat(path_, ".", getpid(), ".part");
  stream_.open(aside_, std::ios::binary | std::ios::trunc);
  if (!stream_) return Error();
  if (fs::exists(before)) {
    fs::permissions(aside_, before.permissions(), error);
  }
  return absl::OkStatus();
}

absl::Status OutputFile::Finish() {
  stream_.close();
  if (!stream_) return Error();
  if (!aside_.empty() && std::rename(aside_.c_str(), path_.c_str()) != 0) {
    return Error();
  }
  aside_.clear();
  return absl::OkStatus();
}

absl::Status OutputFile::Error() const {
  return LocalError(
      absl::UnknownError(absl::StrCat(path_, ": ", std::strerror(errno))));
}

absl::Status CheckOutput(const std::ostream& out) {
  if (out.good()) return absl::OkStatus();
  return LocalError(absl::UnknownError("the output cannot be written"));
}

absl::Status WriteTo(const std::string& path, std::ostream& terminal,
                     const std::function<absl::Status(std::ostream&)>& write) {
  if (path.empty()) {
    if (absl::Status status = write(terminal); !status.ok()) return status;
    terminal.flush();
    return CheckOutput(terminal);
  }
  OutputFile file(path);
  if (absl::Status opened = file.Open(); !opened.ok()) return opened;
  if (absl::Status status = write(file.stream()); !status.ok()) return status;
  return file.Finish();
}

}  // namespace revisit::client
