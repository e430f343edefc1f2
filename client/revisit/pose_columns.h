// Poses as columns, which take less to send and to read.
#ifndef REVISIT_CLIENT_REVISIT_POSE_COLUMNS_H_
#define REVISIT_CLIENT_REVISIT_POSE_COLUMNS_H_

#include <optional>
#include <vector>

#include "absl/status/status.h"
#include "google/protobuf/repeated_field.h"
#include "revisit/v1/geometry.pb.h"
#include "revisit/v1/pose_columns.pb.h"

namespace revisit::client {

// Columns that say what these poses say, to the bit; nothing where there are
// none, such as for poses of which some have stamps and others have not, for
// one that begins a recording behind others, or for those that no server takes
// anyway. REQUIRES: at least one pose; their sequences follow each other.
std::optional<v1::PoseColumns> PoseColumnsOf(
    const std::vector<const v1::Pose*>& poses);

// Adds the poses that these columns say. INTERNAL, with none added, if columns
// that a server answered without a read mask do not fit each other.
absl::Status AddPosesOf(const v1::PoseColumns& columns,
                        google::protobuf::RepeatedPtrField<v1::Pose>* poses);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_REVISIT_POSE_COLUMNS_H_
