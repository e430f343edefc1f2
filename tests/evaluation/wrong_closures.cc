// How well suspects among confirmed loop closures tell wrong ones
// (core/drive/suspects.h).
//
//   wrong_closures [DRIVE...]
//
// On each drive, or on twelve simulated ones where none is given, every pass of
// a place that was driven before is confirmed, one time in five at a wrong
// place: anywhere, or off by 30 to 100 m. Prints the share of the wrong ones
// that are suspects, and of the right ones that are, where a verifier measures
// nothing and where it measures to 0.2 m and 0.01 rad.
#include <iostream>
#include <random>
#include <vector>

#include "absl/strings/str_format.h"
#include "client/formats/drive_file.h"
#include "core/drive/drive.h"
#include "core/drive/suspects.h"
#include "core/geometry/pose.h"
#include "core/settings.h"
#include "tests/core/drive/closed_drives.h"
#include "tests/evaluation/claimed_samples.h"

namespace {

using namespace revisit::core;  // NOLINT: a program of one file.

struct Path {
  std::vector<Pose> truth;
  std::vector<PoseSample> samples;
};

Path PathOf(const revisit::client::Drive& drive) {
  Path path;
  path.samples = revisit::evaluation::SamplesOf(drive);
  for (const revisit::client::PlanarPose& pose : drive.truth) {
    path.truth.push_back({pose.x, pose.y, 0.0, pose.heading});
  }
  return path;
}

}  // namespace

int main(int argc, char** argv) {
  std::vector<Path> paths;
  for (int i = 1; i < argc; ++i) {
    const auto drive = revisit::client::ReadDriveFile(argv[i], {});
    if (!drive.ok() || drive->truth.empty()) {
      std::cerr << argv[i] << ": "
                << (drive.ok() ? "it has no truth" : drive.status().message())
                << "\n";
      return 1;
    }
    paths.push_back(PathOf(*drive));
  }
  std::cout
      << "| verifier | wrong ones | wrong | suspected | right | suspected "
         "|\n|---|---|---|---|---|---|\n";
  for (const bool measured : {false, true}) {
    for (const WrongLoops wrong : {WrongLoops::kAnywhere, WrongLoops::kNear}) {
      std::mt19937_64 random(20101015);
      SuspectScore score;
      for (const Path& path : paths) {
        ClosedDrive closed{DriveSettings()};
        closed.truth = path.truth;
        closed.samples = path.samples;
        closed.drive.Append(closed.samples, 1);
        CloseLoops(wrong, measured, random, &closed);
        score.Add(closed, FindSuspects(closed.drive));
      }
      for (int trial = 0; paths.empty() && trial < 12; ++trial) {
        const ClosedDrive closed =
            RandomClosedDrive(DriveSettings(), 4000, wrong, measured, random);
        score.Add(closed, FindSuspects(closed.drive));
      }
      std::cout << absl::StrFormat(
          "| %s | %s | %d | %.3f | %d | %.4f |\n",
          measured ? "0.2 m, 0.01 rad" : "measures nothing",
          wrong == WrongLoops::kNear ? "off by 30 to 100 m" : "anywhere",
          score.wrong, score.recall(), score.right, score.right_share());
    }
  }
  return 0;
}
