// Readers of recorded drives: read, or refused with the place and the reason.
#include <sstream>
#include <string>

#include "client/formats/drive_file.h"
#include "client/formats/gnss_file.h"
#include "tests/fuzz/fuzzing.h"

namespace {

using revisit::fuzz::Require;

void RequireGoodRefusal(const absl::Status& status) {
  Require(status.ok() || absl::IsInvalidArgument(status),
          "a bad file is INVALID_ARGUMENT");
  Require(status.ok() || !status.message().empty(), "a refusal has words");
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data,
                                      std::size_t size) {
  namespace client = revisit::client;
  revisit::fuzz::Input input(data, size);
  const int format = input.Choice(4);
  const std::string text = input.Rest();
  std::istringstream stream(text);
  if (format < 2) {
    const auto drive = client::ReadDrive(
        stream, "dir/name.csv",
        format == 0 ? client::DriveFormat::kDrive : client::DriveFormat::kTum);
    RequireGoodRefusal(drive.status());
    if (drive.ok()) {
      Require(
          drive->truth.empty() || drive->truth.size() == drive->samples.size(),
          "a truth for each sample or none");
    }
    return 0;
  }
  if (format == 2) {
    const auto fixes = client::ReadRtklib(stream, "name.pos");
    RequireGoodRefusal(fixes.status());
    if (!fixes.ok() || fixes->empty()) return 0;
    std::vector<client::ReferencePose> reference;
    for (const client::GnssFix& fix : *fixes) {
      reference.push_back({fix.time_seconds, fix.position, 0.1});
    }
    RequireGoodRefusal(client::MakeGnssDrive("name", *fixes, reference,
                                             fixes->front().position)
                           .status());
    return 0;
  }
  RequireGoodRefusal(client::ReadReference(stream, "name.csv").status());
  return 0;
}
