// Poses that are answered as columns (revisit.v1.PoseColumns).
#ifndef REVISIT_SERVER_CONVERSION_POSE_COLUMNS_ANSWER_H_
#define REVISIT_SERVER_CONVERSION_POSE_COLUMNS_ANSWER_H_

#include <cstdint>

#include "google/protobuf/field_mask.pb.h"
#include "google/protobuf/repeated_field.h"
#include "revisit/v1/geometry.pb.h"
#include "revisit/v1/pose_columns.pb.h"

namespace revisit::server {

// Adds messages for poses that come one after the other: as few as there can
// be, each of poses that are alike in what they have.
class PoseColumnsAnswer {
 public:
  using Messages = google::protobuf::RepeatedPtrField<v1::PoseColumns>;

  // `mask` names the fields of v1::Pose that are answered; an empty one, all.
  // `most_poses`: in a message. `messages` has to outlive this.
  PoseColumnsAnswer(const google::protobuf::FieldMask& mask, int most_poses,
                    Messages* messages);

  // Adds a pose, of which only the fields of the mask are left. `sequence` is
  // its sequence, also where the mask leaves that out. REQUIRES: sequences
  // ascend; stamps are within the years 1678 to 2261.
  void Add(const v1::Pose& pose, std::uint64_t sequence);

  // Call this after the last pose.
  void Finish();

 private:
  // Whether the current message can say the pose behind the others.
  bool Fits(const v1::Pose& pose, std::uint64_t sequence) const;
  void Begin(const v1::Pose& pose);
  void AddPosition(const v1::Pose& pose);
  void ShortenHeights();
  void ShortenCovariances();

  const bool has_x_;
  const bool has_y_;
  const bool has_z_;
  const int most_poses_;
  Messages* const messages_;

  // The message that poses are added to; null before the first pose.
  v1::PoseColumns* current_ = nullptr;
  // The kinds of fields that its poses have in common, and its last pose.
  v1::Pose::PositionCase position_{};
  v1::Pose::OrientationCase orientation_{};
  bool has_covariance_ = false;
  int covariance_values_ = 0;
  // Numbers of an error transition; 0 if none has come.
  int transition_ = 0;
  std::uint64_t last_sequence_ = 0;
  std::int64_t last_stamp_ns_ = 0;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_CONVERSION_POSE_COLUMNS_ANSWER_H_
