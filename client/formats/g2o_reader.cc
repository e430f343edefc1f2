#include "client/formats/g2o_reader.h"

#include <Eigen/Cholesky>
#include <Eigen/Geometry>
#include <array>
#include <cmath>
#include <cstdint>
#include <map>
#include <string>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "client/formats/angles.h"
#include "client/formats/axes.h"
#include "client/formats/plain_readers.h"

namespace revisit::client {
namespace {

using Matrix6 = Eigen::Matrix<double, 6, 6>;
using RowMajor6 = Eigen::Matrix<double, 6, 6, Eigen::RowMajor>;

// Numbers of the upper triangle of an SE3 information matrix; SE2 has the first
// six of them.
using Information = std::array<double, 21>;

struct Edge {
  std::int64_t from = 0;
  // The pose of the second vertex in the axes of the first one.
  Sample step;
  Information information{};
  bool spatial = false;
  std::int64_t line = 0;
};

Matrix6 Symmetric(const Information& upper, int size) {
  Matrix6 matrix = Matrix6::Identity();
  std::size_t next = 0;
  for (int row = 0; row < size; ++row) {
    for (int column = row; column < size; ++column) {
      matrix(row, column) = matrix(column, row) = upper[next++];
    }
  }
  return matrix;
}

// Covariance of an edge's error as (x, y, z, rotation vector) in the axes of
// its second vertex; absent if the information is not positive definite.
std::optional<Matrix6> NoiseOf(const Edge& edge) {
  const int size = edge.spatial ? 6 : 3;
  const Eigen::LLT<Matrix6> factor(Symmetric(edge.information, size));
  if (factor.info() != Eigen::Success) return std::nullopt;
  const Matrix6 covariance = factor.solve(Matrix6::Identity());
  if (!covariance.allFinite()) return std::nullopt;
  Matrix6 noise = Matrix6::Zero();
  if (edge.spatial) {
    noise = covariance;
    noise.rightCols<3>() *= 2.0;
    noise.bottomRows<3>() *= 2.0;
    return noise;
  }
  constexpr int kPlanar[] = {0, 1, 5};
  for (int row = 0; row < 3; ++row) {
    for (int column = 0; column < 3; ++column) {
      noise(kPlanar[row], kPlanar[column]) = covariance(row, column);
    }
  }
  return noise;
}

Eigen::Matrix3d AxesOf(const Sample& sample) {
  const std::array<double, 9> rows = RotationOf(sample);
  return Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(
      rows.data());
}

Eigen::Vector3d PositionOf(const Sample& sample) {
  return {sample.estimate.x, sample.estimate.y, sample.z};
}

// The pose at the end of a step from `from`.
Sample After(const Sample& from, const Sample& step) {
  const Eigen::Vector3d position =
      PositionOf(from) + AxesOf(from) * PositionOf(step);
  Sample to;
  to.estimate = {
      position.x(), position.y(),
      std::remainder(from.estimate.heading + step.estimate.heading, 2.0 * kPi)};
  to.z = position.z();
  if (step.quaternion.has_value()) {
    const Eigen::Quaterniond q(AxesOf(from) * AxesOf(step));
    to.quaternion = {q.x(), q.y(), q.z(), q.w()};
  }
  return to;
}

// Errors in the fixed axes: those of position are swung by those of rotation.
Matrix6 Carry(const Matrix6& covariance, const Sample& from, const Sample& to,
              const Matrix6& noise) {
  const Eigen::Vector3d step = PositionOf(to) - PositionOf(from);
  Matrix6 swing = Matrix6::Identity();
  swing.block<3, 3>(0, 3) << 0.0, step.z(), -step.y(), -step.z(), 0.0, step.x(),
      step.y(), -step.x(), 0.0;
  Matrix6 axes = Matrix6::Zero();
  axes.topLeftCorner<3, 3>() = AxesOf(to);
  axes.bottomRightCorner<3, 3>() = axes.topLeftCorner<3, 3>();
  return swing * covariance * swing.transpose() +
         axes * noise * axes.transpose();
}

class G2oReader : public SampleReader {
 public:
  explicit G2oReader(std::unique_ptr<Lines> lines) : lines_(std::move(lines)) {}

  absl::StatusOr<std::optional<Sample>> Next() override {
    if (!read_) {
      read_ = true;
      if (absl::Status status = ReadAll(); !status.ok()) return status;
      next_ = vertices_.begin();
    }
    if (next_ == vertices_.end()) return std::optional<Sample>();
    Sample sample = next_->second;
    absl::Status status = AddCovariance(&sample);
    if (!status.ok()) return status;
    previous_ = next_++;
    return sample;
  }

 private:
  absl::Status ReadAll() {
    std::string_view line;
    while (lines_->Next(&line)) {
      fields_ = SplitAtBlanks(line);
      if (fields_.empty() || fields_[0][0] == '#') continue;
      const std::string_view tag = fields_[0];
      absl::Status status;
      if (tag == "VERTEX_SE2" || tag == "VERTEX2") {
        status = ReadVertex(3);
      } else if (tag == "VERTEX_SE3:QUAT") {
        status = ReadVertex(7);
      } else if (tag == "EDGE_SE2" || tag == "EDGE2") {
        status = ReadEdge(3, 6);
      } else if (tag == "EDGE_SE3:QUAT") {
        status = ReadEdge(7, 21);
      } else if (tag.find_first_not_of("ABCDEFGHIJKLMNOPQRSTUVWXYZ_"
                                       "0123456789:") != tag.npos ||
                 tag[0] < 'A' || tag[0] > 'Z') {
        status = lines_->Error(
            "expected an element such as VERTEX_SE2 or EDGE_SE3:QUAT, got " +
            Quoted(tag));
      }
      if (!status.ok()) return status;
    }
    if (!lines_->status().ok()) return lines_->status();
    return vertices_.empty() ? ComposeVertices() : absl::OkStatus();
  }

  // A file of edges only: vertices follow from those between neighbours, the
  // first one at the origin.
  absl::Status ComposeVertices() {
    if (edges_.empty()) {
      return lines_->Error(
          "expected at least one VERTEX_SE2, VERTEX_SE3:QUAT or edge");
    }
    const auto& [second, edge] = *edges_.begin();
    Sample& origin = vertices_[edge.from];
    origin.line = edge.line;
    if (edge.spatial) origin.quaternion = {0.0, 0.0, 0.0, 1.0};
    for (const auto& [to, step] : edges_) {
      const auto from = vertices_.find(step.from);
      if (from == vertices_.end()) {
        return absl::InvalidArgumentError(
            absl::StrCat(lines_->path(), ":", step.line,
                         ": the file has no vertices, and "
                         "no edges that lead from vertex ",
                         edges_.begin()->second.from, " to vertex ", step.from,
                         ", where this one begins"));
      }
      Sample vertex = After(from->second, step.step);
      vertex.line = step.line;
      vertices_.emplace(to, vertex);
    }
    return absl::OkStatus();
  }

  // Reads `count` numbers behind the first `skipped` fields.
  absl::Status ReadNumbers(std::size_t skipped, std::size_t count,
                           std::vector<double>* numbers) const {
    if (fields_.size() != skipped + count) {
      return lines_->Error(absl::StrCat("expected ", skipped + count,
                                        " fields of ", std::string(fields_[0]),
                                        ", got ", fields_.size()));
    }
    numbers->clear();
    for (std::size_t i = skipped; i < fields_.size(); ++i) {
      const auto value =
          ReadNumber(fields_[i], absl::StrCat("field ", i + 1), *lines_);
      if (!value.ok()) return value.status();
      numbers->push_back(*value);
    }
    return absl::OkStatus();
  }

  absl::StatusOr<std::int64_t> IdOf(std::string_view field) const {
    const auto id = ReadNumber(field, "the id of a vertex", *lines_);
    if (!id.ok()) return id.status();
    // Whole numbers up to here are exact; gtsam puts letters into higher bits.
    if (*id < 0.0 || *id != std::floor(*id) || *id > 9.0e18) {
      return lines_->Error("expected the id of a vertex, got " + Quoted(field));
    }
    return static_cast<std::int64_t>(*id);
  }

  // The first `count` numbers as a pose: 3 in the plane, or 7.
  Sample PoseOf(std::size_t count) const {
    Sample sample;
    sample.line = lines_->number();
    sample.estimate = {numbers_[0], numbers_[1], 0.0};
    if (count == 3) {
      sample.estimate.heading = numbers_[2];
    } else {
      sample.z = numbers_[2];
      sample.quaternion = {numbers_[3], numbers_[4], numbers_[5], numbers_[6]};
    }
    return sample;
  }

  absl::Status ReadVertex(std::size_t count) {
    if (absl::Status status = ReadNumbers(2, count, &numbers_); !status.ok()) {
      return status;
    }
    const auto id = IdOf(fields_[1]);
    if (!id.ok()) return id.status();
    const Sample sample = PoseOf(count);
    if (absl::Status status = CheckPose(sample, *lines_); !status.ok()) {
      return status;
    }
    if (!vertices_.emplace(*id, sample).second) {
      return lines_->Error(absl::StrCat("vertex ", *id, " stands twice"));
    }
    return absl::OkStatus();
  }

  absl::Status ReadEdge(std::size_t pose, std::size_t information) {
    if (absl::Status status = ReadNumbers(3, pose + information, &numbers_);
        !status.ok()) {
      return status;
    }
    const auto from = IdOf(fields_[1]);
    if (!from.ok()) return from.status();
    const auto to = IdOf(fields_[2]);
    if (!to.ok()) return to.status();
    Edge edge;
    edge.from = *from;
    edge.spatial = pose == 7;
    edge.step = PoseOf(pose);
    if (absl::Status status = CheckPose(edge.step, *lines_); !status.ok()) {
      return status;
    }
    edge.line = lines_->number();
    std::copy(numbers_.begin() + static_cast<std::ptrdiff_t>(pose),
              numbers_.end(), edge.information.begin());
    // Loop closures are no odometry; only the nearest vertex before is kept.
    if (*from >= *to) return absl::OkStatus();
    const auto [found, added] = edges_.emplace(*to, edge);
    if (!added && found->second.from < *from) found->second = edge;
    return absl::OkStatus();
  }

  absl::Status AddCovariance(Sample* sample) {
    if (next_ == vertices_.begin()) {
      covariance_ = Matrix6::Zero();
      known_ = true;
    } else if (known_) {
      const auto edge = edges_.find(next_->first);
      known_ = edge != edges_.end() && edge->second.from == previous_->first;
      if (known_) {
        const auto noise = NoiseOf(edge->second);
        if (!noise.has_value()) {
          return absl::InvalidArgumentError(absl::StrCat(
              lines_->path(), ":", edge->second.line,
              ": expected a positive definite information matrix"));
        }
        covariance_ =
            Carry(covariance_, previous_->second, next_->second, *noise);
      }
    }
    if (!known_) return absl::OkStatus();
    if (!covariance_.allFinite()) {
      known_ = false;
      return absl::OkStatus();
    }
    std::array<double, 36> values;
    Eigen::Map<RowMajor6>(values.data()) = covariance_;
    sample->covariance = PlanarPart(values);
    if (sample->quaternion.has_value()) sample->covariance_36 = values;
    return absl::OkStatus();
  }

  const std::unique_ptr<Lines> lines_;
  std::vector<std::string_view> fields_;
  std::vector<double> numbers_;
  bool read_ = false;
  std::map<std::int64_t, Sample> vertices_;
  // By their second vertex.
  std::map<std::int64_t, Edge> edges_;
  std::map<std::int64_t, Sample>::const_iterator next_;
  std::map<std::int64_t, Sample>::const_iterator previous_;
  Matrix6 covariance_;
  // Whether an unbroken chain of edges leads here.
  bool known_ = false;
};

}  // namespace

absl::StatusOr<std::unique_ptr<SampleReader>> ReadG2o(
    std::unique_ptr<Lines> lines, const ReaderOptions& /*options*/) {
  return std::make_unique<G2oReader>(std::move(lines));
}

}  // namespace revisit::client
