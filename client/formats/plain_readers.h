// Lines of numbers: TUM and KITTI; and what all readers of lines share.
#ifndef REVISIT_CLIENT_FORMATS_PLAIN_READERS_H_
#define REVISIT_CLIENT_FORMATS_PLAIN_READERS_H_

#include <memory>
#include <optional>
#include <string_view>

#include "absl/status/statusor.h"
#include "client/formats/reader.h"
#include "client/formats/text_lines.h"

namespace revisit::client {

// Begins a comment of a TUM file that says how the recording starts whose first
// pose is on the next line: a revisit.v1.RecordingStart follows, as JSON.
inline constexpr std::string_view kRecordingMark = "# recording ";

absl::StatusOr<std::unique_ptr<SampleReader>> ReadTum(
    std::unique_ptr<Lines> lines, const ReaderOptions& options);
absl::StatusOr<std::unique_ptr<SampleReader>> ReadKitti(
    std::unique_ptr<Lines> lines, const ReaderOptions& options);

// The end of the samples where the lines ended: nothing, or why.
absl::StatusOr<std::optional<Sample>> EndOf(const Lines& lines);

// An error if the position or the quaternion cannot be one.
absl::Status CheckPose(const Sample& sample, const Lines& lines);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_FORMATS_PLAIN_READERS_H_
