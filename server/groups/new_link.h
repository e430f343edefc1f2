// A loop closure between two vehicles, or a rejected candidate, as a caller
// asks for it.
#ifndef REVISIT_SERVER_GROUPS_NEW_LINK_H_
#define REVISIT_SERVER_GROUPS_NEW_LINK_H_

#include <cstdint>
#include <string>

#include "server/storage/records.h"

namespace revisit::server {

struct NewLink {
  struct Pose {
    std::string vehicle_id;
    std::uint64_t sequence = 0;
  };

  std::string id;
  Pose query;
  Pose matched;
  // As EncodeLinkContent() makes it; its time of creation means nothing, and
  // its measurement was not compared with a state space.
  std::string payload;
  PairKind kind = PairKind::kLoopClosure;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_GROUPS_NEW_LINK_H_
