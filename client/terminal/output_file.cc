#include "client/terminal/output_file.h"

#include <unistd.h>

#include <cerrno>
#include <cstdio>
#include <filesystem>
#include <system_error>
#include <utility>

#include "absl/strings/str_cat.h"
#include "client/terminal/file_error.h"
#include "client/terminal/terminal.h"

namespace revisit::client {

namespace fs = std::filesystem;
namespace {

// Why a stream has failed, as errno has it; 0 if it cannot be told. A stream
// keeps no reason, so one character more is written, which fails for the same
// one. The stream stays failed.
int ErrorOf(std::ostream& out) {
  out.clear();
  errno = 0;
  out.put('\n').flush();
  const int error = errno;
  out.setstate(std::ios::badbit);
  return error;
}

}  // namespace

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
    return stream_ ? absl::OkStatus() : FileError(path_, errno);
  }
  if (fs::exists(before)) {
    // A file that may not be written to is not replaced either.
    if (access(path_.c_str(), W_OK) != 0) return FileError(path_, errno);
    // A link goes on leading to it.
    path_ = fs::canonical(path_, error).string();
  }
  aside_ = absl::StrCat(path_, ".", getpid(), ".part");
  stream_.open(aside_, std::ios::binary | std::ios::trunc);
  if (!stream_) return FileError(path_, errno);
  if (fs::exists(before)) {
    fs::permissions(aside_, before.permissions(), error);
  }
  return absl::OkStatus();
}

absl::Status OutputFile::Finish() {
  if (!stream_) return FileError(path_, ErrorOf(stream_));
  stream_.close();
  if (!stream_) return FileError(path_, errno);
  if (!aside_.empty() && std::rename(aside_.c_str(), path_.c_str()) != 0) {
    return FileError(path_, errno);
  }
  aside_.clear();
  return absl::OkStatus();
}

absl::Status CheckOutput(std::ostream& out) {
  if (out.good()) return absl::OkStatus();
  const std::string problem = "the output cannot be written";
  const int error = ErrorOf(out);
  return error == 0 ? LocalError(absl::UnknownError(problem))
                    : FileError(problem, error);
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
  if (absl::Status status = write(file.stream()); !status.ok()) {
    return file.stream() ? status : file.Finish();
  }
  return file.Finish();
}

}  // namespace revisit::client
