#include "server/telemetry/audit_log.h"

#include <fcntl.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cstring>
#include <iterator>
#include <utility>

#include "absl/strings/str_cat.h"

namespace revisit::server {
namespace {

constexpr const char* kMethods[] = {
    "AcceptDataLoss",
    "AddGroupMember",
    "AddInterVehicleLoopClosure",
    "AddLoopClosure",
    "CreateGroup",
    "CreateVehicle",
    "DeleteGroup",
    "DeleteInterVehicleLoopClosure",
    "DeleteInterVehicleRejectedCandidate",
    "DeleteLoopClosure",
    "DeleteRejectedCandidate",
    "DeleteVehicle",
    "RejectCandidate",
    "RejectInterVehicleCandidate",
    "RemoveGroupMember",
    "RevisePoses",
    "UpdateGroup",
    "UpdateGroupMember",
    "UpdateVehicle",
};

absl::StatusOr<int> OpenToAppend(const std::string& path) {
  const int descriptor =
      open(path.c_str(), O_WRONLY | O_APPEND | O_CREAT | O_CLOEXEC, 0600);
  if (descriptor >= 0) return descriptor;
  return absl::InvalidArgumentError(
      absl::StrCat("cannot open audit-log ", path, ": ", strerror(errno)));
}

}  // namespace

absl::StatusOr<std::unique_ptr<AuditLog>> AuditLog::Open(
    const std::string& path, LogFormat format) {
  const absl::StatusOr<int> descriptor = OpenToAppend(path);
  if (!descriptor.ok()) return descriptor.status();
  return std::unique_ptr<AuditLog>(new AuditLog(path, format, *descriptor));
}

AuditLog::AuditLog(std::string path, LogFormat format, int descriptor)
    : path_(std::move(path)),
      descriptor_(descriptor),
      log_(std::make_unique<Log>(format, LogLevel::kInfo, descriptor)) {}

AuditLog::~AuditLog() {
  log_.reset();
  close(descriptor_);
}

bool AuditLog::Covers(const std::string& method) {
  return std::any_of(std::begin(kMethods), std::end(kMethods),
                     [&](const char* covered) { return method == covered; });
}

void AuditLog::Write(std::initializer_list<LogField> fields) const {
  log_->Write(LogLevel::kInfo, "audit", fields);
}

absl::Status AuditLog::Reopen() {
  const absl::StatusOr<int> opened = OpenToAppend(path_);
  if (!opened.ok()) return opened.status();
  // The number of the descriptor stays, to which another thread may be writing.
  const int replaced = dup3(*opened, descriptor_, O_CLOEXEC);
  const int error = errno;
  close(*opened);
  if (replaced >= 0) return absl::OkStatus();
  return absl::InvalidArgumentError(absl::StrCat(
      "cannot open audit-log ", path_, " again: ", strerror(error)));
}

}  // namespace revisit::server
