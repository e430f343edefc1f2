// Values separated by commas, semicolons, tabs or blanks.
//
// The columns that are read, by the names that `--columns` gives them, which a
// header may have as well, and by those of a drive file:
//
//   t                 t_s                 time; ReadTime() in times.h
//   week tow          the same            instead: GPS week and its seconds,
//                                         counted as if they were UTC
//   x y z             est_x est_y est_z   local position, metres; z may be left
//                                         out
//   yaw               est_yaw             counter-clockwise from +x
//   qx qy qz qw       est_qx est_qy est_qz est_qw   instead of yaw
//   lat lon height    the same            degrees and metres, instead of x, y
//   ve vn             the same            velocity to the east and north, m/s
//   gt_x gt_y gt_yaw  the same            the truth
//   gt_z              the same            its height, metres
//   pxx pxy pxt pyy pyt ptt  the same     covariance of (x, y, yaw); without
//                                         pxy, pxt and pyt it is diagonal,
//                                         without yaw that of (x, y)
//   sdx sdy sdz sdyaw  the same           instead: standard deviations to the
//                                         east, the north, upwards, of yaw
//   cov               -                   36 columns, this name and 0 to 35, or
//                                         the first one's number: covariance as
//                                         in ROS
//   fxx fxy fxt fyx fyy fyt ftx fty ftt  the same
//                                         error transition, by rows
//
// All other columns are passed over. Values and names may stand in quotes. A
// file without names is read by counts of its columns ("t=1,x=2"); lines that
// begin with '#' or '%' are then comments, and a first line whose values are no
// numbers is passed over.
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
