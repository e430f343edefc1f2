// The contents of groups, their members and the links between these, beside the
// columns of their rows: the payloads of their records (revisit.stored.Group,
// GroupMember and GroupLink).
//
// Functions that read a payload return DATA_LOSS (STORE_CORRUPT) if it is not
// one of its kind.
#ifndef REVISIT_SERVER_RECORDS_GROUP_CONTENT_H_
#define REVISIT_SERVER_RECORDS_GROUP_CONTENT_H_

#include <cstdint>
#include <functional>
#include <memory>
#include <optional>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/drive/measured_loop.h"
#include "core/geometry/recording_start.h"
#include "core/settings.h"
#include "server/fields/group_settings.h"
#include "server/fields/pose_fields.h"
#include "server/records/pair_content.h"

namespace revisit::server {

// ---- Groups

struct GroupContent {
  std::string display_name;
  GroupSettings settings;
  // Since the Unix epoch.
  std::int64_t create_time_ns = 0;
};

std::string EncodeGroupContent(const GroupContent& content);
absl::StatusOr<GroupContent> DecodeGroupContent(const std::string& payload);

// ---- Members

// `datum`: null if there is none, else of kDatum. Without one the payload is
// empty.
std::string EncodeMemberContent(const RecordingStartFields* datum);

// Calls `read` with the datum, which is valid during the call; with null if
// there is none.
absl::Status ReadMemberContent(
    const std::string& payload,
    const std::function<void(const RecordingStartFields*)>& read);

// Null if there is no datum. INVALID_ARGUMENT if it is none for a vehicle of
// this state space, which a vehicle may change as long as it has no poses.
absl::StatusOr<std::shared_ptr<const core::RecordingStart>> DecodeMemberDatum(
    const std::string& payload, core::StateSpace space);

// ---- Links

struct LinkContent {
  // Nobody has deleted it.
  PairContent content;
  // Since the Unix epoch.
  std::int64_t create_time_ns = 0;
};

std::string EncodeLinkContent(const LinkContent& content);

// The payload of the same link with another time of creation. REQUIRES: the
// payload is one of a link.
std::string LinkContentCreatedAt(const std::string& payload,
                                 std::int64_t create_time_ns);

// Calls `read` with the content, which is valid during the call.
absl::Status ReadLinkContent(
    const std::string& payload,
    const std::function<void(const LinkContent&)>& read);

// Whether measurement, note and score are the same, whoever added them, and
// when.
bool LinkContentsSayTheSame(const std::string& payload,
                            const std::string& other);

// Nothing if there is no measurement. INVALID_ARGUMENT if it is none between
// vehicles of this state space.
absl::StatusOr<std::optional<core::LoopMeasurement>> DecodeLinkMeasurement(
    const std::string& payload, core::StateSpace space);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_RECORDS_GROUP_CONTENT_H_
