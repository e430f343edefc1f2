#include "client/cli/commands/reader_flags.h"

namespace revisit::client {
namespace {

template <typename Enum>
int Word(Enum value) {
  return static_cast<int>(value);
}

}  // namespace

void AddReaderFlags(const Command& command, ReaderOptions* options) {
  const Words formats = {
      {"drive", Word(Format::kDrive)},   {"tum", Word(Format::kTum)},
      {"kitti", Word(Format::kKitti)},   {"g2o", Word(Format::kG2o)},
      {"rtklib", Word(Format::kRtklib)}, {"gpx", Word(Format::kGpx)},
      {"nmea", Word(Format::kNmea)},     {"ros", Word(Format::kRos)}};
  const Words frames = {{"local", Word(Frame::kLocal)},
                        {"geodetic", Word(Frame::kGeodetic)}};
  const Words axes = {{"flu", Word(Axes::kForwardLeftUp)},
                      {"camera", Word(Axes::kCamera)},
                      {"ned", Word(Axes::kNorthEastDown)},
                      {"enu", Word(Axes::kEastNorthUp)}};
  const Words angles = {{"radians", Word(Angles::kRadians)},
                        {"degrees", Word(Angles::kDegrees)},
                        {"compass-radians", Word(Angles::kCompassRadians)},
                        {"compass-degrees", Word(Angles::kCompassDegrees)}};
  const Words orders = {{"xyzw", Word(QuaternionOrder::kXyzw)},
                        {"wxyz", Word(QuaternionOrder::kWxyz)}};
  const Words units = {{"s", Word(TimeUnit::kSeconds)},
                       {"ms", Word(TimeUnit::kMilliseconds)},
                       {"us", Word(TimeUnit::kMicroseconds)},
                       {"ns", Word(TimeUnit::kNanoseconds)}};
  Conventions* const conventions = &options->conventions;
  const Command group = command.Under("How files are read");
  group.AddChoice("--format", formats, &options->format,
                  "Found out by the first line where this is not given");
  group.AddText("--columns", "t=NAME,x=NAME,...", &options->columns,
                "The columns of a file whose first line names them: t, x, y, "
                "z, yaw or qx, qy, qz, qw, or lat, lon, height; pxx, pxy, pxt, "
                "pyy, pyt, ptt, or cov for NAME0 to NAME35 as in ROS; fxx to "
                "ftt (error transition); ve, vn");
  group.AddText("--times", "FILE", &options->times_file,
                "A time for each pose of a file without times (kitti, g2o)");
  group.AddNumber(
      "--rate", "HZ", [options](double hz) { options->rate_hz = hz; },
      "Poses per second of a file without times");
  group.AddChoice("--time-unit", units, &options->time_unit,
                  "Unit of the times; found out by their size since 1970 where "
                  "this is not given");
  group.AddChoice("--axes", axes, &conventions->axes,
                  "Axes of positions, orientations and covariances: x forward, "
                  "y left, z up (flu, enu), x right, y down, z forward "
                  "(camera), x north, y east, z down (ned)");
  group.AddChoice("--angles", angles, &conventions->angles,
                  "How yaw and its covariances are counted: counter-clockwise "
                  "from x, or clockwise from y, north (compass)");
  group.AddChoice("--quaternion", orders, &conventions->quaternion,
                  "Order of quaternions (xyzw)");
  group.AddChoice("--frame", frames, &options->frame,
                  "Latitude and longitude become metres east and north of the "
                  "first position (local); x and y are longitude and latitude "
                  "in degrees (geodetic)");
  group.AddSwitch(
      "--accept-suspicious", &options->accept_suspicious,
      "Take a file although axes, units, order or times look wrong");
}

}  // namespace revisit::client
