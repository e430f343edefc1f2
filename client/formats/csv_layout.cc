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
    {kWeek, "week", "week"},
    {kTimeOfWeek, "tow", "tow"},
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
    {kDeviation, "sdx", "sdx"},
    {CsvKey(kDeviation + 1), "sdy", "sdy"},
    {CsvKey(kDeviation + 2), "sdz", "sdz"},
    {CsvKey(kDeviation + 3), "sdyaw", "sdyaw"},
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
    "; --columns t=NAME,x=NAME,y=NAME,yaw=NAME names the columns of any file, "
    "or counts them from 1: t=1,x=2";

bool IsCount(std::string_view text) {
  return !text.empty() && text.size() <= 4 && text[0] != '0' &&
         text.find_first_not_of("0123456789") == text.npos;
}

// The name of a column in a header of this kind.
const char* NameIn(bool drive, const Name& name) {
  return drive ? name.of_drive : name.word;
}

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
                       "x, y, z, yaw, qx, qy, qz, qw, lat, lon, height, pxx, "
                       "sdx or cov, got ",
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
  const bool drive = !names.empty() || NamesADrive(columns);
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
    const bool found = find(
        one.key, given == names.end() ? NameIn(drive, one) : given->second);
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

// An error if only a part of these columns is there.
absl::Status CheckGroup(const CsvLayout& layout, bool drive,
                        std::initializer_list<std::size_t> keys,
                        const Lines& lines) {
  std::size_t found = 0;
  const char* absent = "";
  for (const std::size_t key : keys) {
    if (layout.Has(key)) {
      ++found;
      continue;
    }
    for (const Name& name : kNames) {
      if (name.key == key) absent = NameIn(drive, name);
    }
  }
  if (found == 0 || found == keys.size()) return absl::OkStatus();
  return lines.Error(absl::StrCat("expected a column ", absent,
                                  ", since others of its group are there"));
}

// Groups that are there as a whole or not at all. A covariance may be diagonal,
// and that of a position has no yaw.
absl::Status CheckGroups(const CsvLayout& layout, bool drive,
                         const Lines& lines) {
  const bool heading = layout.Has(kYaw) || layout.Has(kQuaternion);
  constexpr std::size_t q = kQuaternion;
  constexpr std::size_t f = kTransition;
  constexpr std::size_t sd = kDeviation;
  constexpr std::size_t xx = kCovariance;
  constexpr std::size_t xy = xx + 1;
  constexpr std::size_t xt = xx + 2;
  constexpr std::size_t yy = xx + 3;
  constexpr std::size_t yt = xx + 4;
  constexpr std::size_t tt = xx + 5;
  absl::Status status;
  const auto check = [&](std::initializer_list<std::size_t> keys) {
    status.Update(CheckGroup(layout, drive, keys, lines));
  };
  check({kWeek, kTimeOfWeek});
  check({q, q + 1, q + 2, q + 3});
  check({kVelocity, kVelocity + 1});
  check({kTruth, kTruth + 1, kTruth + 2});
  check({f, f + 1, f + 2, f + 3, f + 4, f + 5, f + 6, f + 7, f + 8});
  if (heading || layout.Has(tt)) {
    check({xx, yy, tt});
    check({xy, xt, yt});
    check({sd, sd + 1, sd + 3});
  } else {
    check({xx, yy});
    check({sd, sd + 1});
  }
  if (layout.Has(xy)) check({xx, xy, yy});
  return status;
}

absl::Status CheckLayout(const CsvLayout& layout, const ReaderOptions& options,
                         const std::vector<std::string_view>& columns,
                         const Lines& lines) {
  const bool drive = !options.columns.empty() || NamesADrive(columns);
  const auto missing = [&](std::size_t key) {
    const auto name =
        std::find_if(std::begin(kNames), std::end(kNames),
                     [key](const Name& one) { return one.key == key; });
    return lines.Error(absl::StrCat("expected a column ", NameIn(drive, *name),
                                    ", got ", NamesOf(columns), kColumnsHint));
  };
  const bool geodetic = layout.Has(kLatitude) || layout.Has(kLongitude);
  const std::size_t first = geodetic ? kLatitude : kX;
  for (const std::size_t key : {first, first + 1}) {
    if (!layout.Has(key)) return missing(key);
  }
  if (absl::Status status = CheckGroups(layout, drive, lines); !status.ok()) {
    return status;
  }
  // A column that is missing may be misspelt; --columns says what is meant.
  if (!options.columns.empty()) return absl::OkStatus();
  if (!layout.Has(kTime) && !layout.Has(kWeek) && options.times_file.empty() &&
      !options.rate_hz.has_value()) {
    return missing(kTime);
  }
  if (!layout.Has(kYaw) && !layout.Has(kQuaternion) && !geodetic) {
    return missing(kYaw);
  }
  return absl::OkStatus();
}

}  // namespace

char SeparatorOf(std::string_view line) {
  char best = ' ';
  std::ptrdiff_t most = 0;
  for (const char separator : {',', ';', '\t'}) {
    const auto count = std::count(line.begin(), line.end(), separator);
    if (count > most) best = separator;
    most = std::max(most, count);
  }
  return best;
}

bool NamesADrive(const std::vector<std::string_view>& names) {
  return std::any_of(names.begin(), names.end(), [](std::string_view name) {
    return name == "est_x" || name == "est_y" || name == "t_s";
  });
}

bool CountsColumns(const std::string& columns) {
  const auto names = ReadColumns(columns);
  return names.ok() && !names->empty() &&
         std::all_of(names->begin(), names->end(),
                     [](const auto& name) { return IsCount(name.second); });
}

std::vector<std::string_view> FieldsOf(char separator, std::string_view line) {
  auto fields =
      separator == ' ' ? SplitAtBlanks(line) : SplitAt(separator, line);
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

absl::StatusOr<CsvLayout> LayoutOfCounts(std::string_view line,
                                         const ReaderOptions& options,
                                         const Lines& lines) {
  const auto names = ReadColumns(options.columns);
  if (!names.ok()) return names.status();
  CsvLayout layout;
  layout.separator = SeparatorOf(line);
  // Tabs that align columns stand beside blanks.
  if (layout.separator == '\t') layout.separator = ' ';
  layout.time_unit = options.time_unit;
  layout.fields = FieldsOf(layout.separator, line).size();
  const auto put = [&](std::size_t key, const std::string& count,
                       std::size_t columns) -> absl::Status {
    const auto number = static_cast<std::size_t>(std::stoul(count));
    if (number + columns - 1 > layout.fields) {
      return lines.Error(absl::StrCat(
          "expected a column ", number + columns - 1,
          " as --columns says, got ", layout.fields, " in ", Quoted(line)));
    }
    layout.Put(key, number - 1, columns);
    return absl::OkStatus();
  };
  absl::Status status;
  for (const Name& name : kNames) {
    const auto given = names->find(name.word);
    if (given != names->end()) status.Update(put(name.key, given->second, 1));
  }
  if (const auto first = names->find("cov"); first != names->end()) {
    status.Update(put(kCovariance36, first->second, 36));
  }
  if (!status.ok()) return status;
  status = CheckLayout(layout, options, {}, lines);
  if (!status.ok()) return status;
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
