// Poses that came as columns (revisit.v1.PoseColumns), one after the other.
#ifndef REVISIT_SERVER_CONVERSION_POSE_COLUMNS_H_
#define REVISIT_SERVER_CONVERSION_POSE_COLUMNS_H_

#include <array>
#include <cstddef>
#include <cstdint>
#include <string>
#include <vector>

#include "google/protobuf/timestamp.pb.h"
#include "revisit/v1/pose_columns.pb.h"
#include "server/fields/field_violations.h"
#include "server/fields/pose_fields.h"

namespace revisit::server {

// The message must outlive it, and stay as it is.
class PoseColumns {
 public:
  // Adds a violation for each column whose length does not fit the others, for
  // columns that exclude each other, and for those that are missing. Fields lie
  // below `path`.
  PoseColumns(const v1::PoseColumns& message, const FieldPath& path,
              Violations* violations);

  std::size_t size() const {
    return static_cast<std::size_t>(message_.pose_count());
  }
  // The fields of a pose, valid until the next call. REQUIRES: there were no
  // violations; the index is below size().
  PoseFields At(std::size_t index);

  // The name of a number in its column, where a message Pose at this index has
  // a field of this name, such as "local.x_meters".
  std::string ColumnOf(std::size_t index, const std::string& field) const;

 private:
  void CheckLengths(const FieldPath& path, Violations* violations) const;
  void CheckChoices(const FieldPath& path, Violations* violations) const;
  void CheckPerPose(int given, std::size_t per_pose, bool may_be_one,
                    const FieldPath& path, Violations* violations) const;
  void ReadTransitions(const FieldPath& path, Violations* violations);
  void ReadStamps(const FieldPath& path, Violations* violations);
  CovarianceFields CovarianceAt(std::size_t index);
  // Where the transition of a pose that has one begins in its column.
  std::size_t TransitionBegin(std::size_t index) const {
    return (first_has_none_ ? index - 1 : index) * transition_;
  }

  const v1::PoseColumns& message_;
  const CovarianceForm form_;
  // Numbers in a covariance of this form, and on its diagonal; 0 for a form
  // that nobody understands.
  const std::size_t values_;
  const std::size_t diagonal_;
  // Numbers of a transition; 0 if there are none.
  std::size_t transition_ = 0;
  // Whether the first pose has no transition.
  bool first_has_none_ = false;
  // Since the Unix epoch; empty if there are no stamps.
  std::vector<std::int64_t> stamps_ns_;

  // The fields of the last pose point to these.
  google::protobuf::Timestamp stamp_;
  std::array<double, 36> covariance_{};
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_CONVERSION_POSE_COLUMNS_H_
