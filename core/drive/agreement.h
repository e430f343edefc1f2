// How well the measurement of a loop closure agrees with the graph: the
// chi-square test of its innovation.
#ifndef REVISIT_CORE_DRIVE_AGREEMENT_H_
#define REVISIT_CORE_DRIVE_AGREEMENT_H_

#include <optional>

namespace revisit::core {

class PoseGraph;
struct ConfirmedLoop;
struct FrameRelation;
struct RelatedFrames;
struct SimilarityModel;

struct Agreement {
  // y^T (Gamma + M)^-1 y, with Gamma inflated.
  double squared_mahalanobis = 0.0;
  int degrees_of_freedom = 3;
  // Probability of at least this distance for a true closure.
  double p_value = 0.0;
  double inflation = 1.0;
};

// Nothing where Gamma + M is ill-conditioned. Of the model, state space,
// correlation and inflation count. REQUIRES: as for InnovationOf().
std::optional<Agreement> AgreementOf(const PoseGraph& graph,
                                     const SimilarityModel& model,
                                     const ConfirmedLoop& loop);

// The same for poses of two recordings: `relation` is that of the query's frame
// to the matched one. Nothing where these are not tied either.
std::optional<Agreement> AgreementAcross(const RelatedFrames& frames,
                                         const FrameRelation& relation,
                                         const SimilarityModel& model,
                                         const ConfirmedLoop& loop);

}  // namespace revisit::core

#endif  // REVISIT_CORE_DRIVE_AGREEMENT_H_
