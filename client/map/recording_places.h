// Where the recordings of a vehicle lie on one map.
#ifndef REVISIT_CLIENT_MAP_RECORDING_PLACES_H_
#define REVISIT_CLIENT_MAP_RECORDING_PLACES_H_

#include <vector>

#include "client/map/map_contents.h"
#include "revisit/v1/recording.pb.h"

namespace revisit::client {

// Carries the nodes, each in the frame of its recording, to the frame of the
// last one by Recording.frame_pose; those of recordings that nothing ties to it
// go beside the others, each by itself. Gives each recording its colour and
// label. Nothing changes where there are fewer than two. REQUIRES: recordings
// in their order.
void PlaceRecordings(const std::vector<v1::Recording>& recordings,
                     MapContents* contents);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_MAP_RECORDING_PLACES_H_
