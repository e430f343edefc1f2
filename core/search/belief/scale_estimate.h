#ifndef REVISIT_CORE_SEARCH_BELIEF_SCALE_ESTIMATE_H_
#define REVISIT_CORE_SEARCH_BELIEF_SCALE_ESTIMATE_H_

namespace revisit::core {

// The scale of the true standard deviations to the claimed ones, and bounds
// between which it lies with probability 0.9.
struct ScaleEstimate {
  double scale = 1.0;
  double low = 1.0;
  double high = 1.0;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_BELIEF_SCALE_ESTIMATE_H_
