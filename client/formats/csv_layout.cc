#include "client/formats/csv_layout.h"

#include <algorithm>
#include <map>
#include <utility>

#include "absl/strings/str_cat.h"

namespace revisit::client {
namespace {

struct Name {
  CsvKey key;
  // The name that `--columns` gives it, and that of a drive file.
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
    {CsvKey(kQuaternion + 1), "qy", "est_qy"},
    {CsvKey(kQuaternion + 2), "qz", "est_qz"},
    {CsvKey(kQuaternion + 3), "qw", "est_qw"},
    {kLatitude, "lat", "lat"},
    {kLongitude, "lon", "lon"},
    {kHeight, "height", "height"},
    {kVelocity, "ve", "ve"},
    {CsvKey(kVelocity + 1), "vn", "vn"},
    {kTruth, "gt_x", "gt_x"},
    {CsvKey(kTruth + 1), "gt_y", "gt_y"},
    {CsvKey(kTruth + 2), "gt_yaw", "gt_yaw"},
    {kTruthZ, "gt_z", "gt_z"},
    {kCovariance, "pxx", "pxx"},
    {CsvKey(kCovariance + 1), "pxy", "pxy"},
    {CsvKey(kCovariance + 2), "pxt", "pxt"},
    {CsvKey(kCovariance + 3), "pyy", "pyy"},
    {CsvKey(kCovariance + 4), "pyt", "pyt"},
    {CsvKey(kCovariance + 5), "ptt", "ptt"},
    {kTransition, "fxx", "fxx"},
    {CsvKey(kTransition + 1), "fxy", "fxy"},
    {CsvKey(kTransition + 2), "fxt", "fxt"},
    {CsvKey(kTransition + 3), "fyx", "fyx"},
    {CsvKey(kTransition + 4), "fyy", "fyy"},
    {CsvKey(kTransition + 5), "fyt", "fyt"},
    {CsvKey(kTransition + 6), "ftx", "ftx"},
    {CsvKey(kTransition + 7), "fty", "fty"},
    {CsvKey(kTransition + 8), "ftt", "ftt"},
};

std::string_view WithoutQuotes(std::string_view field) {
  field = WithoutBlanks(field);
  if (field.size() >= 2 && field.front() == '"' && field.back() == '"') {
    field = WithoutBlanks(field.substr(1, field.size() - 2));
  }
  return field;
}

// The index of a name that several columns have: an error only if it is read.
constexpr std::size_t kTwice = CsvLayout::kAbsent - 1;

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
                         const Lines& lines, CsvLayout* layout) {
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
absl::Status CheckGroup(const CsvLayout& layout, std::size_t first,
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

absl::Status CheckLayout(const CsvLayout& layout, const ReaderOptions& options,
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

}  // namespace

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

absl::StatusOr<CsvLayout> LayoutOfHeader(std::string_view line,
                                         const ReaderOptions& options,
                                         const Lines& lines) {
  const auto names = ReadColumns(options.columns);
  if (!names.ok()) return names.status();
  CsvLayout layout;
  layout.separator = SeparatorOf(line);
  layout.time_unit = options.time_unit;
  const auto columns = FieldsOf(layout.separator, line);
  layout.fields = columns.size();
  Header header;
  for (std::size_t i = 0; i < columns.size(); ++i) {
    const auto [found, added] = header.emplace(columns[i], i);
    if (!added) found->second = kTwice;
  }
  if (absl::Status status =
          FindColumns(header, *names, columns, lines, &layout);
      !status.ok()) {
    return status;
  }
  for (std::size_t key = 0; key < kKeys; ++key) {
    if (layout.index[key] == kTwice) {
      return lines.Error(
          absl::StrCat("column ", Quoted(layout.name[key]), " stands twice"));
    }
  }
  if (absl::Status status = CheckLayout(layout, options, columns, lines);
      !status.ok()) {
    return status;
  }
  return layout;
}

CsvLayout LayoutOfRos2(std::size_t values) {
  CsvLayout layout;
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

absl::StatusOr<CsvLayout> LayoutOfRostopic(
    const std::vector<std::string_view>& columns, const Lines& lines) {
  CsvLayout layout;
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

}  // namespace revisit::client
