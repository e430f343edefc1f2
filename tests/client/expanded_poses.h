// Poses that came as columns, as the messages that say the same.
#ifndef REVISIT_TESTS_CLIENT_EXPANDED_POSES_H_
#define REVISIT_TESTS_CLIENT_EXPANDED_POSES_H_

#include "revisit/v1/pose_graph_service.pb.h"

namespace revisit::client {

// Adds the poses that these columns say, whichever fields a read mask left
// them. REQUIRES: columns fit each other.
void AddExpanded(const v1::PoseColumns& columns,
                 google::protobuf::RepeatedPtrField<v1::Pose>* poses);

// The batch itself where it has no columns. REQUIRES: columns fit each other.
v1::PoseBatch Expanded(const v1::PoseBatch& batch);

}  // namespace revisit::client

#endif  // REVISIT_TESTS_CLIENT_EXPANDED_POSES_H_
