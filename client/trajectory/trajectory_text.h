// Poses as lines of text files that other programs read.
//
// Numbers read back to the same bits.
#ifndef REVISIT_CLIENT_TRAJECTORY_TRAJECTORY_TEXT_H_
#define REVISIT_CLIENT_TRAJECTORY_TRAJECTORY_TEXT_H_

#include <ostream>

#include "client/trajectory/local_pose.h"

namespace revisit::client {

// "t x y z qx qy qz qw", as in the TUM RGB-D benchmark. Before the first pose
// of a recording is a comment that says so, as plain_readers.h reads it.
// REQUIRES: a stamp.
void WriteTumLine(const LocalPose& pose, std::ostream& out);

// The upper three rows of the matrix that takes points of the body to the local
// frame, row by row, as in the KITTI odometry benchmark, but with the body's
// axes forward, left, up.
void WriteKittiLine(const LocalPose& pose, std::ostream& out);

// sequence,t_s,est_x,est_y,est_z,est_yaw,qx,qy,qz,qw and the upper triangle by
// rows of the covariance of (x, y, z, yaw): pxx,pxy,pxz,pxt,pyy,pyz,pyt,pzz,
// pzt,ptt. t_s is empty without a stamp, and so are the columns of z's
// covariance where the state has no z.
void WriteCsvHeader(std::ostream& out);
void WriteCsvLine(const LocalPose& pose, bool spatial, std::ostream& out);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_TRAJECTORY_TRAJECTORY_TEXT_H_
