#include "client/cli/commands/reader_flags.h"

#include <string>
#include <utility>

#include "absl/strings/str_cat.h"
#include "client/formats/angles.h"

namespace revisit::client {
namespace {

template <typename Enum>
int Word(Enum value) {
  return static_cast<int>(value);
}

class ReaderFlags {
 public:
  // Flags are called `--`, the prefix and their word.
  ReaderFlags(const Command& group, std::string prefix, ReaderOptions* options)
      : group_(group), prefix_(std::move(prefix)), options_(options) {}

  void Add() const {
    AddFormat();
    AddTimes();
    AddAxes();
    AddFrame();
    AddAngles();
    group_.AddSwitch(
        Name("accept-suspicious"), &options_->accept_suspicious,
        Help("accept-suspicious",
             "Take a file although axes, units, order or times look wrong"));
  }

 private:
  std::string Name(const char* word) const {
    return absl::StrCat("--", prefix_, word);
  }

  std::string Help(const char* word, const char* help) const {
    return prefix_.empty() ? help : absl::StrCat("--", word, " of the truth");
  }

  void AddFormat() const {
    Words formats;
    for (const NamedFormat& known : Formats()) {
      formats[known.name] = Word(known.format);
    }
    group_.AddChoice(
        Name("format"), formats, &options_->format,
        Help("format", "Found out by the first line where this is not given"));
    group_.AddText(
        Name("columns"), "t=NAME,x=NAME,...", &options_->columns,
        Help("columns",
             "The columns of a file, by the names in its first line or counted "
             "from 1: t, or week and tow (GPS); x, y, z, yaw or qx, qy, qz, "
             "qw, or lat, lon, height; ve, vn; pxx, pxy, pxt, pyy, pyt, ptt, "
             "or sdx, sdy, sdz, sdyaw, or cov for NAME0 to NAME35 as in ROS; "
             "fxx to ftt (error transition)"));
  }

  void AddTimes() const {
    const Words units = {{"s", Word(TimeUnit::kSeconds)},
                         {"ms", Word(TimeUnit::kMilliseconds)},
                         {"us", Word(TimeUnit::kMicroseconds)},
                         {"ns", Word(TimeUnit::kNanoseconds)}};
    group_.AddText(
        Name("times"), "FILE", &options_->times_file,
        Help("times",
             "A time for each pose of a file without times (kitti, g2o)"));
    group_.AddNumber(
        Name("rate"), "HZ",
        [options = options_](double hz) { options->rate_hz = hz; },
        Help("rate", "Poses per second of a file without times"));
    group_.AddChoice(Name("time-unit"), units, &options_->time_unit,
                     Help("time-unit",
                          "Unit of the times; found out by their size since "
                          "1970 where this is not given"));
  }

  void AddAxes() const {
    const Words axes = {{"flu", Word(Axes::kForwardLeftUp)},
                        {"camera", Word(Axes::kCamera)},
                        {"ned", Word(Axes::kNorthEastDown)},
                        {"enu", Word(Axes::kEastNorthUp)}};
    Conventions* const conventions = &options_->conventions;
    group_.AddChoice(
        Name("axes"), axes, &conventions->axes,
        Help("axes",
             "Axes of positions, orientations and covariances: x forward, "
             "y left, z up (flu, enu), x right, y down, z forward "
             "(camera), x north, y east, z down (ned)"));
    group_.AddText(
        Name("body-axes"), "XYZ",
        [conventions](const std::string& text) -> std::string {
          conventions->body = ReadBodyAxes(text);
          return conventions->body.has_value()
                     ? ""
                     : "camera, or three of f, b, l, r, u, d that are "
                       "right-handed axes, such as flu, frd or rfu";
        },
        Help("body-axes",
             "Which way the body's x, y and z point in the vehicle, where "
             "--axes says it of the frame only: a letter each for forward, "
             "back, left, right, up, down, such as frd or rfu; camera is rdf"));
    group_.AddNumber(
        Name("body-yaw"), "DEG",
        [conventions](double degrees) {
          conventions->body_yaw = degrees * kRadiansPerDegree;
        },
        Help("body-yaw",
             "How far the body (a sensor) is turned to the left of the "
             "vehicle"));
  }

  void AddFrame() const {
    const Words frames = {{"local", Word(Frame::kLocal)},
                          {"geodetic", Word(Frame::kGeodetic)}};
    group_.AddChoice(
        Name("frame"), frames, &options_->frame,
        Help("frame",
             "Latitude and longitude become metres east and north of the "
             "first position (local); x and y are longitude and latitude "
             "in degrees (geodetic)"));
  }

  void AddAngles() const {
    const Words angles = {{"radians", Word(Angles::kRadians)},
                          {"degrees", Word(Angles::kDegrees)},
                          {"compass-radians", Word(Angles::kCompassRadians)},
                          {"compass-degrees", Word(Angles::kCompassDegrees)}};
    const Words orders = {{"xyzw", Word(QuaternionOrder::kXyzw)},
                          {"wxyz", Word(QuaternionOrder::kWxyz)}};
    Conventions* const conventions = &options_->conventions;
    group_.AddChoice(
        Name("angles"), angles, &conventions->angles,
        Help("angles",
             "How yaw and its covariances are counted: counter-clockwise "
             "from x, or clockwise from y, north (compass)"));
    group_.AddChoice(Name("quaternion"), orders, &conventions->quaternion,
                     Help("quaternion", "Order of quaternions (xyzw)"));
  }

  const Command group_;
  const std::string prefix_;
  ReaderOptions* const options_;
};

}  // namespace

void AddReaderFlags(const Command& command, ReaderOptions* options) {
  ReaderFlags(command.Under("How files are read"), "", options).Add();
}

void AddRecording(const Command& command, RecordingChoice* choice) {
  command.AddText(
      "--recording", "RELATION",
      [choice](const std::string& text) {
        return ReadRecordingChoice(text, choice);
      },
      "Each FILE but the first, and with --append the first too, begins a "
      "recording in a frame of its own: after[:METERSm,DEGREESdeg] (it begins "
      "where the one before it ended, within so much; 10m,17.2deg), "
      "datum:METERSm,DEGREESdeg[,ID] (it was placed in a frame that all of "
      "them share, also the first), unknown, or same (they are in one frame)");
}

void AddTruthReaderFlags(const Command& command, ReaderOptions* options) {
  ReaderFlags(command.Under("How files of --truth are read"), "truth-", options)
      .Add();
}

}  // namespace revisit::client
