#include "core/drive/suspects.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cassert>
#include <cmath>
#include <map>
#include <numeric>
#include <optional>
#include <utility>

#include "core/drive/confirmed_loop.h"
#include "core/drive/consistent_set.h"
#include "core/drive/drive.h"
#include "core/drive/pose_graph.h"
#include "core/drive/recordings.h"
#include "core/geometry/frame_transform.h"
#include "core/geometry/heading.h"
#include "core/geometry/quadratic_form.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/chi_squared.h"
#include "core/noise/dead_reckoning.h"
#include "core/noise/similarity_model.h"
#include "core/settings.h"

namespace revisit::core {
namespace {

// Steps of the search for the largest set of a component: its first set, which
// takes those first that contradict the fewest, is nearly always the largest.
constexpr std::int64_t kComponentSteps = 20'000;

// One end of a closure.
template <int D>
struct ClosureEnd {
  std::uint64_t sequence = 0;
  Pose pose;
  // Scaled.
  StateMatrix<D> covariance;
  double meters = 0.0;
  NodeIndex segment = 0;
};

// The pose of a query as seen from the matched pose, in whose axes the
// covariance of its error is.
template <int D>
struct RelativeEstimate {
  Pose relative;
  StateMatrix<D> covariance;
};

template <int D>
struct JudgedClosure {
  ClosureEnd<D> query;
  ClosureEnd<D> matched;
  RelativeEstimate<D> z;
  std::size_t number = 0;
};

// The covariance that dead reckoning adds between two poses to the error of the
// second as seen from the first, in the axes of the local frame.
template <int D>
StateMatrix<D> AddedBetween(const ClosureEnd<D>& from,
                            const ClosureEnd<D>& to) {
  if (from.sequence <= to.sequence) {
    return to.covariance - Swung<D>(from.covariance, from.pose, to.pose);
  }
  return Swung<D>(StateMatrix<D>(from.covariance -
                                 Swung<D>(to.covariance, to.pose, from.pose)),
                  from.pose, to.pose);
}

// The second moment of what a turn of this variance about a point moves another
// one, so far from it, beyond the first order: that of 1/2 turn^2 meters.
double BeyondFirstOrder(double turn_variance, double meters) {
  const double moved = turn_variance * meters;
  return 0.75 * moved * moved;
}

double MetersBetween(const Pose& a, const Pose& b) {
  return std::hypot(a.x - b.x, a.y - b.y);
}

// Carries an estimate for one closure along the path at both ends to another
// closure.
template <int D>
RelativeEstimate<D> CarriedAlong(const RelativeEstimate<D>& estimate,
                                 const JudgedClosure<D>& from,
                                 const JudgedClosure<D>& to) {
  constexpr int h = D - 1;
  // All in the axes of the other matched pose.
  const Pose matched = Compose(Inverse(to.matched.pose), from.matched.pose);
  const Pose query = Compose(matched, estimate.relative);
  RelativeEstimate<D> carried;
  carried.relative =
      Compose(query, Compose(Inverse(from.query.pose), to.query.pose));
  const StateMatrix<D> of_matched = AddedBetween(to.matched, from.matched);
  const StateMatrix<D> of_query = AddedBetween(from.query, to.query);
  carried.covariance =
      Swung<D>(Turned<D>(of_matched, -to.matched.pose.heading), matched,
               carried.relative) +
      Swung<D>(Turned<D>(estimate.covariance, matched.heading), query,
               carried.relative) +
      Turned<D>(of_query, query.heading - from.query.pose.heading);
  // Over long ways headings go astray by so much that the first order is not
  // enough: what is measured to decimetres would contradict itself.
  const double beyond =
      BeyondFirstOrder(of_matched(h, h),
                       MetersBetween(Pose(), matched) +
                           MetersBetween(matched, carried.relative)) +
      BeyondFirstOrder(estimate.covariance(h, h) + of_query(h, h),
                       MetersBetween(query, carried.relative));
  carried.covariance(0, 0) += beyond;
  carried.covariance(1, 1) += beyond;
  return carried;
}

template <int D>
StateVector<D> DifferenceOf(const RelativeEstimate<D>& a,
                            const RelativeEstimate<D>& b) {
  return ToVector<D>(Difference(a.relative, b.relative));
}

// The distance of two independent estimates; nothing where they are
// ill-conditioned.
template <int D>
std::optional<double> SquaredDistance(const RelativeEstimate<D>& a,
                                      const RelativeEstimate<D>& b) {
  const auto form =
      Evaluate<D>(Symmetric<D>(StateMatrix<D>(a.covariance + b.covariance)),
                  DifferenceOf(a, b));
  if (!form) return std::nullopt;
  return form->squared_mahalanobis;
}

// Both in one; the first alone where they are ill-conditioned.
template <int D>
RelativeEstimate<D> Fused(const RelativeEstimate<D>& a,
                          const RelativeEstimate<D>& b) {
  const StateMatrix<D> sum =
      Symmetric<D>(StateMatrix<D>(a.covariance + b.covariance));
  if (!IsPositiveDefinite<D>(sum)) return a;
  const StateMatrix<D> gain =
      Eigen::LDLT<StateMatrix<D>>(sum).solve(a.covariance).transpose();
  const StateVector<D> step = gain * DifferenceOf(b, a);
  RelativeEstimate<D> fused = a;
  fused.relative.x += step(0);
  fused.relative.y += step(1);
  if (D == 4) fused.relative.z += step(2);
  fused.relative.heading = WrapHeading(fused.relative.heading + step(D - 1));
  fused.covariance =
      Symmetric<D>(StateMatrix<D>(a.covariance - gain * a.covariance));
  return fused;
}

template <int D>
ClosureEnd<D> EndOf(const PoseGraph& graph, NodeIndex node,
                    std::uint64_t sequence, const PoseEstimate& estimate,
                    double scale) {
  ClosureEnd<D> end;
  end.sequence = sequence;
  end.pose = estimate.pose;
  end.covariance = scale * ToMatrix<D>(estimate.covariance);
  end.meters = graph.node(node).travelled_meters;
  end.segment = graph.SegmentStart(node);
  return end;
}

template <int D>
JudgedClosure<D> ClosureOf(const PoseGraph& graph, const ConfirmedPair& pair,
                           double scale) {
  const ConfirmedLoop& loop = pair.loop;
  JudgedClosure<D> closure;
  if (loop.measured != nullptr) {
    const MeasuredLoop& measured = *loop.measured;
    closure.query =
        EndOf<D>(graph, loop.query, pair.query_sequence, measured.query, scale);
    closure.matched = EndOf<D>(graph, loop.matched, pair.matched_sequence,
                               measured.matched, scale);
    closure.z = {measured.measurement.relative,
                 ToMatrix<D>(measured.measurement.covariance)};
    return closure;
  }
  const auto end_at = [&](NodeIndex node, std::uint64_t sequence) {
    return EndOf<D>(graph, node, sequence,
                    {graph.pose(node), graph.covariance(node)}, scale);
  };
  closure.query = end_at(loop.query, pair.query_sequence);
  closure.matched = end_at(loop.matched, pair.matched_sequence);
  // At one place, either may be seen from the other.
  if (loop.query < loop.matched) std::swap(closure.query, closure.matched);
  if (DirectionOf(graph, loop) == Direction::kOpposite) {
    closure.z.relative.heading = kPi;
  }
  closure.z.covariance.setZero();
  AddTolerance<D>(kConfirmedTolerance, &closure.z.covariance);
  return closure;
}

// The root of a thing's tree, to which the path becomes short.
std::size_t RootOf(std::size_t i, std::vector<std::size_t>* parents) {
  while ((*parents)[i] != i) {
    (*parents)[i] = (*parents)[(*parents)[i]];
    i = (*parents)[i];
  }
  return i;
}

}  // namespace

class SuspectSearch::Impl {
 public:
  virtual ~Impl() = default;
  virtual bool Run(const ShouldStop& should_stop) = 0;

  bool done = false;
  std::vector<Suspect> suspects;
};

template <int D>
class SuspectSearch::ImplIn : public Impl {
 public:
  explicit ImplIn(const Drive& drive)
      : threshold_(ChiSquaredQuantile(D, kConsistentProbability)) {
    const SimilarityModel model = drive.SimilarityOf(drive.settings().search);
    if (!model.correlation.noise().closures_show_drift) return;
    const double scale = model.inflation * model.inflation;
    const Recordings& recordings = drive.recordings();
    std::map<std::pair<std::uint64_t, std::uint64_t>, std::size_t> occurrences;
    for (const ConfirmedPair& pair : drive.confirmed()) {
      Suspect named;
      named.query_sequence = pair.query_sequence;
      named.matched_sequence = pair.matched_sequence;
      named.occurrence =
          occurrences[{pair.query_sequence, pair.matched_sequence}]++;
      if (recordings.Of(pair.loop.query) != recordings.Of(pair.loop.matched)) {
        continue;
      }
      closures_.push_back(ClosureOf<D>(drive.graph(), pair, scale));
      closures_.back().number = named_.size();
      named_.push_back(named);
    }
    std::stable_sort(closures_.begin(), closures_.end(),
                     [](const JudgedClosure<D>& a, const JudgedClosure<D>& b) {
                       return a.query.meters < b.query.meters;
                     });
    contradicted_by_.resize(closures_.size());
    believed_.assign(closures_.size(), 1);
  }

  bool Run(const ShouldStop& should_stop) override {
    const auto stop = [&should_stop] { return should_stop && should_stop(); };
    while (compared_ < closures_.size()) {
      CompareWithLater(compared_++);
      if (stop()) return false;
    }
    if (!has_components_) FindComponents();
    while (!components_.empty()) {
      if (!ChooseIn(components_.back(), should_stop)) return false;
      components_.pop_back();
      if (stop()) return false;
    }
    while (judged_ < closures_.size()) {
      const std::size_t i = judged_++;
      if (believed_[i]) continue;
      Judge(i);
      if (stop()) return false;
    }
    if (!done) Finish();
    return true;
  }

 private:
  using Closure = JudgedClosure<D>;
  using Estimate = RelativeEstimate<D>;

  // How far behind each other two closures may be in their order.
  static constexpr std::size_t kReach = kMostNeighbours / 2;

  static bool AreCompared(const Closure& a, const Closure& b) {
    return a.query.segment == b.query.segment &&
           a.matched.segment == b.matched.segment &&
           std::abs(a.query.meters - b.query.meters) <= kComparedWithinMeters;
  }

  void CompareWithLater(std::size_t i) {
    const Closure& closure = closures_[i];
    const std::size_t end = std::min(closures_.size(), i + kReach + 1);
    for (std::size_t j = i + 1; j < end; ++j) {
      const Closure& other = closures_[j];
      if (!AreCompared(closure, other)) continue;
      const std::optional<double> squared = SquaredDistance<D>(
          other.z, CarriedAlong<D>(closure.z, closure, other));
      if (!squared || *squared <= threshold_) continue;
      contradicted_by_[i].push_back(j);
      contradicted_by_[j].push_back(i);
    }
  }

  // Finds what contradicts each other, over any number of others.
  void FindComponents() {
    std::vector<std::size_t> parents(closures_.size());
    std::iota(parents.begin(), parents.end(), std::size_t{0});
    for (std::size_t i = 0; i < closures_.size(); ++i) {
      for (const std::size_t j : contradicted_by_[i]) {
        parents[RootOf(i, &parents)] = RootOf(j, &parents);
      }
    }
    std::map<std::size_t, std::vector<std::size_t>> by_root;
    for (std::size_t i = 0; i < closures_.size(); ++i) {
      if (contradicted_by_[i].empty()) continue;
      std::vector<std::size_t>& component = by_root[RootOf(i, &parents)];
      component.push_back(i);
      if (component.size() < kMostTogether) continue;
      components_.push_back(std::move(component));
      component.clear();
    }
    for (auto& [root, component] : by_root) {
      if (!component.empty()) components_.push_back(std::move(component));
    }
    has_components_ = true;
  }

  // How well the closure agrees with the drive before it.
  double OwnProbability(const Closure& closure) const {
    const Estimate reckoned = {
        Compose(Inverse(closure.matched.pose), closure.query.pose),
        Turned<D>(AddedBetween(closure.matched, closure.query),
                  -closure.matched.pose.heading)};
    const std::optional<double> squared =
        SquaredDistance<D>(closure.z, reckoned);
    return squared ? ChiSquaredAbove(D, *squared) : 1.0;
  }

  // Sorts a component: those first that contradict the fewest, and then those
  // that are likelier by themselves: of two that contradict each other, that
  // one is believed.
  void SortByTrust(std::vector<std::size_t>* component) const {
    std::vector<std::pair<std::pair<std::size_t, double>, std::size_t>> order;
    for (const std::size_t i : *component) {
      order.push_back(
          {{contradicted_by_[i].size(), -OwnProbability(closures_[i])}, i});
    }
    std::sort(order.begin(), order.end());
    for (std::size_t k = 0; k < order.size(); ++k) {
      (*component)[k] = order[k].second;
    }
  }

  // Finds which of a component are believed. Returns false if told to stop.
  bool ChooseIn(std::vector<std::size_t>& component,
                const ShouldStop& should_stop) {
    if (!choosing_) {
      SortByTrust(&component);
      std::map<std::size_t, std::size_t> places;
      for (std::size_t k = 0; k < component.size(); ++k) {
        places[component[k]] = k;
      }
      ConsistencyGraph graph(component.size(), /*agreeing=*/true);
      for (std::size_t k = 0; k < component.size(); ++k) {
        for (const std::size_t j : contradicted_by_[component[k]]) {
          if (const auto other = places.find(j); other != places.end()) {
            graph.SetAgree(k, other->second, false);
          }
        }
      }
      choosing_.emplace(std::move(graph), kComponentSteps);
    }
    if (!choosing_->Run(should_stop)) return false;
    for (const std::size_t i : component) believed_[i] = 0;
    for (const std::size_t k : choosing_->best().members) {
      believed_[component[k]] = 1;
    }
    choosing_.reset();
    return true;
  }

  // The closures that are believed on one side of closure i: the nearest along
  // the path at both ends, of which the farthest comes first.
  std::vector<std::size_t> Given(std::size_t i, bool behind) const {
    std::vector<std::pair<double, std::size_t>> ways;
    for (std::size_t k = 1; k <= kReach; ++k) {
      if (behind ? i + k >= closures_.size() : k > i) break;
      const std::size_t j = behind ? i + k : i - k;
      if (!believed_[j] || !AreCompared(closures_[i], closures_[j])) continue;
      ways.emplace_back(Way(i, j), k);
    }
    std::sort(ways.begin(), ways.end());
    ways.resize(std::min(ways.size(), kGivenOnEachSide));
    std::vector<std::size_t> given;
    for (const auto& [way, k] : ways) given.push_back(k);
    std::sort(given.rbegin(), given.rend());
    for (std::size_t& k : given) k = behind ? i + k : i - k;
    return given;
  }

  // The estimate of closure i by the given ones, taken one after the other;
  // nothing where none is given.
  std::optional<Estimate> Predict(std::size_t i,
                                  const std::vector<std::size_t>& given) const {
    if (given.empty()) return std::nullopt;
    Estimate estimate = closures_[given[0]].z;
    for (std::size_t k = 1; k < given.size(); ++k) {
      const Closure& at = closures_[given[k]];
      estimate = Fused<D>(
          at.z, CarriedAlong<D>(estimate, closures_[given[k - 1]], at));
    }
    return CarriedAlong<D>(estimate, closures_[given.back()], closures_[i]);
  }

  double Way(std::size_t i, std::size_t j) const {
    const Closure& a = closures_[i];
    const Closure& b = closures_[j];
    return std::abs(a.query.meters - b.query.meters) +
           std::abs(a.matched.meters - b.matched.meters);
  }

  // The estimate of closure i by those that are believed; nothing where there
  // are none. The two sides are independent where their ways to the matched
  // pose have nothing in common; otherwise the nearer one counts.
  std::optional<Estimate> PredictByBoth(std::size_t i) const {
    const std::vector<std::size_t> before = Given(i, /*behind=*/false);
    const std::vector<std::size_t> behind = Given(i, /*behind=*/true);
    if (before.empty()) return Predict(i, behind);
    if (behind.empty()) return Predict(i, before);
    const double at = closures_[i].matched.meters;
    if ((closures_[before.back()].matched.meters - at) *
            (closures_[behind.back()].matched.meters - at) <=
        0.0) {
      return Fused<D>(*Predict(i, before), *Predict(i, behind));
    }
    return Predict(
        i, Way(i, before.back()) <= Way(i, behind.back()) ? before : behind);
  }

  // How many others near it that are not believed either tell the same.
  std::size_t Supporters(std::size_t i) const {
    std::size_t supporters = 0;
    const std::size_t end = std::min(closures_.size(), i + kReach + 1);
    for (std::size_t j = i < kReach ? 0 : i - kReach; j < end; ++j) {
      if (j == i || believed_[j] || !AreCompared(closures_[i], closures_[j]) ||
          Way(i, j) > kSupportMeters) {
        continue;
      }
      const std::vector<std::size_t>& against = contradicted_by_[i];
      supporters +=
          std::find(against.begin(), against.end(), j) == against.end();
    }
    return supporters;
  }

  void Judge(std::size_t i) {
    const std::optional<Estimate> predicted = PredictByBoth(i);
    if (!predicted) return;
    const std::optional<double> squared =
        SquaredDistance<D>(closures_[i].z, *predicted);
    if (!squared) return;
    const double p_value = ChiSquaredAbove(D, *squared);
    const auto told =
        static_cast<double>(1 + std::min(Supporters(i), kMostSupporters));
    // Written so that NaN is no suspect.
    if (!(p_value < std::pow(kSuspectProbability, told))) return;
    named_[closures_[i].number].p_value = p_value;
    found_.push_back(closures_[i].number);
  }

  void Finish() {
    std::sort(found_.begin(), found_.end());
    for (const std::size_t number : found_) suspects.push_back(named_[number]);
    done = true;
  }

  const double threshold_;
  // The judged closures by name, in the order in which they came.
  std::vector<Suspect> named_;
  // The same along the path of their queries.
  std::vector<Closure> closures_;
  std::vector<std::vector<std::size_t>> contradicted_by_;
  std::vector<char> believed_;
  // How far the search has come.
  std::size_t compared_ = 0;
  bool has_components_ = false;
  std::vector<std::vector<std::size_t>> components_;
  // The search in the last of the components.
  std::optional<ConsistentSetSearch> choosing_;
  std::size_t judged_ = 0;
  std::vector<std::size_t> found_;
};

SuspectSearch::SuspectSearch(const Drive& drive) {
  if (drive.settings().state_space == StateSpace::kPlanar) {
    impl_ = std::make_unique<ImplIn<3>>(drive);
  } else {
    impl_ = std::make_unique<ImplIn<4>>(drive);
  }
}

SuspectSearch::~SuspectSearch() = default;
SuspectSearch::SuspectSearch(SuspectSearch&&) noexcept = default;
SuspectSearch& SuspectSearch::operator=(SuspectSearch&&) noexcept = default;

bool SuspectSearch::Run(const ShouldStop& should_stop) {
  return impl_->Run(should_stop);
}

const std::vector<Suspect>& SuspectSearch::suspects() const {
  assert(impl_->done);
  return impl_->suspects;
}

std::vector<Suspect> FindSuspects(const Drive& drive) {
  SuspectSearch search(drive);
  search.Run(nullptr);
  return search.suspects();
}

}  // namespace revisit::core
