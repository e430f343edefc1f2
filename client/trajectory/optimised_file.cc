#include "client/trajectory/optimised_file.h"

#include <charconv>
#include <cmath>
#include <map>
#include <memory>
#include <string_view>
#include <system_error>
#include <utility>

#include "absl/strings/str_cat.h"
#include "client/formats/byte_source.h"
#include "client/formats/text_lines.h"

namespace revisit::client {
namespace {

using Fields = std::vector<std::string_view>;

// Columns of a CSV file that belong together.
constexpr std::array<const char*, 4> kQuaternion = {"qx", "qy", "qz", "qw"};
constexpr std::array<const char*, 6> kPlanar = {"pxx", "pxy", "pxt",
                                                "pyy", "pyt", "ptt"};
constexpr std::array<const char*, 4> kUp = {"pxz", "pyz", "pzz", "pzt"};
constexpr std::array<const char*, 3> kState = {"est_x", "est_y", "est_yaw"};
constexpr std::array<const char*, 1> kHeight = {"est_z"};

// One file while it is read. A status of it that is not OK names the line.
class OptimisedReader {
 public:
  explicit OptimisedReader(Lines* lines) : lines_(*lines) {}

  absl::StatusOr<std::vector<OptimisedPose>> Read(OptimisedFormat format) {
    std::string_view line;
    while (lines_.Next(&line)) {
      if (line.empty() || line[0] == '#') continue;
      pose_ = OptimisedPose();
      pose_.line = lines_.number();
      bool is_pose = true;
      absl::Status status;
      switch (format) {
        case OptimisedFormat::kTum:
          status = ReadTum(SplitAtBlanks(line));
          break;
        case OptimisedFormat::kG2o:
          status = ReadG2o(SplitAtBlanks(line), &is_pose);
          break;
        case OptimisedFormat::kCsv:
          is_pose = !columns_.empty();
          status = is_pose ? ReadCsv(SplitAt(',', line))
                           : ReadCsvHeader(SplitAt(',', line));
          break;
      }
      if (!status.ok()) return status;
      if (is_pose) poses_.push_back(pose_);
    }
    if (!lines_.status().ok()) return lines_.status();
    if (poses_.empty()) return lines_.Error("the file holds no poses");
    return std::move(poses_);
  }

 private:
  absl::Status ReadNumbers(const Fields& fields, std::size_t first,
                           std::vector<double>* numbers) {
    for (std::size_t i = first; i < fields.size(); ++i) {
      const auto number =
          ReadNumber(fields[i], absl::StrCat("field ", i + 1), lines_);
      if (!number.ok()) return number.status();
      numbers->push_back(*number);
    }
    return absl::OkStatus();
  }

  absl::Status ReadSequence(std::string_view field) {
    std::uint64_t sequence = 0;
    const auto [end, error] =
        std::from_chars(field.data(), field.data() + field.size(), sequence);
    if (error != std::errc() || end != field.data() + field.size() ||
        sequence == 0) {
      return lines_.Error(absl::StrCat(
          "expected the sequence of a pose, from 1, got ", Quoted(field)));
    }
    pose_.sequence = sequence;
    return absl::OkStatus();
  }

  // x, y, z, w.
  absl::Status SetQuaternion(const double* q) {
    constexpr double kNormTolerance = 1e-3;
    const double norm =
        std::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    if (std::abs(norm - 1.0) > kNormTolerance) {
      return lines_.Error(
          absl::StrCat("the norm of the quaternion is ", norm, ", expected 1"));
    }
    pose_.quaternion = {q[0], q[1], q[2], q[3]};
    return absl::OkStatus();
  }

  absl::Status ReadTum(const Fields& fields) {
    // Beyond this, nanoseconds do not fit into 64 bits.
    constexpr double kLatest = 9.2e9;
    if (fields.size() != 8) {
      return lines_.Error(absl::StrCat(
          "expected the 8 fields t x y z qx qy qz qw, got ", fields.size()));
    }
    std::vector<double> n;
    if (absl::Status read = ReadNumbers(fields, 0, &n); !read.ok()) return read;
    if (std::abs(n[0]) > kLatest) {
      return lines_.Error(
          absl::StrCat("expected seconds since 1970, got ", n[0]));
    }
    const double whole = std::floor(n[0]);
    pose_.stamp_nanoseconds = static_cast<std::int64_t>(whole) * 1'000'000'000 +
                              std::llround((n[0] - whole) * 1e9);
    pose_.x = n[1];
    pose_.y = n[2];
    pose_.z = n[3];
    return SetQuaternion(&n[4]);
  }

  absl::Status ReadG2o(const Fields& fields, bool* is_pose) {
    const std::string_view tag = fields[0];
    const bool planar = tag == "VERTEX_SE2";
    *is_pose = planar || tag == "VERTEX_SE3:QUAT";
    if (!*is_pose) {
      if (tag == "FIX" || tag.substr(0, 5) == "EDGE_") return absl::OkStatus();
      return lines_.Error(absl::StrCat(
          "expected VERTEX_SE2, VERTEX_SE3:QUAT, an edge or FIX, got ",
          Quoted(tag)));
    }
    const std::size_t expected = planar ? 5 : 9;
    if (fields.size() != expected) {
      return lines_.Error(
          absl::StrCat(planar ? "expected VERTEX_SE2 ID X Y HEADING"
                              : "expected VERTEX_SE3:QUAT ID X Y Z QX QY QZ QW",
                       ", got ", fields.size(), " fields"));
    }
    if (absl::Status read = ReadSequence(fields[1]); !read.ok()) return read;
    std::vector<double> n;
    if (absl::Status read = ReadNumbers(fields, 2, &n); !read.ok()) return read;
    pose_.x = n[0];
    pose_.y = n[1];
    if (planar) {
      pose_.heading = n[2];
      return absl::OkStatus();
    }
    pose_.z = n[2];
    return SetQuaternion(&n[3]);
  }

  bool Has(const char* name) const { return columns_.count(name) > 0; }

  absl::Status ReadCsvHeader(const Fields& names) {
    for (std::size_t i = 0; i < names.size(); ++i) {
      if (!columns_.emplace(names[i], i).second) {
        return lines_.Error(
            absl::StrCat("two columns have the name ", Quoted(names[i])));
      }
    }
    column_count_ = names.size();
    for (const char* needed : {"sequence", "est_x", "est_y", "est_yaw"}) {
      if (!Has(needed)) {
        return lines_.Error(absl::StrCat("there is no column ", needed));
      }
    }
    return CheckGroups(kQuaternion, kPlanar, kUp);
  }

  template <typename... Groups>
  absl::Status CheckGroups(const Groups&... groups) const {
    absl::Status status;
    const auto check = [&](const auto& group) {
      for (const char* name : group) {
        if (Has(name) == Has(group[0]) || !status.ok()) continue;
        status = lines_.Error(
            absl::StrCat("there is no column ", Has(name) ? group[0] : name,
                         ", but one of those that belong to it"));
      }
    };
    (check(groups), ...);
    return status;
  }

  // The numbers of these columns; none if all are missing or empty.
  template <typename Names>
  absl::StatusOr<std::vector<double>> Numbers(const Fields& fields,
                                              const Names& names) const {
    std::vector<double> numbers;
    for (const char* name : names) {
      const auto column = columns_.find(name);
      if (column == columns_.end() || fields[column->second].empty()) continue;
      const auto number = ReadNumber(fields[column->second], name, lines_);
      if (!number.ok()) return number.status();
      numbers.push_back(*number);
    }
    if (!numbers.empty() && numbers.size() != names.size()) {
      return lines_.Error(absl::StrCat("some of the columns ", names.front(),
                                       " to ", names.back(), " are empty"));
    }
    return numbers;
  }

  absl::Status ReadCsv(const Fields& fields) {
    if (fields.size() != column_count_) {
      return lines_.Error(absl::StrCat("expected ", column_count_,
                                       " fields, got ", fields.size()));
    }
    if (absl::Status read = ReadSequence(fields[columns_["sequence"]]);
        !read.ok()) {
      return read;
    }
    const auto state = Numbers(fields, kState);
    if (!state.ok()) return state.status();
    if (state->empty()) return lines_.Error("est_x, est_y, est_yaw are empty");
    pose_.x = (*state)[0];
    pose_.y = (*state)[1];
    pose_.heading = (*state)[2];
    const auto up = Numbers(fields, kHeight);
    if (!up.ok()) return up.status();
    if (!up->empty()) pose_.z = up->front();
    const auto quaternion = Numbers(fields, kQuaternion);
    if (!quaternion.ok()) return quaternion.status();
    if (!quaternion->empty()) {
      if (absl::Status set = SetQuaternion(quaternion->data()); !set.ok()) {
        return set;
      }
    }
    return ReadCsvCovariance(fields);
  }

  absl::Status ReadCsvCovariance(const Fields& fields) {
    const auto planar = Numbers(fields, kPlanar);
    if (!planar.ok()) return planar.status();
    const auto up = Numbers(fields, kUp);
    if (!up.ok()) return up.status();
    if (planar->empty()) return absl::OkStatus();
    const std::vector<double>& p = *planar;
    v1::Covariance covariance;
    covariance.set_form(up->empty() ? v1::COVARIANCE_FORM_PLANAR_6
                                    : v1::COVARIANCE_FORM_SPATIAL_10);
    std::vector<double> values = p;
    if (!up->empty()) {
      const std::vector<double>& u = *up;
      values = {p[0], p[1], u[0], p[2], p[3], u[1], p[4], u[2], u[3], p[5]};
    }
    covariance.mutable_values()->Assign(values.begin(), values.end());
    pose_.covariance = covariance;
    return absl::OkStatus();
  }

  Lines& lines_;
  // The columns of a CSV file by name; empty before its header.
  std::map<std::string, std::size_t, std::less<>> columns_;
  std::size_t column_count_ = 0;
  OptimisedPose pose_;
  std::vector<OptimisedPose> poses_;
};

}  // namespace

absl::StatusOr<std::vector<OptimisedPose>> ReadOptimisedFile(
    const std::string& path, OptimisedFormat format) {
  auto bytes = OpenBytes(path, nullptr);
  if (!bytes.ok()) return bytes.status();
  Lines lines(*std::move(bytes), path);
  return OptimisedReader(&lines).Read(format);
}

}  // namespace revisit::client
