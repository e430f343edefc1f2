#include "core/search/candidates/rivals.h"

#include <algorithm>
#include <map>
#include <numeric>
#include <utility>

#include "core/drive/node_range.h"
#include "core/search/candidates/posterior.h"
#include "core/search/candidates/same_place.h"

namespace revisit::core {

namespace {

// Whether both are of one history, driven in one direction.
bool AreAlongside(const RankedPlace& a, const RankedPlace& b) {
  return a.history == b.history && a.direction == b.direction;
}

}  // namespace

// Asks whether two places are passes of one.
class Rivals::Passes {
 public:
  Passes(const std::vector<History>& histories, const FrameRelations* frames,
         const RelativeModel& model, const std::vector<RankedPlace>& places)
      : histories_(histories), frames_(frames), model_(model) {
    for (const RankedPlace& place : places) {
      asked_.push_back(histories[place.history].frame);
    }
    std::sort(asked_.begin(), asked_.end());
    asked_.erase(std::unique(asked_.begin(), asked_.end()), asked_.end());
  }

  double Same(const RankedPlace& a, const RankedPlace& b) {
    const double ratio =
        std::min(a.log_likelihood_ratio, b.log_likelihood_ratio);
    const std::size_t from = histories_[a.history].frame;
    const std::size_t to = histories_[b.history].frame;
    if (from == to) {
      return SamePlaceProbability(histories_[a.history].graph, model_,
                                  a.end.matched, b.end.matched, ratio,
                                  histories_[a.history].known_scale);
    }
    return SamePlaceAcross(frames_->Between(from, to), RelationOf(from, to),
                           frames_->LinksBetween(from, to), model_,
                           a.end.matched, b.end.matched, ratio);
  }

 private:
  const FrameRelation& RelationOf(std::size_t from, std::size_t to) {
    auto relations = relations_.find(from);
    if (relations == relations_.end()) {
      relations = relations_.emplace(from, frames_->From(from, asked_)).first;
    }
    const auto at = std::lower_bound(asked_.begin(), asked_.end(), to);
    return relations->second[static_cast<std::size_t>(at - asked_.begin())];
  }

  const std::vector<History>& histories_;
  const FrameRelations* const frames_;
  const RelativeModel& model_;
  // The frames of all places, sorted.
  std::vector<std::size_t> asked_;
  // The relations of a frame to these, once one was asked for.
  std::map<std::size_t, std::vector<FrameRelation>> relations_;
};

Rivals::Rivals(const std::vector<History>& histories,
               const FrameRelations* frames, const RelativeModel& model,
               std::vector<RankedPlace> places, std::size_t answered)
    : places_(std::move(places)) {
  Passes passes(histories, frames, model, places_);
  for (const RankedPlace& place : places_) {
    least_claimed_ = std::max(least_claimed_, kLeastRivalShare * place.claimed);
  }
  const std::size_t first =
      std::min(places_.size(), std::max(answered, kWeighed));
  for (std::size_t i = 0; i < first; ++i) Weigh(histories, &passes, i);
  for (std::size_t i = first;
       i < places_.size() && weighed_.size() < first + kWeighed; ++i) {
    if (places_[i].claimed >= least_claimed_ && !IsLikeAny(i)) {
      Weigh(histories, &passes, i);
    }
  }
}

void Rivals::Weigh(const std::vector<History>& histories, Passes* passes,
                   std::size_t place) {
  const RankedPlace& a = places_[place];
  Weighed weighed{place, std::vector<double>(places_.size()), 0.0};
  for (std::size_t j = 0; j < places_.size(); ++j) {
    const RankedPlace& b = places_[j];
    if (j == place) {
      weighed.same[j] = 1.0;
    } else if (a.direction == b.direction && b.claimed >= least_claimed_) {
      weighed.same[j] = passes->Same(a, b);
    }
  }
  weighed.probability = Pooled(histories[a.history].graph, weighed);
  weighed_.push_back(std::move(weighed));
}

double Rivals::AverageOverPasses(const std::vector<History>& histories,
                                 double new_place) {
  const std::vector<double> passes = CountPasses();
  double claimed = 0.0;
  double averaged = 0.0;
  double rest = 1.0 - new_place;
  for (std::size_t j = 0; j < places_.size(); ++j) {
    rest -= places_[j].claimed;
    if (passes[j] == 0.0) continue;
    claimed += places_[j].claimed;
    averaged += places_[j].claimed / passes[j];
  }
  if (averaged == 0.0) return new_place;
  const double usual = claimed / averaged;
  double total = new_place + std::max(rest, 0.0) / usual;
  for (std::size_t j = 0; j < places_.size(); ++j) {
    places_[j].claimed /= passes[j] == 0.0 ? usual : passes[j];
    total += places_[j].claimed;
  }
  for (RankedPlace& place : places_) place.claimed /= total;
  for (Weighed& weighed : weighed_) {
    weighed.probability =
        Pooled(histories[places_[weighed.place].history].graph, weighed);
  }
  return new_place / total;
}

// A place that is not weighed has its passes in common with the one that is
// most like it.
std::vector<double> Rivals::CountPasses() const {
  std::vector<double> passes(places_.size());
  std::vector<double> alike(places_.size());
  for (const Weighed& weighed : weighed_) {
    const double others =
        std::accumulate(weighed.same.begin(), weighed.same.end(), -1.0);
    for (std::size_t j = 0; j < places_.size(); ++j) {
      if (weighed.same[j] <= alike[j]) continue;
      alike[j] = weighed.same[j];
      passes[j] = 1.0 + weighed.same[j] * others;
    }
  }
  return passes;
}

// Whether a place that is weighed is more probably this one than not.
bool Rivals::IsLikeAny(std::size_t place) const {
  return std::any_of(
      weighed_.begin(), weighed_.end(),
      [place](const Weighed& weighed) { return weighed.same[place] > 0.5; });
}

double Rivals::Pooled(const PoseGraph& graph, const Weighed& weighed) const {
  const RankedPlace& place = places_[weighed.place];
  // The best end of a stretch stands for all of it.
  const bool stands = std::none_of(
      places_.begin(),
      places_.begin() + static_cast<std::ptrdiff_t>(weighed.place),
      [&](const RankedPlace& better) {
        return AreAlongside(better, place) &&
               graph.MetersApart(better.end.matched, place.end.matched) <=
                   2.0 * kPlaceRadiusMeters;
      });
  double probability = place.claimed;
  for (std::size_t j = 0; j < places_.size(); ++j) {
    if (stands && j != weighed.place) {
      probability += weighed.same[j] * places_[j].claimed;
    }
  }
  return std::min(probability, 1.0);
}

double Rivals::RunnerUp(std::size_t i) const {
  double runner_up = 0.0;
  for (const Weighed& other : weighed_) {
    const double without =
        other.probability - other.same[i] * places_[i].claimed;
    runner_up =
        std::max(runner_up, (1.0 - weighed_[i].same[other.place]) * without);
  }
  return runner_up;
}

}  // namespace revisit::core
