#include "core/search/candidates/value.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <memory>
#include <optional>
#include <vector>

#include "core/drive/confirmed_loop.h"
#include "core/drive/drive.h"
#include "core/drive/node_range.h"
#include "core/drive/pose_graph.h"
#include "core/drive/recordings.h"
#include "core/geometry/quadratic_form.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/dead_reckoning.h"
#include "core/noise/similarity_model.h"
#include "core/search/alignment/known_drift.h"

namespace revisit::core {

// The nodes over which the mean is taken, in their order: their places, and the
// rows of x and y of their covariances, scaled. Each in a column of its own, so
// that the reductions of several nodes are found at once.
struct VarianceReductions::MeanNodes {
  static constexpr NodeIndex kMost = 256;
  using Column = std::array<double, kMost>;

  std::vector<NodeIndex> indices;
  Column x;
  Column y;
  // By the coordinate of the state.
  std::array<Column, 4> of_x;
  std::array<Column, 4> of_y;
};

namespace {

using MeanNodes = VarianceReductions::MeanNodes;

// Two poses whose errors' difference, e_query - e_matched, is shown up to the
// tolerance.
template <int D>
struct ShownPair {
  LoopEnd<D> query;
  LoopEnd<D> matched;
  StateMatrix<D> tolerance = StateMatrix<D>::Zero();
};

// The closures that count, and the pair that is asked about, which comes last.
constexpr std::size_t kMostPairs = 3;

// Poses of one index follow each other as their errors grow.
template <int D>
bool ComesBefore(const LoopEnd<D>& a, const LoopEnd<D>& b) {
  return a.index != b.index
             ? a.index < b.index
             : a.covariance(D - 1, D - 1) < b.covariance(D - 1, D - 1);
}

// Cov(e_a, e_b).
template <int D>
StateMatrix<D> CrossOf(const LoopEnd<D>& a, const LoopEnd<D>& b) {
  if (ComesBefore(b, a)) {
    return DeadReckoningTransition<D>(b.pose, a.pose) * b.covariance;
  }
  return a.covariance * DeadReckoningTransition<D>(a.pose, b.pose).transpose();
}

// The covariance of the differences of two pairs.
template <int D>
StateMatrix<D> CrossOf(const ShownPair<D>& a, const ShownPair<D>& b) {
  return CrossOf(a.query, b.query) - CrossOf(a.query, b.matched) -
         CrossOf(a.matched, b.query) + CrossOf(a.matched, b.matched);
}

// The confirmed closures that are nearest to the query along the path, within
// its recording.
std::vector<const ConfirmedLoop*> NearestClosures(const Drive& drive,
                                                  NodeIndex query) {
  const Recordings& recordings = drive.recordings();
  const NodeRange nodes =
      recordings.NodesOf(recordings.Of(query), drive.graph().size());
  const auto is_within = [&](const ConfirmedLoop& loop) {
    return nodes.first <= std::min(loop.query, loop.matched) &&
           std::max(loop.query, loop.matched) < nodes.last;
  };
  const ConfirmedLoop* last = nullptr;
  const ConfirmedLoop* next = nullptr;
  NodeIndex last_end = 0;
  NodeIndex next_end = 0;
  for (const ConfirmedPair& pair : drive.confirmed()) {
    const NodeIndex end = std::max(pair.loop.query, pair.loop.matched);
    if (!is_within(pair.loop)) continue;
    if (end <= query && (last == nullptr || end >= last_end)) {
      last = &pair.loop;
      last_end = end;
    } else if (end > query && (next == nullptr || end < next_end)) {
      next = &pair.loop;
      next_end = end;
    }
  }
  std::vector<const ConfirmedLoop*> nearest;
  if (last != nullptr) nearest.push_back(last);
  if (next != nullptr) nearest.push_back(next);
  return nearest;
}

template <int D>
class PositionVariance {
 public:
  PositionVariance(const Drive& drive, double inflation,
                   const MeanNodes& mean_nodes)
      : drive_(drive),
        graph_(drive.graph()),
        variance_scale_(inflation * inflation),
        mean_nodes_(mean_nodes) {}

  // Nothing where the formula does not hold.
  std::optional<double> ReducedBy(
      NodeIndex query, NodeIndex matched,
      const std::vector<const ConfirmedLoop*>& closures, bool measured) {
    for (const ConfirmedLoop* closure : closures) {
      AddPair(measured && closure->measured != nullptr
                  ? MeasuredPair(*closure)
                  : NodePair(closure->query, closure->matched));
    }
    AddPair(NodePair(query, matched));
    if (!GrowOneAfterTheOther() || !Solve()) return std::nullopt;
    origin_ = graph_.pose(query);
    SumWeights();
    return Mean(drive_.recordings().NodesOf(drive_.recordings().Of(query),
                                            graph_.size()));
  }

 private:
  // An end with its weight: X_i is the sum of S_i,end times the weight.
  struct WeighedEnd {
    LoopEnd<D> end;
    StateMatrix<D> weight = StateMatrix<D>::Zero();
  };
  using Row = Eigen::Matrix<double, 1, D>;
  using Entries = std::array<double, D>;
  // The sums over ends that X_i is made of for nodes between two ends, with x
  // and y counted from the origin. Of those at or behind the node, with W the
  // weights and l the levers J p_end: the sums of W and of l^T W; of those
  // before it, with C = S_end W: the sums of the rows of C in x and y, less the
  // swing about the end, and of its row of heading.
  struct EndSums {
    StateMatrix<D> behind = StateMatrix<D>::Zero();
    Row behind_lever = Row::Zero();
    Row before_x = Row::Zero();
    Row before_y = Row::Zero();
    Row before_heading = Row::Zero();
  };

  void AddPair(const ShownPair<D>& pair) { pairs_[count_++] = pair; }

  LoopEnd<D> Scaled(LoopEnd<D> end) const {
    end.covariance *= variance_scale_;
    return end;
  }
  ShownPair<D> NodePair(NodeIndex query, NodeIndex matched) const {
    ShownPair<D> pair;
    pair.query = Scaled(EndAt<D>(graph_, query));
    pair.matched = Scaled(EndAt<D>(graph_, matched));
    AddTolerance<D>(kConfirmedTolerance, &pair.tolerance);
    return pair;
  }
  ShownPair<D> MeasuredPair(const ConfirmedLoop& loop) const {
    const MeasuredLoop& measured = *loop.measured;
    const PoseEstimate carried = CarriedToQuery<D>(measured);
    ShownPair<D> pair;
    pair.query = Scaled({loop.query, measured.query.pose,
                         ToMatrix<D>(measured.query.covariance)});
    pair.matched =
        Scaled({loop.matched, carried.pose, ToMatrix<D>(carried.covariance)});
    pair.tolerance = MeasurementCovariance<D>(measured);
    return pair;
  }

  // Whether the errors at the ends, in their order, can be those of dead
  // reckoning.
  bool GrowOneAfterTheOther() {
    for (std::size_t k = 0; k < count_; ++k) {
      ends_[2 * k].end = pairs_[k].query;
      ends_[2 * k + 1].end = pairs_[k].matched;
    }
    for (std::size_t k = 0; k < 2 * count_; ++k) order_[k] = k;
    std::stable_sort(order_.begin(),
                     order_.begin() + static_cast<std::ptrdiff_t>(2 * count_),
                     [this](std::size_t a, std::size_t b) {
                       return ComesBefore(ends_[a].end, ends_[b].end);
                     });
    StateMatrix<D> tolerance = StateMatrix<D>::Zero();
    AddTolerance<D>(kConfirmedTolerance, &tolerance);
    for (std::size_t k = 1; k < 2 * count_; ++k) {
      const LoopEnd<D>& later = ends_[order_[k]].end;
      const LoopEnd<D>& earlier = ends_[order_[k - 1]].end;
      const StateMatrix<D> grown =
          later.covariance -
          Swung<D>(earlier.covariance, earlier.pose, later.pose) + tolerance;
      if (!IsPositiveDefinite<D>(grown)) return false;
    }
    return true;
  }

  // Finds what is left of the last pair's difference once those of the others
  // are known, z_n - sum of F_k z_k: its information, and the weights of all
  // ends in it. The pairs become independent one after the other.
  bool Solve() {
    std::array<std::array<StateMatrix<D>, kMostPairs>, kMostPairs> cross;
    for (std::size_t a = 0; a < count_; ++a) {
      for (std::size_t b = 0; b < count_; ++b) {
        cross[a][b] = CrossOf(pairs_[a], pairs_[b]);
      }
      cross[a][a] += pairs_[a].tolerance;
    }
    // The rows of a unit lower triangular matrix of blocks: row a has what is
    // left of z_a in terms of the differences as they were.
    std::array<std::array<StateMatrix<D>, kMostPairs>, kMostPairs> left;
    for (std::size_t a = 0; a < count_; ++a) {
      for (std::size_t b = 0; b < count_; ++b) left[a][b].setZero();
      left[a][a].setIdentity();
    }
    const std::size_t last = count_ - 1;
    for (std::size_t k = 0; k < count_; ++k) {
      const StateMatrix<D> covariance = Symmetric<D>(cross[k][k]);
      if (!IsPositiveDefinite<D>(covariance)) return false;
      const StateMatrix<D> information = Eigen::LDLT<StateMatrix<D>>(covariance)
                                             .solve(StateMatrix<D>::Identity());
      if (k == last) {
        information_ = information;
        break;
      }
      for (std::size_t a = k + 1; a < count_; ++a) {
        const StateMatrix<D> gain = cross[a][k] * information;
        for (std::size_t b = k + 1; b < count_; ++b) {
          cross[a][b] -= gain * cross[k][b];
        }
        for (std::size_t b = 0; b < count_; ++b) {
          left[a][b] -= gain * left[k][b];
        }
      }
    }
    for (std::size_t k = 0; k < count_; ++k) {
      ends_[2 * k].weight = left[last][k].transpose();
      ends_[2 * k + 1].weight = -left[last][k].transpose();
    }
    return true;
  }

  void SumWeights() {
    for (std::size_t first = 0; first <= 2 * count_; ++first) {
      EndSums& sums = sums_[first];
      sums = EndSums();
      for (std::size_t k = 0; k < 2 * count_; ++k) {
        const WeighedEnd& weighed = ends_[order_[k]];
        const double x = weighed.end.pose.x - origin_.x;
        const double y = weighed.end.pose.y - origin_.y;
        if (k >= first) {
          sums.behind += weighed.weight;
          sums.behind_lever +=
              x * weighed.weight.row(1) - y * weighed.weight.row(0);
        } else {
          const StateMatrix<D> carried =
              weighed.end.covariance * weighed.weight;
          sums.before_x += carried.row(0) + y * carried.row(D - 1);
          sums.before_y += carried.row(1) - x * carried.row(D - 1);
          sums.before_heading += carried.row(D - 1);
        }
      }
    }
  }

  std::optional<double> Mean(const NodeRange& nodes) const {
    const std::vector<NodeIndex>& taken = mean_nodes_.indices;
    const auto place = [&taken](auto found) {
      return static_cast<std::size_t>(found - taken.begin());
    };
    std::size_t k =
        place(std::lower_bound(taken.begin(), taken.end(), nodes.first));
    const std::size_t last =
        place(std::lower_bound(taken.begin(), taken.end(), nodes.last));
    double sum = 0.0;
    for (std::size_t first = 0; k < last; ++first) {
      std::size_t end = last;
      if (first < 2 * count_) {
        end = std::min(last,
                       place(std::upper_bound(taken.begin(), taken.end(),
                                              ends_[order_[first]].end.index)));
      }
      if (end <= k) continue;
      sum = AddReductions(k, end, sums_[first], sum);
      k = end;
    }
    if (!std::isfinite(sum)) return std::nullopt;
    return sum / static_cast<double>(taken.size());
  }

  // Adds g_i of the nodes [begin, end) of those that the mean is taken over,
  // before which the same ends lie.
  double AddReductions(std::size_t begin, std::size_t end, const EndSums& sums,
                       double sum) const {
    std::array<double, MeanNodes::kMost> reductions;
    for (std::size_t k = begin; k < end; ++k) {
      reductions[k - begin] = ReductionAt(k, sums);
    }
    for (std::size_t k = begin; k < end; ++k) sum += reductions[k - begin];
    return sum;
  }

  // The product of a row and column c of a matrix. This and SquareOf() add in
  // the order in which Eigen's products of such rows do, so that values are the
  // same to the last bit as before there were columns.
  static double Product(const Entries& row, const StateMatrix<D>& matrix,
                        int c) {
    if constexpr (D == 3) {
      return row[0] * matrix(0, c) +
             (row[1] * matrix(1, c) + row[2] * matrix(2, c));
    } else {
      return (row[0] * matrix(0, c) + row[1] * matrix(1, c)) +
             (row[2] * matrix(2, c) + row[3] * matrix(3, c));
    }
  }
  // v M v^T, with M the information.
  double SquareOf(const Entries& v) const {
    const auto term = [&](int r, int c) {
      return v[static_cast<std::size_t>(r)] * information_(r, c);
    };
    if constexpr (D == 3) {
      const auto part = [&](int c) {
        return (term(0, c) + term(1, c) + term(2, c)) *
               v[static_cast<std::size_t>(c)];
      };
      return part(0) + part(1) + part(2);
    } else {
      const auto part = [&](int c) {
        return ((term(0, c) + term(2, c)) + (term(1, c) + term(3, c))) *
               v[static_cast<std::size_t>(c)];
      };
      return (part(0) + part(2)) + (part(1) + part(3));
    }
  }

  double ReductionAt(std::size_t k, const EndSums& sums) const {
    const double x = mean_nodes_.x[k] - origin_.x;
    const double y = mean_nodes_.y[k] - origin_.y;
    Entries s_x;
    Entries s_y;
    for (std::size_t c = 0; c < D; ++c) {
      s_x[c] = mean_nodes_.of_x[c][k];
      s_y[c] = mean_nodes_.of_y[c][k];
    }
    Entries of_x;
    Entries of_y;
    for (int c = 0; c < D; ++c) {
      const double lever = sums.behind_lever(c) -
                           (x * sums.behind(1, c) - y * sums.behind(0, c));
      of_x[static_cast<std::size_t>(c)] =
          Product(s_x, sums.behind, c) + s_x[D - 1] * lever + sums.before_x(c) -
          y * sums.before_heading(c);
      of_y[static_cast<std::size_t>(c)] =
          Product(s_y, sums.behind, c) + s_y[D - 1] * lever + sums.before_y(c) +
          x * sums.before_heading(c);
    }
    const double reduction = SquareOf(of_x) + SquareOf(of_y);
    // A node whose covariance is none of the chain's loses no more than it has.
    return std::min(reduction, s_x[0] + s_y[1]);
  }

  const Drive& drive_;
  const PoseGraph& graph_;
  const double variance_scale_;
  const MeanNodes& mean_nodes_;
  std::array<ShownPair<D>, kMostPairs> pairs_;
  std::size_t count_ = 0;
  // Both ends of each pair, and their order along the path.
  std::array<WeighedEnd, 2 * kMostPairs> ends_;
  std::array<std::size_t, 2 * kMostPairs> order_{};
  // By the number of ends before a node.
  std::array<EndSums, 2 * kMostPairs + 1> sums_;
  StateMatrix<D> information_ = StateMatrix<D>::Zero();
  Pose origin_;
};

template <int D>
void ReadNodes(const PoseGraph& graph, double inflation, MeanNodes* nodes) {
  const double variance_scale = inflation * inflation;
  const NodeIndex size = graph.size();
  const NodeIndex taken = std::min(MeanNodes::kMost, size);
  for (NodeIndex k = 0; k < taken; ++k) {
    const NodeIndex i = ((2 * k + 1) * size) / (2 * taken);
    const auto at = static_cast<std::size_t>(k);
    nodes->indices.push_back(i);
    const Pose pose = graph.pose(i);
    nodes->x[at] = pose.x;
    nodes->y[at] = pose.y;
    const StateMatrix<D> s = variance_scale * ToMatrix<D>(graph.covariance(i));
    for (int c = 0; c < D; ++c) {
      nodes->of_x[static_cast<std::size_t>(c)][at] = s(0, c);
      nodes->of_y[static_cast<std::size_t>(c)][at] = s(1, c);
    }
  }
}

template <int D>
double ReductionIn(const Drive& drive, double inflation, const MeanNodes& nodes,
                   const std::vector<const ConfirmedLoop*>& closures,
                   NodeIndex query, NodeIndex matched) {
  for (const bool measured : {true, false}) {
    if (const auto reduction =
            PositionVariance<D>(drive, inflation, nodes)
                .ReducedBy(query, matched, closures, measured)) {
      return std::max(0.0, *reduction);
    }
  }
  return 0.0;
}

}  // namespace

VarianceReductions::VarianceReductions(const Drive& drive) : drive_(drive) {}

VarianceReductions::~VarianceReductions() = default;

double VarianceReductions::Of(NodeIndex query, NodeIndex matched) {
  const SimilarityModel model = drive_.SimilarityOf(drive_.settings().search);
  const Recordings& recordings = drive_.recordings();
  if (!model.correlation.noise().closures_show_drift ||
      recordings.Of(query) != recordings.Of(matched)) {
    return 0.0;
  }
  const bool is_planar = model.state_space == StateSpace::kPlanar;
  if (mean_nodes_ == nullptr) {
    mean_nodes_ = std::make_unique<MeanNodes>();
    is_planar
        ? ReadNodes<3>(drive_.graph(), model.inflation, mean_nodes_.get())
        : ReadNodes<4>(drive_.graph(), model.inflation, mean_nodes_.get());
  }
  if (nearest_to_ != query) {
    nearest_ = NearestClosures(drive_, query);
    nearest_to_ = query;
  }
  return is_planar ? ReductionIn<3>(drive_, model.inflation, *mean_nodes_,
                                    nearest_, query, matched)
                   : ReductionIn<4>(drive_, model.inflation, *mean_nodes_,
                                    nearest_, query, matched);
}

}  // namespace revisit::core
