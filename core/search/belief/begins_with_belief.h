#ifndef REVISIT_CORE_SEARCH_BELIEF_BEGINS_WITH_BELIEF_H_
#define REVISIT_CORE_SEARCH_BELIEF_BEGINS_WITH_BELIEF_H_

#include "core/noise/noise_model.h"
#include "core/settings.h"

namespace revisit::core {

// Whether a search with these options, of a vehicle with these settings, begins
// with a belief (drive_belief.h). Marks show scale and drift under the
// vehicle's own noise model, so they say nothing about another.
inline bool BeginsWithBelief(const SearchOptions& options,
                             const DriveSettings& vehicle) {
  return options.use_belief && options.alignment == AlignmentKind::kRelative &&
         options.correlation_model == vehicle.search.correlation_model &&
         NoiseOf(options.correlation_model).lets_belief_begin;
}

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_BELIEF_BEGINS_WITH_BELIEF_H_
