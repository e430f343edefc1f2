#ifndef REVISIT_CORE_SEARCH_BELIEF_BEGINS_WITH_BELIEF_H_
#define REVISIT_CORE_SEARCH_BELIEF_BEGINS_WITH_BELIEF_H_

#include "core/drive/correlation.h"
#include "core/settings.h"

namespace revisit::core {

// Whether a search with these options, of a vehicle with these settings, begins
// with a belief (drive_belief.h). Scale and drift are those of dead reckoning,
// so marks can show them only where the vehicle's own model is that.
inline bool BeginsWithBelief(const SearchOptions& options,
                             const DriveSettings& vehicle) {
  return options.use_belief && options.alignment == AlignmentKind::kRelative &&
         options.correlation_model == CorrelationModel::kDeadReckoning &&
         vehicle.search.correlation_model == CorrelationModel::kDeadReckoning;
}

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_BELIEF_BEGINS_WITH_BELIEF_H_
