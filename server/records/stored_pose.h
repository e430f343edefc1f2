// The bytes of a pose in the store, straight from the message in which it came.
#ifndef REVISIT_SERVER_RECORDS_STORED_POSE_H_
#define REVISIT_SERVER_RECORDS_STORED_POSE_H_

#include <cstddef>
#include <cstdint>
#include <memory>
#include <string>

#include "server/fields/pose_fields.h"

namespace revisit::server {

// Writes a pose as a serialized revisit.stored.Pose. Copying it into that
// message and serializing the copy gives the same bytes, and takes longer than
// all else that is done with a pose. Only fields that are named here reach the
// store.
class StoredPose {
 public:
  explicit StoredPose(const PoseFields& pose);

  // How many bytes the pose takes.
  std::size_t size() const { return size_; }

  // Returns the end of what was written, size() bytes on. REQUIRES: `pose` is
  // the one that this was made of.
  std::uint8_t* Write(const PoseFields& pose, std::uint8_t* next) const;

 private:
  // The sizes of the messages in the pose.
  std::uint32_t stamp_size_ = 0;
  std::uint32_t position_size_ = 0;
  std::uint32_t quaternion_size_ = 0;
  std::uint32_t covariance_size_ = 0;
  // The bytes of the recording's start; null if there is none. Few poses have
  // one, so that it is copied and serialized.
  std::unique_ptr<const std::string> recording_start_;
  std::size_t size_ = 0;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_RECORDS_STORED_POSE_H_
