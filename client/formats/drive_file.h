// A recording that is held whole, as an evaluation needs it.
#ifndef REVISIT_CLIENT_FORMATS_DRIVE_FILE_H_
#define REVISIT_CLIENT_FORMATS_DRIVE_FILE_H_

#include <memory>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "client/formats/reader.h"
#include "client/formats/sample.h"

namespace revisit::client {

struct Drive {
  // Name of the file without directory and ending.
  std::string name;
  std::vector<Sample> samples;
  // One for each sample, or none at all.
  std::vector<PlanarPose> truth;
  LeftOut left_out;
};

// Reads a file to its end. Errors are those of reader.h; INVALID_ARGUMENT also
// if no pose is left, because the vehicle never moves.
absl::StatusOr<Drive> ReadDriveFile(const std::string& path,
                                    const ReaderOptions& options);

// Reads what is left of `reader`; `path` is for messages and the drive's name.
absl::StatusOr<Drive> ReadDrive(SampleReader* reader, const std::string& path);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_FORMATS_DRIVE_FILE_H_
