// Statuses as the client library returns them, and their details for programs.
#ifndef REVISIT_CLIENT_REVISIT_STATUS_H_
#define REVISIT_CLIENT_REVISIT_STATUS_H_

#include <chrono>
#include <map>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/status.h"

namespace revisit::client {

struct FieldViolation {
  std::string field;
  std::string description;
};

// The longest wait that is taken over from a server. One that asks for more, by
// mistake or malice, is asked again after so long.
inline constexpr std::chrono::minutes kLongestRetryDelay{5};

// The google.rpc details of a status. Whatever a status does not carry is
// empty.
struct ErrorDetails {
  // ErrorInfo. In the domain "revisit" the reason is a value of
  // revisit.v1.ErrorReason without its prefix. A status without a reason comes
  // from the transport or from this library.
  std::string reason;
  std::string domain;
  std::map<std::string, std::string> metadata;
  // BadRequest.
  std::vector<FieldViolation> field_violations;
  // RetryInfo: try again no sooner than this. Between 0 and kLongestRetryDelay,
  // whatever the server asked for.
  std::optional<std::chrono::nanoseconds> retry_delay;
};

// Reads the details that a status of this library carries as payloads, by their
// type URLs ("type.googleapis.com/google.rpc.ErrorInfo" and so on).
ErrorDetails DetailsOf(const absl::Status& status);

// Whether a call that nobody here cancelled was cut on its way, so that nobody
// said how it ended; what the server says itself has a reason. gRPC answers
// CANCELLED to calls that come in the moment between the last refusal of a
// server that shuts down and the end of its connection, and INTERNAL to calls
// that gRPC or a proxy reset (RST_STREAM), as Envoy does to a stream when the
// server behind it dies.
bool IsCut(const absl::Status& status);

// Whether the server says that it has changed nothing because the vehicle is,
// or was meanwhile, another server's (NOT_OWNER, EPOCH_FENCED): then also a
// call that must not be done twice may be made again.
bool WasElsewhere(const absl::Status& status);

// Whether a change of a group was not made because others changed the group at
// the same time (REVISION_MISMATCH): where it was for any revision, it may be
// made again.
bool LostToOthers(const absl::Status& status);

// Whether a search in a group was not made because the server still reads
// histories of its members (GROUP_NOT_READY): it goes on with that meanwhile.
bool ReadsHistories(const absl::Status& status);

// Describes a status to people: the message, the reason, and a line for each
// field violation that the message does not contain. Fit for a terminal: a
// control character or an invisible one in what the server said is shown by its
// number, "<U+001B>".
std::string Describe(const absl::Status& status);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_REVISIT_STATUS_H_
