#include "core/search/candidates/search_task.h"

namespace revisit::core {

NodeIndex SearchTask::history_size() const {
  NodeIndex size = 0;
  for (const History& history : histories) size += history.size();
  return size;
}

std::vector<Direction> Directions(SearchDirection direction) {
  switch (direction) {
    case SearchDirection::kSame:
      return {Direction::kSame};
    case SearchDirection::kOpposite:
      return {Direction::kOpposite};
    case SearchDirection::kEither:
      break;
  }
  return {Direction::kSame, Direction::kOpposite};
}

absl::Status StoppedError() {
  return absl::CancelledError("the search was told to stop");
}

}  // namespace revisit::core
