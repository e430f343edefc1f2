#include "core/noise/noise_model.h"

#include "core/noise/models.h"

namespace revisit::core {

const NoiseModel& NoiseOf(CorrelationModel model) {
  return WithModel(model, [](auto of) -> const NoiseModel& {
    static constexpr NoiseModel kRow = decltype(of)::Row();
    return kRow;
  });
}

bool operator==(const Correlation& a, const Correlation& b) {
  return a.model == b.model &&
         (!a.noise().decorrelates_over_way || a.meters == b.meters);
}

}  // namespace revisit::core
