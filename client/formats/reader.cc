#include "client/formats/reader.h"

#include <algorithm>
#include <cmath>
#include <string_view>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "client/formats/course.h"
#include "client/formats/csv_reader.h"
#include "client/formats/g2o_reader.h"
#include "client/formats/gnss_readers.h"
#include "client/formats/plain_readers.h"
#include "client/formats/plausibility.h"
#include "client/formats/restart_watch.h"
#include "client/formats/text_lines.h"

namespace revisit::client {
namespace {

bool IsNumber(std::string_view text) {
  return !text.empty() &&
         text.find_first_not_of("0123456789+-.eE") == text.npos;
}

bool BeginsWith(std::string_view text, std::string_view start) {
  return text.substr(0, start.size()) == start;
}

// The format that the first line can only be of; kByContent if that is not
// certain.
Format Recognize(std::string_view line) {
  if (IsRosCsv(line)) return Format::kRos;
  if (line[0] == '%') return Format::kRtklib;
  if (line[0] == '<') return Format::kGpx;
  if (line[0] == '$') return Format::kNmea;
  for (const char* start : {"VERTEX", "EDGE", "PARAMS_", "FIX "}) {
    if (BeginsWith(line, start)) return Format::kG2o;
  }
  if (IsDriveHeader(line)) return Format::kDrive;
  const auto fields = SplitAtBlanks(line);
  if (std::all_of(fields.begin(), fields.end(), IsNumber)) {
    if (fields.size() == 8) return Format::kTum;
    if (fields.size() == 12) return Format::kKitti;
  }
  return Format::kByContent;
}

absl::StatusOr<Format> FormatOf(Lines* lines, const ReaderOptions& options) {
  if (options.format != Format::kByContent) return options.format;
  if (!options.columns.empty()) return Format::kDrive;
  const std::string_view line = lines->PeekFirstLine();
  if (!lines->status().ok()) return lines->status();
  if (line.empty()) {
    return absl::InvalidArgumentError(absl::StrCat(
        lines->path(), ":1: expected at least one pose, got none"));
  }
  const Format format = Recognize(line);
  if (format != Format::kByContent) return format;
  return absl::InvalidArgumentError(absl::StrCat(
      lines->path(), ":1: the format is none that is known by its beginning ",
      Quoted(line),
      "; --columns t=NAME,x=NAME,y=NAME,yaw=NAME reads a file whose first line "
      "names columns, t=1,x=2,y=3,yaw=4 one without names, --format says what "
      "else it is"));
}

// Times from a file of their own, or at a rate.
class TimedReader : public SampleReader {
 public:
  TimedReader(std::unique_ptr<SampleReader> reader,
              std::unique_ptr<Lines> times, const ReaderOptions& options)
      : reader_(std::move(reader)),
        times_(std::move(times)),
        unit_(options.time_unit),
        rate_hz_(options.rate_hz.value_or(1.0)) {}

  absl::StatusOr<std::optional<Sample>> Next() override {
    auto sample = reader_->Next();
    if (!sample.ok() || !sample->has_value()) return sample;
    if (times_ == nullptr) {
      (*sample)->time_nanoseconds =
          std::llround(static_cast<double>(count_++) / rate_hz_ * 1e9);
      return sample;
    }
    std::string_view line;
    if (!times_->Next(&line)) {
      if (!times_->status().ok()) return times_->status();
      return times_->Error(absl::StrCat("expected a time for each pose, got ",
                                        count_, " times"));
    }
    ++count_;
    const auto time = ReadTime(WithoutBlanks(line), unit_, *times_);
    if (!time.ok()) return time.status();
    (*sample)->time_nanoseconds = *time;
    return sample;
  }

  LeftOut left_out() const override { return reader_->left_out(); }

 private:
  const std::unique_ptr<SampleReader> reader_;
  // Null for a rate.
  const std::unique_ptr<Lines> times_;
  const TimeUnit unit_;
  const double rate_hz_;
  std::int64_t count_ = 0;
};

// Positions in metres of the frame, looked at and then converted.
class PreparedReader : public SampleReader {
 public:
  PreparedReader(std::unique_ptr<SampleReader> reader, const std::string& path,
                 const ReaderOptions& options)
      : reader_(std::move(reader)),
        path_(path),
        frame_(options.frame),
        conventions_(options.conventions),
        origin_(options.origin) {
    if (!options.accept_suspicious) {
      plausibility_.emplace(options.conventions, path);
    }
  }

  absl::StatusOr<std::optional<Sample>> Next() override {
    auto sample = reader_->Next();
    if (!sample.ok()) return sample;
    if (!sample->has_value()) {
      if (!any_) {
        const std::int64_t wrong = reader_->left_out().wrong_checksums;
        return absl::InvalidArgumentError(absl::StrCat(
            path_, ": expected at least one pose, got none",
            wrong > 0 ? absl::StrCat(" and ", wrong,
                                     " sentences with a wrong checksum")
                      : ""));
      }
      if (plausibility_.has_value()) {
        if (absl::Status status = plausibility_->Finish(); !status.ok()) {
          return status;
        }
      }
      return sample;
    }
    any_ = true;
    if (absl::Status status = ToFrame(&**sample); !status.ok()) return status;
    if (plausibility_.has_value()) {
      if (absl::Status status = plausibility_->Observe(**sample);
          !status.ok()) {
        return status;
      }
    }
    auto converted = Convert(**sample, conventions_);
    if (!converted.ok()) return Error(**sample, converted.status());
    if (frame_ == Frame::kLocal) converted->geodetic.reset();
    return std::optional<Sample>(*std::move(converted));
  }

  LeftOut left_out() const override { return reader_->left_out(); }

 private:
  absl::Status Error(const Sample& sample, const absl::Status& status) const {
    return absl::Status(status.code(), absl::StrCat(path_, ":", sample.line,
                                                    ": ", status.message()));
  }

  absl::Status ToFrame(Sample* sample) {
    if (frame_ == Frame::kGeodetic && !sample->geodetic.has_value()) {
      const auto& [longitude, latitude, heading] = sample->estimate;
      if (!(std::abs(longitude) <= 180.0 && std::abs(latitude) <= 90.0)) {
        return Error(*sample,
                     absl::InvalidArgumentError(absl::StrCat(
                         "--frame geodetic takes x as longitude and y as "
                         "latitude: expected degrees within 180 and 90, got ",
                         longitude, " and ", latitude)));
      }
      sample->geodetic = {latitude, longitude, sample->z};
    }
    if (!sample->geodetic.has_value()) return absl::OkStatus();
    if (!origin_.has_value()) origin_ = sample->geodetic;
    const auto local = EastNorthUp(*origin_, *sample->geodetic);
    sample->estimate.x = local[0];
    sample->estimate.y = local[1];
    sample->z = local[2];
    return absl::OkStatus();
  }

  const std::unique_ptr<SampleReader> reader_;
  const std::string path_;
  const Frame frame_;
  const Conventions conventions_;
  std::optional<GeodeticPosition> origin_;
  std::optional<Plausibility> plausibility_;
  bool any_ = false;
};

absl::Status CheckOptions(Format format, const ReaderOptions& options) {
  if (options.rate_hz.has_value() && !options.times_file.empty()) {
    return absl::InvalidArgumentError("--rate and --times exclude each other");
  }
  if (options.rate_hz.has_value() &&
      !(*options.rate_hz >= 1e-3 && *options.rate_hz <= 1e6)) {
    return absl::InvalidArgumentError(
        absl::StrCat("--rate: expected poses per second in [0.001, 1e6], got ",
                     *options.rate_hz));
  }
  if (!options.columns.empty() && format != Format::kDrive) {
    return absl::InvalidArgumentError(
        "--columns goes with --format drive only");
  }
  return absl::OkStatus();
}

// All that depends on the format, but for its first line: Recognize().
struct FormatRow {
  NamedFormat named;
  absl::StatusOr<std::unique_ptr<SampleReader>> (*read)(
      std::unique_ptr<Lines> lines, const ReaderOptions& options);
};

constexpr FormatRow kRows[] = {
    {{"drive", Format::kDrive}, ReadCsv},
    {{"tum", Format::kTum}, ReadTum},
    {{"kitti", Format::kKitti}, ReadKitti},
    {{"g2o", Format::kG2o}, ReadG2o},
    {{"rtklib", Format::kRtklib}, ReadRtklib},
    {{"gpx", Format::kGpx}, ReadGpx},
    {{"nmea", Format::kNmea}, ReadNmea},
    {{"ros", Format::kRos}, ReadRosCsv},
};

absl::StatusOr<std::unique_ptr<SampleReader>> ReadFormat(
    Format format, std::unique_ptr<Lines> lines, const ReaderOptions& options) {
  for (const FormatRow& row : kRows) {
    if (row.named.format == format) return row.read(std::move(lines), options);
  }
  return absl::InternalError("no such format");
}

}  // namespace

const std::vector<NamedFormat>& Formats() {
  static const auto* const formats = [] {
    auto* const named = new std::vector<NamedFormat>;
    for (const FormatRow& row : kRows) named->push_back(row.named);
    return named;
  }();
  return *formats;
}

absl::StatusOr<std::unique_ptr<SampleReader>> ReadSamples(
    std::unique_ptr<ByteSource> source, const std::string& path,
    const ReaderOptions& options) {
  auto lines = std::make_unique<Lines>(std::move(source), path);
  const auto format = FormatOf(lines.get(), options);
  if (!format.ok()) return format.status();
  if (absl::Status status = CheckOptions(*format, options); !status.ok()) {
    return status;
  }
  auto reader = ReadFormat(*format, std::move(lines), options);
  if (!reader.ok()) return reader;
  if (options.rate_hz.has_value() || !options.times_file.empty()) {
    std::unique_ptr<Lines> times;
    if (!options.times_file.empty()) {
      auto bytes = OpenBytes(options.times_file, nullptr);
      if (!bytes.ok()) return bytes.status();
      times = std::make_unique<Lines>(*std::move(bytes), options.times_file);
    }
    reader = std::make_unique<TimedReader>(*std::move(reader), std::move(times),
                                           options);
  }
  reader = std::make_unique<PreparedReader>(*std::move(reader), path, options);
  if (*format == Format::kRos) reader = MarkRestarts(*std::move(reader));
  if (!options.keep_without_heading) reader = AddCourse(*std::move(reader));
  return reader;
}

absl::StatusOr<std::unique_ptr<SampleReader>> OpenSamples(
    const std::string& path, const ReaderOptions& options) {
  auto source = OpenBytes(path, options.before_wait);
  if (!source.ok()) return source.status();
  return ReadSamples(*std::move(source), path, options);
}

}  // namespace revisit::client
