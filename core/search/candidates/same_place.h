// Whether two nodes of the history are passes of one place: a vehicle that has
// been here nine times is no less sure of where it is than one that has been
// here once.
#ifndef REVISIT_CORE_SEARCH_CANDIDATES_SAME_PLACE_H_
#define REVISIT_CORE_SEARCH_CANDIDATES_SAME_PLACE_H_

#include <optional>
#include <vector>

#include "core/drive/confirmed_loop.h"
#include "core/drive/frame_relation.h"
#include "core/drive/pose_graph.h"
#include "core/search/alignment/relative_model.h"

namespace revisit::core {

// Probability that nodes i and j are passes of one place in the same direction.
// It is 1 where a confirmed loop closure joins nodes within kPlaceRadiusMeters
// of each, and 0 where i and j lie within twice that of each other along the
// path, and so are a single pass. Otherwise it follows from the odds of
// relative.h, with the difference of the two nodes as the anchor. Since both
// run along with the same recent path, `log_likelihood_ratio`, the lesser of
// theirs, stands for that of their shapes. `known_scale`: that of the graph's
// drive (FrameNodes), instead of the model's.
double SamePlaceProbability(const PoseGraph& graph, const RelativeModel& model,
                            NodeIndex i, NodeIndex j,
                            double log_likelihood_ratio,
                            std::optional<double> known_scale = std::nullopt);

// The same for nodes of two recordings. `relation` is that of i's frame to j's;
// where nothing ties them, shapes alone are compared. `links` are those of the
// two frames, if they are of two drives.
double SamePlaceAcross(const RelatedFrames& frames,
                       const FrameRelation& relation,
                       const std::vector<ConfirmedLoop>& links,
                       const RelativeModel& model, NodeIndex i, NodeIndex j,
                       double log_likelihood_ratio);

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_CANDIDATES_SAME_PLACE_H_
