#ifndef REVISIT_CORE_DRIVE_FRAME_STATE_H_
#define REVISIT_CORE_DRIVE_FRAME_STATE_H_

namespace revisit::core {

// How the frames of two recordings are tied to each other, the surest first.
// States are numbered from 0 without gaps.
enum class FrameState {
  // Both are one recording.
  kSame,
  // By at least kConsistentLinks confirmed loop closures that agree.
  kKnown,
  // By confirmed loop closures, fewer of which agree on some part of the way
  // from the one to the other.
  kProvisional,
  // Both were placed in one frame that they share.
  kDatum,
  // The later one began where the earlier one ended, over one or more gaps.
  kAfter,
  // Nothing ties them.
  kNone,
};

inline constexpr int kConsistentLinks = 3;

}  // namespace revisit::core

#endif  // REVISIT_CORE_DRIVE_FRAME_STATE_H_
