#include "client/cli/evaluation/cases.h"

#include <cstddef>
#include <istream>
#include <string>
#include <utility>

#include "absl/strings/str_cat.h"
#include "client/cli/console.h"
#include "client/cli/evaluation/simulation.h"
#include "client/formats/gnss_file.h"
#include "client/formats/text_lines.h"

namespace revisit::client {
namespace {

// Opens a file for `read`; errors are faults of this machine.
template <typename Read>
auto ReadFile(const std::string& path, const Read& read)
    -> decltype(read(std::declval<std::istream&>(), path)) {
  const auto input = OpenText(path);
  if (!input.ok()) return LocalError(input.status());
  auto value = read(**input, path);
  if (!value.ok()) return LocalError(value.status());
  return value;
}

absl::StatusOr<std::vector<Drive>> ReadGnssDrives(
    const EvaluateOptions& options) {
  std::vector<Drive> drives;
  std::optional<GeodeticPosition> origin;
  for (std::size_t i = 0; i < options.files.size(); ++i) {
    const auto fixes = ReadFile(options.files[i], ReadRtklib);
    if (!fixes.ok()) return fixes.status();
    const auto reference = ReadFile(options.truth_files[i], ReadReference);
    if (!reference.ok()) return reference.status();
    if (!origin.has_value() || !options.one_vehicle) {
      origin = fixes->front().position;
    }
    auto drive =
        MakeGnssDrive(StemOf(options.files[i]), *fixes, *reference, *origin);
    if (!drive.ok()) return LocalError(drive.status());
    drives.push_back(*std::move(drive));
  }
  return drives;
}

absl::StatusOr<std::vector<Drive>> ReadDriveFiles(
    const EvaluateOptions& options) {
  std::vector<Drive> drives;
  for (const std::string& file : options.files) {
    auto drive = ReadDriveFile(file, DriveFormat::kDrive);
    if (!drive.ok()) return LocalError(drive.status());
    if (drive->truth.empty()) {
      return LocalError(absl::InvalidArgumentError(
          absl::StrCat(file,
                       ":1: expected the columns gt_x, gt_y, gt_yaw, which an "
                       "evaluation needs")));
    }
    drives.push_back(*std::move(drive));
  }
  return drives;
}

// One drive after the other, as one.
Drive Join(std::vector<Drive> drives) {
  Drive all = std::move(drives[0]);
  for (std::size_t i = 1; i < drives.size(); ++i) {
    absl::StrAppend(&all.name, "+", drives[i].name);
    all.samples.insert(all.samples.end(), drives[i].samples.begin(),
                       drives[i].samples.end());
    all.truth.insert(all.truth.end(), drives[i].truth.begin(),
                     drives[i].truth.end());
  }
  return all;
}

}  // namespace

absl::StatusOr<std::vector<Case>> ReadCases(const EvaluateOptions& options) {
  auto read = options.format == EvaluateOptions::Format::kRtklib
                  ? ReadGnssDrives(options)
                  : ReadDriveFiles(options);
  if (!read.ok()) return read.status();
  std::vector<Drive> drives = *std::move(read);
  if (options.one_vehicle) drives = {Join(std::move(drives))};
  std::vector<Case> cases;
  for (Drive& drive : drives) {
    if (options.seeds.empty()) {
      cases.push_back({std::move(drive), std::nullopt, {}});
      continue;
    }
    for (const std::uint64_t seed : options.seeds) {
      cases.push_back(
          {SimulateDeadReckoning(drive, options.uncertainty, seed), seed, {}});
    }
  }
  for (Case& one : cases) {
    auto uncertainty = ClaimUncertainty(one.drive, options.uncertainty);
    if (!uncertainty.ok()) return LocalError(uncertainty.status());
    one.uncertainty = *std::move(uncertainty);
  }
  return cases;
}

}  // namespace revisit::client
