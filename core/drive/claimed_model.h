#ifndef REVISIT_CORE_DRIVE_CLAIMED_MODEL_H_
#define REVISIT_CORE_DRIVE_CLAIMED_MODEL_H_

#include "core/noise/similarity_model.h"
#include "core/settings.h"

namespace revisit::core {

// The model that the options ask for, with the claimed covariances: not
// inflated.
inline SimilarityModel ClaimedModel(StateSpace space,
                                    const SearchOptions& options) {
  SimilarityModel model;
  model.state_space = space;
  model.correlation = CorrelationOf(options);
  model.form = options.likelihood_form;
  model.tolerance = options.place_tolerance;
  return model;
}

}  // namespace revisit::core

#endif  // REVISIT_CORE_DRIVE_CLAIMED_MODEL_H_
