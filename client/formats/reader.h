// Recordings of vehicles, read sample by sample: memory does not grow with the
// file, and a sample of a pipe is handed on as its line arrives. Only a g2o
// file is held whole, since its edges follow its vertices.
//
// A malformed file is refused with INVALID_ARGUMENT and a message that names
// file and line and says what was expected there; nothing is guessed, and what
// is skipped is counted. NOT_FOUND or PERMISSION_DENIED if it cannot be opened,
// DATA_LOSS if it cannot be read to its end. Numbers are read in the C locale,
// whatever the process has set.
#ifndef REVISIT_CLIENT_FORMATS_READER_H_
#define REVISIT_CLIENT_FORMATS_READER_H_

#include <cstdint>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "client/formats/axes.h"
#include "client/formats/byte_source.h"
#include "client/formats/sample.h"
#include "client/formats/times.h"

namespace revisit::client {

// Counts parts of a file for which no sample stands.
struct LeftOut {
  // Positions without a heading at which the vehicle stood, or moved less than
  // course.h needs for one.
  std::int64_t standing = 0;
  // Sentences whose checksum is wrong.
  std::int64_t wrong_checksums = 0;
};

class SampleReader {
 public:
  virtual ~SampleReader() = default;
  // The next sample; nothing at the end. After an error or the end, further
  // calls have no meaning.
  virtual absl::StatusOr<std::optional<Sample>> Next() = 0;
  // The parts of the file that were left out so far.
  virtual LeftOut left_out() const { return {}; }
};

// A new one has a row in kRows of reader.cc, which names and reads it, and is
// told apart by its first lines in Recognize() there.
enum class Format {
  // Found out by the first lines.
  kByContent,
  // Values separated by commas, semicolons, tabs or blanks; the first line
  // names the columns, in any order, or `columns` counts them. csv_reader.h has
  // their names.
  kDrive,
  // The format of the TUM RGB-D benchmark: lines "t x y z qx qy qz qw",
  // separated by blanks; lines that begin with '#' are comments.
  kTum,
  // The poses of the KITTI odometry benchmark: 12 numbers, the rows of a 3x4
  // matrix that maps the body into the frame of the first pose.
  kKitti,
  // Vertices of a g2o file, VERTEX_SE2 or VERTEX_SE3:QUAT, by their ids; other
  // elements are passed over. The information of the edges between
  // neighbouring vertices becomes covariances, composed from the first vertex.
  // Without vertices, the edges are composed to poses as well.
  kG2o,
  // Solutions of RTKLIB (.pos): latitude and longitude in degrees.
  kRtklib,
  // Track points of a GPX file.
  kGpx,
  // GGA and RMC sentences of a receiver.
  kNmea,
  // nav_msgs/Odometry or geometry_msgs/PoseWithCovarianceStamped, from
  // `ros2 topic echo --csv` or `rostopic echo -p`.
  kRos,
};

// A format and the word by which users ask for it.
struct NamedFormat {
  const char* name;
  Format format;
};

// Every format but kByContent.
const std::vector<NamedFormat>& Formats();

// The kind of positions that samples have in the end.
enum class Frame {
  // Whatever the file holds.
  kOfFile,
  // Geodetic positions become metres to the east and north of the first one.
  kLocal,
  // Local positions are longitude (x) and latitude (y) in degrees.
  kGeodetic,
};

struct ReaderOptions {
  Format format = Format::kByContent;
  // kDrive: which columns to read, such as "t=time,x=east,y=north,yaw=psi", or
  // "t=1,x=2,y=3,yaw=4" for a file without names. Without it, the columns have
  // the names of csv_reader.h.
  std::string columns;
  TimeUnit time_unit = TimeUnit::kByMagnitude;
  // For files without times: a file with one of them for each pose, or poses
  // per second; at most one of the two.
  std::string times_file;
  std::optional<double> rate_hz;
  Conventions conventions;
  Frame frame = Frame::kOfFile;
  // Whether samples without a heading are handed on as they are; otherwise
  // they get the heading of the course (course.h).
  bool keep_without_heading = false;
  // Whether samples are handed on that plausibility.h finds suspicious.
  bool accept_suspicious = false;
  // Where kLocal counts from; the first position of the file if absent.
  std::optional<GeodeticPosition> origin;
  BeforeWait before_wait;
};

// Opens a file, or the standard input for "-", also compressed ones.
// INVALID_ARGUMENT also if options do not go with the format.
absl::StatusOr<std::unique_ptr<SampleReader>> OpenSamples(
    const std::string& path, const ReaderOptions& options);

// Reads `source` likewise; `path` is for messages.
absl::StatusOr<std::unique_ptr<SampleReader>> ReadSamples(
    std::unique_ptr<ByteSource> source, const std::string& path,
    const ReaderOptions& options);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_FORMATS_READER_H_
