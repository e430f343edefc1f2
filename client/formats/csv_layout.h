// Which value of a line of csv_reader.h is what.
#ifndef REVISIT_CLIENT_FORMATS_CSV_LAYOUT_H_
#define REVISIT_CLIENT_FORMATS_CSV_LAYOUT_H_

#include <array>
#include <cstddef>
#include <string>
#include <string_view>
#include <vector>

#include "absl/status/statusor.h"
#include "client/formats/reader.h"
#include "client/formats/text_lines.h"
#include "client/formats/times.h"

namespace revisit::client {

// The meaning of a column. Members of a group follow each other.
enum CsvKey : std::size_t {
  kTime,
  // Instead of kTime: whole seconds and nanoseconds, each in its column.
  kSeconds,
  kNanoseconds,
  // The same by the GPS calendar: the week and its seconds.
  kWeek,
  kTimeOfWeek,
  // Counts where kTime is 0.
  kTimeOfArrival,
  kX,
  kY,
  kZ,
  kYaw,
  kQuaternion,
  kLatitude = kQuaternion + 4,
  kLongitude,
  kHeight,
  kVelocity,
  kTruth = kVelocity + 2,
  kTruthZ = kTruth + 3,
  kCovariance,
  // Standard deviations of x, y, z and yaw, in place of the covariance.
  kDeviation = kCovariance + 6,
  kTransition = kDeviation + 4,
  kCovariance36 = kTransition + 9,
  kKeys = kCovariance36 + 36,
};

// Where the values stand in a line.
struct CsvLayout {
  static constexpr std::size_t kAbsent = static_cast<std::size_t>(-1);

  CsvLayout() { index.fill(kAbsent); }
  bool Has(std::size_t key) const { return index[key] != kAbsent; }
  void Put(std::size_t first_key, std::size_t first_index, std::size_t count) {
    for (std::size_t i = 0; i < count; ++i) {
      index[first_key + i] = first_index + i;
      name[first_key + i] =
          absl::StrCat("value ", first_index + i + 1, " of the line");
    }
  }

  // A blank stands for any number of blanks and tabs.
  char separator = ',';
  std::size_t fields = 0;
  TimeUnit time_unit = TimeUnit::kByMagnitude;
  std::array<std::size_t, kKeys> index;
  // For messages.
  std::array<std::string, kKeys> name;
};

// The comma, semicolon or tab that stands most often in a line; a blank if it
// has none of them.
char SeparatorOf(std::string_view line);

// Fields without blanks and quotes around them.
std::vector<std::string_view> FieldsOf(char separator, std::string_view line);

// Whether the names of a header are those of a drive file.
bool NamesADrive(const std::vector<std::string_view>& names);

// The layout of a drive file, or of what `options.columns` names. `line` is the
// header, the last line that was read.
absl::StatusOr<CsvLayout> LayoutOfHeader(std::string_view line,
                                         const ReaderOptions& options,
                                         const Lines& lines);

// Whether `columns` counts columns from 1, as in "t=1,x=2", where files need no
// names.
bool CountsColumns(const std::string& columns);

// The layout of a file whose columns `options.columns` counts. `line` is one of
// its lines, the last that was read.
absl::StatusOr<CsvLayout> LayoutOfCounts(std::string_view line,
                                         const ReaderOptions& options,
                                         const Lines& lines);

// Values of nav_msgs/Odometry with its twist, and of
// geometry_msgs/PoseWithCovarianceStamped, in the order of their definitions.
inline constexpr std::size_t kOdometryValues = 89;
inline constexpr std::size_t kPoseWithCovarianceValues = 46;

// The layout of a line of `ros2 topic echo --csv` with so many values.
CsvLayout LayoutOfRos2(std::size_t values);

// The layout behind the header of `rostopic echo -p`.
absl::StatusOr<CsvLayout> LayoutOfRostopic(
    const std::vector<std::string_view>& columns, const Lines& lines);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_FORMATS_CSV_LAYOUT_H_
