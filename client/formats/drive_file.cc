#include "client/formats/drive_file.h"

#include <utility>

#include "client/formats/text_lines.h"

namespace revisit::client {

absl::StatusOr<Drive> ReadDrive(SampleReader* reader, const std::string& path) {
  Drive drive;
  drive.name = StemOf(path);
  for (;;) {
    auto sample = reader->Next();
    if (!sample.ok()) return sample.status();
    if (!sample->has_value()) break;
    if ((*sample)->truth.has_value()) drive.truth.push_back(*(*sample)->truth);
    drive.samples.push_back(**std::move(sample));
  }
  drive.left_out = reader->left_out();
  if (drive.samples.empty()) {
    return absl::InvalidArgumentError(path + ": the vehicle never moves");
  }
  return drive;
}

absl::StatusOr<Drive> ReadDriveFile(const std::string& path,
                                    const ReaderOptions& options) {
  const auto reader = OpenSamples(path, options);
  if (!reader.ok()) return reader.status();
  return ReadDrive(reader->get(), path);
}

}  // namespace revisit::client
