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
#include <array>
#include <cstdint>
#include <iostream>
#include <random>
#include <set>
#include <utility>
#include <vector>

#include "absl/strings/str_format.h"
#include "client/formats/drive_file.h"
#include "client/trajectory/dead_reckoning.h"
#include "core/drive/drive.h"
#include "core/drive/suspects.h"
#include "core/geometry/pose.h"
#include "core/settings.h"
#include "tests/core/drive/closed_drives.h"

namespace {

using namespace revisit::core;  // NOLINT: a program of one file.

struct Path {
  std::vector<Pose> truth;
  std::vector<PoseSample> samples;
};

// With the covariances that `revisit evaluate` claims.
Path PathOf(const revisit::client::Drive& drive) {
  const auto claims = revisit::client::ClaimUncertainty(drive, {});
  Path path;
  for (std::size_t i = 0; i < drive.samples.size(); ++i) {
    const revisit::client::PlanarPose& pose = drive.samples[i].estimate;
    const std::array<double, 6>& claim = (*claims)[i].planar;
    PoseSample sample;
    sample.sequence = i + 1;
    sample.pose = {pose.x, pose.y, 0.0, pose.heading};
    sample.covariance(0, 0) = claim[0];
    sample.covariance(0, 1) = claim[1];
    sample.covariance(0, 3) = claim[2];
    sample.covariance(1, 1) = claim[3];
    sample.covariance(1, 3) = claim[4];
    sample.covariance(3, 3) = claim[5];
    sample.covariance(2, 2) = 1.0;
    path.samples.push_back(sample);
    path.truth.push_back(
        {drive.truth[i].x, drive.truth[i].y, 0.0, drive.truth[i].heading});
  }
  return path;
}

struct Shares {
  int wrong = 0;
  int wrong_suspected = 0;
  int right = 0;
  int right_suspected = 0;

  void Add(const ClosedDrive& closed) {
    std::set<std::pair<std::uint64_t, std::uint64_t>> suspected;
    for (const Suspect& suspect : FindSuspects(closed.drive)) {
      suspected.insert({suspect.query_sequence, suspect.matched_sequence});
    }
    for (const VerifiedLoop& loop : closed.loops) {
      const int is_suspect =
          static_cast<int>(suspected.count({loop.query + 1, loop.matched + 1}));
      (loop.is_wrong ? wrong : right) += 1;
      (loop.is_wrong ? wrong_suspected : right_suspected) += is_suspect;
    }
  }
};

double Share(int part, int all) {
  return all == 0 ? 0.0 : static_cast<double>(part) / all;
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
      Shares shares;
      for (const Path& path : paths) {
        ClosedDrive closed{DriveSettings()};
        closed.truth = path.truth;
        closed.samples = path.samples;
        closed.drive.Append(closed.samples, 1);
        CloseLoops(wrong, measured, random, &closed);
        shares.Add(closed);
      }
      for (int trial = 0; paths.empty() && trial < 12; ++trial) {
        shares.Add(
            RandomClosedDrive(DriveSettings(), 4000, wrong, measured, random));
      }
      std::cout << absl::StrFormat(
          "| %s | %s | %d | %.3f | %d | %.4f |\n",
          measured ? "0.2 m, 0.01 rad" : "measures nothing",
          wrong == WrongLoops::kNear ? "off by 30 to 100 m" : "anywhere",
          shares.wrong, Share(shares.wrong_suspected, shares.wrong),
          shares.right, Share(shares.right_suspected, shares.right));
    }
  }
  return 0;
}
