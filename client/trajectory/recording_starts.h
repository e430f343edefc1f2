// Where recordings of a vehicle begin, and what is known of their frames.
#ifndef REVISIT_CLIENT_TRAJECTORY_RECORDING_STARTS_H_
#define REVISIT_CLIENT_TRAJECTORY_RECORDING_STARTS_H_

#include <cstdint>
#include <optional>
#include <string>

#include "absl/status/statusor.h"
#include "client/formats/sample.h"
#include "client/trajectory/dead_reckoning.h"
#include "revisit/v1/geometry.pb.h"
#include "revisit/v1/vehicle.pb.h"

namespace revisit::client {

// A value of --recording: how the recordings that begin lie to others.
struct RecordingChoice {
  enum class Kind {
    // Nobody has said it: a file that does not go on where the one before it
    // ended begins a recording after that one.
    kByPoses,
    // Files go on in one frame.
    kSame,
    // Each file but the first begins where the one before it ended.
    kAfter,
    // Each file is placed in a frame that all of them share.
    kDatum,
    // Nothing is known of the frame of each file but the first.
    kUnknown,
  };
  // Standard deviations, of each coordinate in metres and of the heading in
  // radians.
  struct Size {
    double meters = 0.0;
    double radians = 0.0;
  };

  // Whether it tells of frames by itself, which only local positions have.
  bool tells_of_frames() const {
    return kind != Kind::kByPoses && kind != Kind::kSame;
  }

  Kind kind = Kind::kByPoses;
  // How uncertain the start is. kDatum always has it; kAfter has it where it
  // was given, and otherwise means what the service does (RecordingStart).
  std::optional<Size> size;
  // Datum.datum_id.
  std::string datum_id;
};

// The words of --recording, for its help and for messages.
inline constexpr char kRecordingWords[] =
    "after[:METERSm,DEGREESdeg] | datum:METERSm,DEGREESdeg[,ID] | unknown | "
    "same";

// Reads such a word. Says what is allowed in its place, or nothing if it was
// read.
std::string ReadRecordingChoice(const std::string& text,
                                RecordingChoice* choice);

// The words of such a size by itself.
inline constexpr char kSizeWords[] = "METERSm,DEGREESdeg";

// Reads it. Says what is allowed in its place, or nothing if it was read.
std::string ReadSize(const std::string& text, RecordingChoice::Size* size);

// A covariance of positions and heading that err independently, for a vehicle
// of this state space.
v1::Covariance CovarianceOf(const RecordingChoice::Size& size,
                            v1::StateSpace state_space);

// The start that such a recording brings. REQUIRES: kAfter, kDatum or kUnknown.
v1::RecordingStart MakeRecordingStart(const RecordingChoice& choice,
                                      const std::string& label,
                                      v1::StateSpace state_space);

// "datum within 10 m and 1.0 degrees, map-3".
std::string DatumText(const v1::Datum& datum);

// "after", "after, within 10 m and 17.2 degrees", DatumText(), "unknown".
std::string RelationText(const v1::RecordingStart& start);

// Why --recording is refused where it tells of frames.
inline constexpr char kGeodeticFrame[] =
    "geodetic positions, which are in one frame whatever was recorded when: "
    "--recording goes with local ones";

// Whether poses tell where a recording begins: errors are carried on along the
// drive, and where those of starts are given, they are in the frame of the
// recordings before.
bool PosesTellOfFrames(v1::CorrelationModel model,
                       const UncertaintyOptions& uncertainty);

// Finds the recordings among samples that come one after the other, from one
// file or many. The result depends on samples alone, so that a stream that is
// resumed sends the same poses again. Not thread-safe.
class RecordingStarts {
 public:
  // A pose as far as it matters to whether the next one goes on from it.
  struct Place {
    PlanarPose pose;
    std::optional<std::int64_t> time_nanoseconds;
  };

  // `looks_at_poses`: PosesTellOfFrames(); kByPoses is else kSame.
  RecordingStarts(const RecordingChoice& choice, v1::StateSpace state_space,
                  bool looks_at_poses);

  // The samples that follow come from this file.
  void BeginFile(const std::string& path);

  // The first file is behind poses that were stored before, of which these are
  // the last two or the last one: it is not the first one of the vehicle.
  void ContinueFrom(std::optional<Place> before_last, const Place& last);

  struct Begun {
    v1::RecordingStart start;
    // Whether the poses have shown it, which nobody has said.
    bool by_poses = false;
    // A note about the start for the user, without a full stop; empty where
    // there is nothing to tell.
    std::string note;
  };

  // The recording that begins with the next sample; nothing where it goes on.
  // INVALID_ARGUMENT if a file states a start that is none.
  absl::StatusOr<std::optional<Begun>> Next(const Sample& sample);

  // How many have begun.
  int count() const { return count_; }

 private:
  absl::StatusOr<std::optional<Begun>> StatedBy(const Sample& sample) const;
  std::optional<Begun> BegunBy(const Sample& sample) const;
  // Why the sample does not go on where the last one was; empty if it does.
  std::string WhyNotOn(const Sample& sample) const;
  std::string LabelOfFile() const;

  const RecordingChoice choice_;
  const v1::StateSpace state_space_;
  const bool looks_at_poses_;
  std::string path_;
  // Whether the next sample is the first of its file.
  bool is_first_of_file_ = false;
  // The last sample, and the length of the step to it.
  std::optional<Place> last_;
  double last_step_meters_ = 0.0;
  int count_ = 0;
};

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_TRAJECTORY_RECORDING_STARTS_H_
