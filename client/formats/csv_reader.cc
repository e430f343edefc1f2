#include "client/formats/csv_reader.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <map>
#include <string>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "client/formats/plain_readers.h"

namespace revisit::client {
namespace {

// What a column holds. Members of a group follow each other.
enum Key : std::size_t {
  kTime,
  // Instead of kTime: whole seconds and nanoseconds, each in its column.
  kSeconds,
  kNanoseconds,
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
  kCovariance = kTruth + 3,
  kTransition = kCovariance + 6,
  kCovariance36 = kTransition + 9,
  kKeys = kCovariance36 + 36,
};

struct Name {
  Key key;
  // As `--columns` calls it, and as a drive file does.
  const char* word;
  const char* of_drive;
};

constexpr Name kNames[] = {
    {kTime, "t", "t_s"},
    {kX, "x", "est_x"},
    {kY, "y", "est_y"},
    {kZ, "z", "est_z"},
    {kYaw, "yaw", "est_yaw"},
    {kQuaternion, "qx", "est_qx"},
    {Key(kQuaternion + 1), "qy", "est_qy"},
    {Key(kQuaternion + 2), "qz", "est_qz"},
    {Key(kQuaternion + 3), "qw", "est_qw"},
    {kLatitude, "lat", "lat"},
    {kLongitude, "lon", "lon"},
    {kHeight, "height", "height"},
    {kVelocity, "ve", "ve"},
    {Key(kVelocity + 1), "vn", "vn"},
    {kTruth, "gt_x", "gt_x"},
    {Key(kTruth + 1), "gt_y", "gt_y"},
    {Key(kTruth + 2), "gt_yaw", "gt_yaw"},
    {kCovariance, "pxx", "pxx"},
    {Key(kCovariance + 1), "pxy", "pxy"},
    {Key(kCovariance + 2), "pxt", "pxt"},
    {Key(kCovariance + 3), "pyy", "pyy"},
    {Key(kCovariance + 4), "pyt", "pyt"},
    {Key(kCovariance + 5), "ptt", "ptt"},
    {kTransition, "fxx", "fxx"},
    {Key(kTransition + 1), "fxy", "fxy"},
    {Key(kTransition + 2), "fxt", "fxt"},
    {Key(kTransition + 3), "fyx", "fyx"},
    {Key(kTransition + 4), "fyy", "fyy"},
    {Key(kTransition + 5), "fyt", "fyt"},
    {Key(kTransition + 6), "ftx", "ftx"},
    {Key(kTransition + 7), "fty", "fty"},
    {Key(kTransition + 8), "ftt", "ftt"},
};

// Where the values stand in a line.
struct Layout {
  static constexpr std::size_t kAbsent = static_cast<std::size_t>(-1);

  Layout() { index.fill(kAbsent); }
  bool Has(std::size_t key) const { return index[key] != kAbsent; }
  void Put(std::size_t first_key, std::size_t first_index, std::size_t count) {
    for (std::size_t i = 0; i < count; ++i) {
      index[first_key + i] = first_index + i;
      name[first_key + i] =
          absl::StrCat("value ", first_index + i + 1, " of the line");
    }
  }

  char separator = ',';
  std::size_t fields = 0;
  TimeUnit time_unit = TimeUnit::kByMagnitude;
  std::array<std::size_t, kKeys> index;
  // For messages.
  std::array<std::string, kKeys> name;
};

std::string_view WithoutQuotes(std::string_view field) {
  field = WithoutBlanks(field);
  if (field.size() >= 2 && field.front() == '"' && field.back() == '"') {
    field = WithoutBlanks(field.substr(1, field.size() - 2));
  }
  return field;
}

char SeparatorOf(std::string_view line) {
  char best = ',';
  for (const char separator : {';', '\t'}) {
    if (std::count(line.begin(), line.end(), separator) >
        std::count(line.begin(), line.end(), best)) {
      best = separator;
    }
  }
  return best;
}

std::vector<std::string_view> FieldsOf(char separator, std::string_view line) {
  auto fields = SplitAt(separator, line);
  for (std::string_view& field : fields) field = WithoutQuotes(field);
  return fields;
}

using Header = std::map<std::string, std::size_t, std::less<>>;

constexpr char kColumnsHint[] =
    "; --columns t=NAME,x=NAME,y=NAME,yaw=NAME names the columns of any file";

std::string NamesOf(const std::vector<std::string_view>& names) {
  std::string all;
  for (const std::string_view name : names) {
    absl::StrAppend(&all, all.empty() ? "" : ", ", Quoted(name));
    if (all.size() > 200) return all + ", ...";
  }
  return all;
}

// Reads "t=time,x=east".
absl::StatusOr<std::map<std::string, std::string>> ReadColumns(
    const std::string& columns) {
  std::map<std::string, std::string> names;
  if (columns.empty()) return names;
  for (const std::string_view part : SplitAt(',', columns)) {
    const std::size_t equals = part.find('=');
    const std::string word(WithoutBlanks(part.substr(0, equals)));
    const bool known =
        word == "cov" ||
        std::any_of(std::begin(kNames), std::end(kNames),
                    [&](const Name& name) { return word == name.word; });
    if (equals == std::string_view::npos || !known) {
      return absl::InvalidArgumentError(
          absl::StrCat("--columns: expected WORD=NAME with a word such as t, "
                       "x, y, z, yaw, qx, qy, qz, qw, lat, lon, height, pxx or "
                       "cov, got ",
                       Quoted(part)));
    }
    if (!names.emplace(word, WithoutBlanks(part.substr(equals + 1))).second) {
      return absl::InvalidArgumentError(
          absl::StrCat("--columns: ", word, " stands twice"));
    }
  }
  return names;
}

absl::Status FindColumns(const Header& header,
                         const std::map<std::string, std::string>& names,
                         const std::vector<std::string_view>& columns,
                         const Lines& lines, Layout* layout) {
  const auto find = [&](std::size_t key, const std::string& name) {
    const auto found = header.find(name);
    if (found == header.end()) return false;
    layout->index[key] = found->second;
    layout->name[key] = name;
    return true;
  };
  const auto missing = [&](const std::string& name) {
    return lines.Error(absl::StrCat("expected a column ", name,
                                    " as --columns says, got ",
                                    NamesOf(columns)));
  };
  for (const Name& one : kNames) {
    const auto given = names.find(one.word);
    const bool found =
        find(one.key, given == names.end() ? one.of_drive : given->second);
    if (!found && given != names.end()) return missing(given->second);
  }
  if (const auto prefix = names.find("cov"); prefix != names.end()) {
    for (std::size_t i = 0; i < 36; ++i) {
      const std::string name = absl::StrCat(prefix->second, i);
      if (!find(kCovariance36 + i, name)) return missing(name);
    }
  }
  return absl::OkStatus();
}

// An error if only a part of a group of columns is there.
absl::Status CheckGroup(const Layout& layout, std::size_t first,
                        std::size_t count, const Lines& lines) {
  std::size_t found = 0;
  const char* absent = "";
  for (const Name& name : kNames) {
    if (name.key < first || name.key >= first + count) continue;
    if (layout.Has(name.key)) {
      ++found;
    } else {
      absent = name.of_drive;
    }
  }
  if (found == 0 || found == count) return absl::OkStatus();
  return lines.Error(absl::StrCat("expected a column ", absent,
                                  ", since others of its group are there"));
}

absl::Status CheckLayout(const Layout& layout, const ReaderOptions& options,
                         const std::vector<std::string_view>& columns,
                         const Lines& lines) {
  const auto missing = [&](const char* what) {
    return lines.Error(absl::StrCat("expected a column ", what, ", got ",
                                    NamesOf(columns), kColumnsHint));
  };
  const bool geodetic = layout.Has(kLatitude) || layout.Has(kLongitude);
  const std::size_t first = geodetic ? kLatitude : kX;
  for (const std::size_t key : {first, first + 1}) {
    for (const Name& name : kNames) {
      if (name.key == key && !layout.Has(key)) return missing(name.of_drive);
    }
  }
  for (const auto& [group, count] :
       {std::pair<std::size_t, std::size_t>{kQuaternion, 4},
        {kVelocity, 2},
        {kTruth, 3},
        {kCovariance, 6},
        {kTransition, 9}}) {
    if (absl::Status status = CheckGroup(layout, group, count, lines);
        !status.ok()) {
      return status;
    }
  }
  // A column that is missing may be misspelt; --columns says what is meant.
  if (!options.columns.empty()) return absl::OkStatus();
  if (!layout.Has(kTime) && options.times_file.empty() &&
      !options.rate_hz.has_value()) {
    return missing("t_s");
  }
  if (!layout.Has(kYaw) && !layout.Has(kQuaternion) && !geodetic) {
    return missing("est_yaw");
  }
  return absl::OkStatus();
}

class CsvReader : public SampleReader {
 public:
  CsvReader(std::unique_ptr<Lines> lines, Layout layout)
      : lines_(std::move(lines)), layout_(std::move(layout)) {}

  absl::StatusOr<std::optional<Sample>> Next() override {
    std::string_view line;
    do {
      if (!lines_->Next(&line)) return EndOf(*lines_);
    } while (WithoutBlanks(line).empty());
    fields_ = FieldsOf(layout_.separator, line);
    if (fields_.size() != layout_.fields) {
      return lines_->Error(absl::StrCat("expected ", layout_.fields,
                                        " fields as before, got ",
                                        fields_.size()));
    }
    error_ = absl::OkStatus();
    Sample sample = Read();
    if (!error_.ok()) return error_;
    if (absl::Status status = CheckPose(sample, *lines_); !status.ok()) {
      return status;
    }
    return sample;
  }

 private:
  double Number(std::size_t key) {
    const auto value =
        ReadNumber(fields_[layout_.index[key]], layout_.name[key], *lines_);
    if (value.ok()) return *value;
    error_.Update(value.status());
    return 0.0;
  }

  double NumberOrZero(std::size_t key) {
    return layout_.Has(key) ? Number(key) : 0.0;
  }

  template <std::size_t N>
  std::optional<std::array<double, N>> Group(std::size_t first) {
    if (!layout_.Has(first)) return std::nullopt;
    std::array<double, N> values;
    for (std::size_t i = 0; i < N; ++i) values[i] = Number(first + i);
    return values;
  }

  std::optional<std::int64_t> Time(std::size_t key) {
    const auto time =
        ReadTime(fields_[layout_.index[key]], layout_.time_unit, *lines_);
    if (time.ok()) return *time;
    error_.Update(time.status());
    return std::nullopt;
  }

  std::optional<std::int64_t> StampOf() {
    if (layout_.Has(kSeconds)) {
      const double seconds = Number(kSeconds);
      const double nanoseconds = Number(kNanoseconds);
      if (std::abs(seconds) > 9.2e9 || seconds != std::floor(seconds) ||
          nanoseconds < 0.0 || nanoseconds >= 1e9) {
        error_.Update(
            lines_->Error("expected a stamp of whole seconds and nanoseconds"));
        return std::nullopt;
      }
      return static_cast<std::int64_t>(seconds) * kNanosecondsPerSecond +
             static_cast<std::int64_t>(nanoseconds);
    }
    if (!layout_.Has(kTime)) return std::nullopt;
    const auto time = Time(kTime);
    if (time == 0 && layout_.Has(kTimeOfArrival)) return Time(kTimeOfArrival);
    return time;
  }

  Sample Read() {
    Sample sample;
    sample.line = lines_->number();
    sample.time_nanoseconds = StampOf();
    if (layout_.Has(kLatitude)) {
      sample.geodetic = {Number(kLatitude), Number(kLongitude),
                         NumberOrZero(kHeight)};
    } else {
      sample.estimate = {Number(kX), Number(kY), 0.0};
      sample.z = NumberOrZero(kZ);
    }
    sample.quaternion = Group<4>(kQuaternion);
    if (!sample.quaternion.has_value()) {
      sample.has_heading = layout_.Has(kYaw);
      sample.estimate.heading = NumberOrZero(kYaw);
    }
    if (const auto velocity = Group<2>(kVelocity)) {
      sample.velocity = {(*velocity)[0], (*velocity)[1], std::nullopt};
    }
    if (const auto truth = Group<3>(kTruth)) {
      sample.truth = {(*truth)[0], (*truth)[1], (*truth)[2]};
    }
    sample.covariance = Group<6>(kCovariance);
    sample.covariance_36 = Group<36>(kCovariance36);
    if (sample.covariance_36.has_value()) {
      sample.covariance = PlanarPart(*sample.covariance_36);
    }
    sample.error_transition = Group<9>(kTransition);
    return sample;
  }

  const std::unique_ptr<Lines> lines_;
  const Layout layout_;
  std::vector<std::string_view> fields_;
  absl::Status error_;
};

// Values of nav_msgs/Odometry with its twist, and of
// geometry_msgs/PoseWithCovarianceStamped, in the order of their definitions.
constexpr std::size_t kOdometryValues = 89;
constexpr std::size_t kPoseWithCovarianceValues = 46;

Layout LayoutOfRos2(std::size_t values) {
  Layout layout;
  layout.fields = values;
  layout.Put(kSeconds, 0, 1);
  layout.Put(kNanoseconds, 1, 1);
  // Odometry names a second frame.
  const std::size_t pose = values == kOdometryValues ? 4 : 3;
  layout.Put(kX, pose, 3);
  layout.Put(kQuaternion, pose + 3, 4);
  layout.Put(kCovariance36, pose + 7, 36);
  return layout;
}

absl::StatusOr<Layout> LayoutOfRostopic(
    const std::vector<std::string_view>& columns, const Lines& lines) {
  Layout layout;
  layout.fields = columns.size();
  layout.time_unit = TimeUnit::kNanoseconds;
  std::vector<std::pair<std::size_t, std::string>> wanted = {
      {kTimeOfArrival, "%time"}, {kTime, "field.header.stamp"}};
  const std::string pose = "field.pose.pose.";
  for (const auto& [key, name] :
       {std::pair<std::size_t, const char*>{kX, "position.x"},
        {kY, "position.y"},
        {kZ, "position.z"},
        {kQuaternion, "orientation.x"},
        {kQuaternion + 1, "orientation.y"},
        {kQuaternion + 2, "orientation.z"},
        {kQuaternion + 3, "orientation.w"}}) {
    wanted.emplace_back(key, pose + name);
  }
  for (std::size_t i = 0; i < 36; ++i) {
    wanted.emplace_back(kCovariance36 + i,
                        absl::StrCat("field.pose.covariance", i));
  }
  for (const auto& [key, name] : wanted) {
    const auto found = std::find(columns.begin(), columns.end(), name);
    if (found == columns.end()) {
      return lines.Error(absl::StrCat("expected a column ", name,
                                      " of nav_msgs/Odometry, got ",
                                      NamesOf(columns)));
    }
    layout.index[key] = static_cast<std::size_t>(found - columns.begin());
    layout.name[key] = name;
  }
  return layout;
}

}  // namespace

bool IsDriveHeader(std::string_view line) {
  const auto names = FieldsOf(SeparatorOf(line), line);
  const auto has = [&](std::string_view name) {
    return std::find(names.begin(), names.end(), name) != names.end();
  };
  return has("est_x") || has("est_y") || has("t_s");
}

bool IsRosCsv(std::string_view line) {
  if (line.substr(0, 6) == "%time,") return true;
  const auto fields = SplitAt(',', line);
  return fields.size() == kOdometryValues ||
         fields.size() == kPoseWithCovarianceValues;
}

absl::StatusOr<std::unique_ptr<SampleReader>> ReadCsv(
    std::unique_ptr<Lines> lines, const ReaderOptions& options) {
  const auto names = ReadColumns(options.columns);
  if (!names.ok()) return names.status();
  std::string_view line;
  if (!lines->Next(&line)) {
    if (!lines->status().ok()) return lines->status();
    return lines->Error("expected a header line");
  }
  Layout layout;
  layout.separator = SeparatorOf(line);
  layout.time_unit = options.time_unit;
  const auto columns = FieldsOf(layout.separator, line);
  layout.fields = columns.size();
  Header header;
  for (std::size_t i = 0; i < columns.size(); ++i) {
    if (!columns[i].empty() && !header.emplace(columns[i], i).second) {
      return lines->Error(
          absl::StrCat("column ", Quoted(columns[i]), " stands twice"));
    }
  }
  if (absl::Status status =
          FindColumns(header, *names, columns, *lines, &layout);
      !status.ok()) {
    return status;
  }
  if (absl::Status status = CheckLayout(layout, options, columns, *lines);
      !status.ok()) {
    return status;
  }
  return std::unique_ptr<SampleReader>(
      std::make_unique<CsvReader>(std::move(lines), std::move(layout)));
}

absl::StatusOr<std::unique_ptr<SampleReader>> ReadRosCsv(
    std::unique_ptr<Lines> lines, const ReaderOptions&) {
  const std::string first(lines->PeekFirstLine());
  if (!lines->status().ok()) return lines->status();
  const auto fields = FieldsOf(',', first);
  if (fields.size() == kOdometryValues ||
      fields.size() == kPoseWithCovarianceValues) {
    if (!fields[0].empty() && fields[0][0] != '%') {
      return std::unique_ptr<SampleReader>(std::make_unique<CsvReader>(
          std::move(lines), LayoutOfRos2(fields.size())));
    }
  }
  std::string_view line;
  if (!lines->Next(&line)) return lines->Error("expected a header line");
  if (fields[0] != "%time") {
    return lines->Error(absl::StrCat(
        "expected 89 values of nav_msgs/Odometry or 46 of "
        "geometry_msgs/PoseWithCovarianceStamped (ros2 topic echo --csv), or a "
        "header line \"%time,field.header.seq,...\" (rostopic echo -p), got ",
        fields.size(), " values"));
  }
  auto layout = LayoutOfRostopic(FieldsOf(',', line), *lines);
  if (!layout.ok()) return layout.status();
  return std::unique_ptr<SampleReader>(
      std::make_unique<CsvReader>(std::move(lines), *std::move(layout)));
}

}  // namespace revisit::client
