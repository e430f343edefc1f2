#include "client/trajectory/trajectory_text.h"

#include "client/answers/exact_text.h"
#include "client/formats/plain_readers.h"
#include "client/terminal/terminal.h"

namespace revisit::client {

void WriteTumLine(const LocalPose& pose, std::ostream& out) {
  if (pose.recording_start) {
    out << kRecordingMark << ToJson(*pose.recording_start, false) << '\n';
  }
  out << StampSeconds(*pose.stamp);
  for (const double value : pose.position) out << ' ' << Exact(value);
  for (const double value : pose.orientation) out << ' ' << Exact(value);
  out << '\n';
}

void WriteKittiLine(const LocalPose& pose, std::ostream& out) {
  const auto& [x, y, z, w] = pose.orientation;
  const auto& [px, py, pz] = pose.position;
  const double rows[12] = {
      1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w),
      2.0 * (x * z + y * w),       px,
      2.0 * (x * y + z * w),       1.0 - 2.0 * (x * x + z * z),
      2.0 * (y * z - x * w),       py,
      2.0 * (x * z - y * w),       2.0 * (y * z + x * w),
      1.0 - 2.0 * (x * x + y * y), pz};
  for (int i = 0; i < 12; ++i) {
    out << (i == 0 ? "" : " ") << Exact(rows[i]);
  }
  out << '\n';
}

void WriteCsvHeader(std::ostream& out) {
  out << "sequence,t_s,est_x,est_y,est_z,est_yaw,qx,qy,qz,qw,"
         "pxx,pxy,pxz,pxt,pyy,pyz,pyt,pzz,pzt,ptt\n";
}

void WriteCsvLine(const LocalPose& pose, bool spatial, std::ostream& out) {
  constexpr int kZ = 2;
  out << pose.sequence << ',' << (pose.stamp ? StampSeconds(*pose.stamp) : "");
  for (const double value : pose.position) out << ',' << Exact(value);
  out << ',' << Exact(pose.heading);
  for (const double value : pose.orientation) out << ',' << Exact(value);
  for (int row = 0; row < 4; ++row) {
    for (int column = row; column < 4; ++column) {
      out << ',';
      if (!spatial && (row == kZ || column == kZ)) continue;
      out << Exact(pose.covariance[static_cast<std::size_t>(4 * row + column)]);
    }
  }
  out << '\n';
}

}  // namespace revisit::client
