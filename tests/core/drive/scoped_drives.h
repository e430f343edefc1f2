// Drives of several vehicles for the tests of what joins them.
#ifndef REVISIT_TESTS_CORE_DRIVE_SCOPED_DRIVES_H_
#define REVISIT_TESTS_CORE_DRIVE_SCOPED_DRIVES_H_

#include <cstddef>
#include <memory>
#include <string>
#include <vector>

#include "core/drive/drive.h"
#include "core/drive/drive_view.h"
#include "core/drive/joined_drives.h"
#include "core/geometry/frame_transform.h"
#include "core/geometry/pose.h"
#include "core/geometry/recording_start.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/dead_reckoning.h"

namespace revisit::core {

inline std::shared_ptr<RecordingStart> DatumAt(const Pose& pose, double meters,
                                               double radians,
                                               const std::string& id = "") {
  auto start = std::make_shared<RecordingStart>();
  start->relation = RecordingRelation::kDatum;
  start->datum = pose;
  start->datum_id = id;
  for (int i : {0, 1, 2}) start->covariance(i, i) = meters * meters;
  start->covariance(3, 3) = radians * radians;
  return start;
}

// The poses, which are in a frame that all share, as a recording that was
// placed there by the start's datum has them: reckoned from its first pose.
// Sequence numbers go on behind `last_sequence`.
inline std::vector<PoseSample> RecordingOf(
    const std::vector<Pose>& poses,
    const std::shared_ptr<const RecordingStart>& start,
    std::uint64_t last_sequence) {
  std::vector<PoseSample> samples;
  StateMatrix<4> covariance = StateMatrix<4>::Identity() * 0.01;
  for (const Pose& shared : poses) {
    PoseSample sample;
    sample.sequence = ++last_sequence;
    sample.pose = start ? Compose(Inverse(start->datum), shared) : shared;
    if (samples.empty()) {
      sample.recording_start = start;
    } else {
      const StateMatrix<4> psi =
          DeadReckoningTransition<4>(samples.back().pose, sample.pose);
      covariance = (psi * covariance * psi.transpose()).eval();
      covariance.diagonal() += StateVector<4>(1e-3, 1e-3, 1e-3, 1e-7);
    }
    sample.covariance = ToCovariance<4>(covariance);
    samples.push_back(sample);
  }
  return samples;
}

inline std::shared_ptr<const JoinedDrives> Join(
    const std::vector<const Drive*>& drives,
    std::vector<FrameLink> links = {}) {
  std::vector<JoinedDrive> joined;
  for (const Drive* drive : drives) joined.push_back({drive->View(1.0)});
  return std::make_shared<const JoinedDrives>(std::move(joined),
                                              std::move(links));
}

}  // namespace revisit::core

#endif  // REVISIT_TESTS_CORE_DRIVE_SCOPED_DRIVES_H_
