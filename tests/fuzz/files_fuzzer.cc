// Readers of recordings: read, or refused with the place and the reason.
#include <cmath>
#include <string>

#include "client/formats/reader.h"
#include "client/formats/truth_file.h"
#include "tests/fuzz/fuzzing.h"

namespace {

using revisit::fuzz::Require;
namespace client = revisit::client;

void RequireGoodRefusal(const absl::Status& status) {
  // Damaged compressed files lose data.
  Require(status.ok() || absl::IsInvalidArgument(status) ||
              absl::IsDataLoss(status),
          "a bad file is INVALID_ARGUMENT or DATA_LOSS");
  Require(status.ok() || !status.message().empty(), "a refusal has words");
}

void RequireGoodSample(const client::Sample& sample) {
  Require(sample.has_heading, "a sample has a heading");
  Require(std::isfinite(sample.estimate.x) && std::isfinite(sample.estimate.y),
          "a position is finite");
  if (sample.geodetic.has_value()) {
    Require(std::abs(sample.geodetic->latitude_degrees) <= 90.0 &&
                std::abs(sample.geodetic->longitude_degrees) <= 180.0,
            "a geodetic position lies on the earth");
  }
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data,
                                      std::size_t size) {
  // By content, each of the others, and the truth of a drive.
  const int formats = 1 + static_cast<int>(client::Formats().size());
  revisit::fuzz::Input input(data, size);
  const int format = input.Choice(formats + 1);
  // Which conventions to convert from, and whether to look for suspicion.
  const int how = input.Choice(64);
  if (format == formats) {
    RequireGoodRefusal(client::ReadReference(client::BytesOf(input.Rest()),
                                             "name.csv", std::nullopt)
                           .status());
    return 0;
  }
  client::ReaderOptions options;
  options.format = static_cast<client::Format>(format);
  options.conventions.axes = static_cast<client::Axes>(how % 4);
  options.conventions.angles = static_cast<client::Angles>(how / 4 % 4);
  options.accept_suspicious = how >= 32;
  if (how >= 48) options.rate_hz = 10.0;
  if (how % 16 == 15) options.frame = client::Frame::kGeodetic;
  auto reader = client::ReadSamples(client::BytesOf(input.Rest()),
                                    "dir/name.txt", options);
  RequireGoodRefusal(reader.status());
  if (!reader.ok()) return 0;
  for (;;) {
    const auto sample = (*reader)->Next();
    RequireGoodRefusal(sample.status());
    if (!sample.ok() || !sample->has_value()) return 0;
    RequireGoodSample(**sample);
  }
}
