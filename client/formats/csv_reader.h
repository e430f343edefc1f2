// Values separated by commas, semicolons or tabs.
//
// The columns that are read, by the names that `--columns` gives them and by
// those that a drive file has without it:
//
//   t                 t_s                 time; ReadTime() in times.h
//   x y z             est_x est_y est_z   local position, metres; z may be left
//                                         out
//   yaw               est_yaw             counter-clockwise from +x
//   qx qy qz qw       est_qx est_qy est_qz est_qw   instead of yaw
//   lat lon height    lat lon height      degrees and metres, instead of x, y
//   ve vn             ve vn               velocity to the east and north, m/s
//   gt_x gt_y gt_yaw  the same            the truth
//   gt_z              the same            its height, metres
//   pxx pxy pxt pyy pyt ptt  the same     covariance of (x, y, yaw)
//   cov               -                   36 columns, this name and 0 to 35:
//                                         covariance as in ROS
//   fxx fxy fxt fyx fyy fyt ftx fty ftt  the same
//                                         error transition, by rows
//
// All other columns are passed over. Values and names may stand in quotes.
#ifndef REVISIT_CLIENT_FORMATS_CSV_READER_H_
#define REVISIT_CLIENT_FORMATS_CSV_READER_H_

#include <memory>
#include <string_view>

#include "absl/status/statusor.h"
#include "client/formats/reader.h"
#include "client/formats/text_lines.h"

namespace revisit::client {

absl::StatusOr<std::unique_ptr<SampleReader>> ReadCsv(
    std::unique_ptr<Lines> lines, const ReaderOptions& options);

// nav_msgs/Odometry or geometry_msgs/PoseWithCovarianceStamped: 89 or 46 values
// without a header (`ros2 topic echo --csv`), or with the header of
// `rostopic echo -p`.
absl::StatusOr<std::unique_ptr<SampleReader>> ReadRosCsv(
    std::unique_ptr<Lines> lines, const ReaderOptions& options);

// Whether a first line is the header of a drive file, or a line or header of
// ROS.
bool IsDriveHeader(std::string_view line);
bool IsRosCsv(std::string_view line);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_FORMATS_CSV_READER_H_
