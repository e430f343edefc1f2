// Compares with what else a user could take to find loop-closure candidates
// among poses with covariances, on the same nodes, covariances and queries as
// revisit's drive: time of a query and quality of the first candidate.
#include <Eigen/Core>
#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <ctime>
#include <nanoflann.hpp>
#include <string>
#include <utility>
#include <vector>

#include "client/evaluation/evaluation.h"
#include "client/formats/drive_file.h"
#include "client/trajectory/dead_reckoning.h"
#include "core/drive/drive.h"
#include "core/drive/node_noise.h"
#include "core/drive/pose_graph.h"
#include "core/geometry/heading.h"
#include "core/geometry/pose.h"
#include "core/geometry/quadratic_form.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/similarity_model.h"
#include "core/search/alignment/log_similarity.h"
#include "core/search/candidates/gate.h"
#include "core/search/search.h"
#include "core/settings.h"
#include "tests/bench/peers/mrpt_association.h"

namespace revisit::bench {
namespace {

using client::CandidateAnswer;
using client::CheckAnswer;
using client::GraphNode;
using core::NodeIndex;

constexpr double kGateProbability = 0.95;
// Quantile of chi-square with two degrees of freedom.
const double kPlanarQuantile = -2.0 * std::log(1.0 - kGateProbability);
constexpr double kFixedRadius = 15.0;

// Queries, and what lies before each.
struct Searched {
  const core::PoseGraph& graph;
  std::vector<NodeIndex> queries;
  // Recent nodes that are no history.
  NodeIndex excluded;

  NodeIndex History(NodeIndex query) const {
    return std::max<NodeIndex>(0, query - excluded + 1);
  }
};

// Processor time of this thread, which other work on the machine does not
// change much.
double ThreadMilliseconds() {
  timespec now{};
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
  return 1e3 * static_cast<double>(now.tv_sec) +
         1e-6 * static_cast<double>(now.tv_nsec);
}

template <typename Function>
double MillisecondsOf(const Function& function) {
  const double start = ThreadMilliseconds();
  function();
  return ThreadMilliseconds() - start;
}

// A candidate as peers know it.
CheckAnswer Only(NodeIndex query, std::optional<NodeIndex> matched) {
  CheckAnswer answer;
  answer.query = query;
  if (!matched) {
    answer.empty_reason = "nothing associated";
    return answer;
  }
  CandidateAnswer candidate;
  candidate.matched = *matched;
  candidate.verdict = v1::VERDICT_ACCEPTED;
  answer.candidates.push_back(candidate);
  return answer;
}

v1::Verdict VerdictOf(core::Verdict verdict) {
  switch (verdict) {
    case core::Verdict::kAccepted:
      return v1::VERDICT_ACCEPTED;
    case core::Verdict::kRejectedByGate:
      return v1::VERDICT_REJECTED_BY_GATE;
    case core::Verdict::kRejectedByShape:
      return v1::VERDICT_REJECTED_BY_SHAPE;
    case core::Verdict::kAmbiguous:
      return v1::VERDICT_AMBIGUOUS;
    case core::Verdict::kUninformative:
      return v1::VERDICT_UNINFORMATIVE;
    case core::Verdict::kIllConditioned:
      break;
  }
  return v1::VERDICT_ILL_CONDITIONED;
}

CheckAnswer AnswerOf(const core::CandidateSet& set, NodeIndex query,
                     NodeIndex excluded) {
  CheckAnswer answer;
  answer.query = query;
  for (const core::Candidate& candidate : set.candidates) {
    if (candidate.matched > query - excluded) continue;
    CandidateAnswer given;
    given.matched = candidate.matched;
    given.verdict = VerdictOf(candidate.verdict);
    answer.candidates.push_back(given);
  }
  return answer;
}

// ---- nanoflann

struct Positions {
  std::vector<Eigen::Vector2d> points;

  std::size_t kdtree_get_point_count() const { return points.size(); }
  double kdtree_get_pt(std::size_t i, std::size_t d) const {
    return points[i](static_cast<Eigen::Index>(d));
  }
  template <typename Box>
  bool kdtree_get_bbox(Box&) const {
    return false;
  }
};

class PositionTree {
 public:
  explicit PositionTree(const core::PoseGraph& graph) : graph_(graph) {}

  // As the history grows.
  void GrowTo(NodeIndex count) {
    const std::size_t before = positions_.points.size();
    for (auto i = static_cast<NodeIndex>(before); i < count; ++i) {
      const core::Pose pose = graph_.node(i).pose;
      positions_.points.emplace_back(pose.x, pose.y);
    }
    if (positions_.points.size() > before) {
      tree_.addPoints(before, positions_.points.size() - 1);
    }
  }

  std::optional<NodeIndex> Nearest(const core::Pose& pose,
                                   double radius) const {
    std::vector<std::pair<std::size_t, double>> found;
    nanoflann::RadiusResultSet<double, std::size_t> result(radius * radius,
                                                           found);
    const double point[] = {pose.x, pose.y};
    tree_.findNeighbors(result, point, nanoflann::SearchParams());
    if (found.empty()) return std::nullopt;
    const auto nearest = std::min_element(
        found.begin(), found.end(),
        [](const auto& a, const auto& b) { return a.second < b.second; });
    return static_cast<NodeIndex>(nearest->first);
  }

 private:
  using Tree = nanoflann::KDTreeSingleIndexDynamicAdaptor<
      nanoflann::L2_Simple_Adaptor<double, Positions>, Positions, 2,
      std::size_t>;

  const core::PoseGraph& graph_;
  Positions positions_;
  Tree tree_{2, positions_};
};

// Within which a pose may err.
double GateRadius(const core::Covariance& covariance) {
  const core::PlaceTolerance tolerance;
  Eigen::Matrix2d position;
  position << covariance(0, 0), covariance(0, 1), covariance(1, 0),
      covariance(1, 1);
  position.diagonal().array() +=
      tolerance.position_meters * tolerance.position_meters;
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix2d> solver(
      position, Eigen::EigenvaluesOnly);
  return std::sqrt(kPlanarQuantile * solver.eigenvalues()(1));
}

// ---- MRPT

// Every fifth node of history, 10 m apart: MRPT fills a dense matrix of the
// square of their number, and neighbours of one place shall not count as
// rivals.
constexpr NodeIndex kStride = 5;

// One observation, the query, and history as predictions: differences in (x, y,
// heading) with the covariance that revisit gives them.
std::optional<NodeIndex> NearestByMrpt(const Searched& searched,
                                       NodeIndex query,
                                       AssociationMetric metric) {
  const NodeIndex count = searched.History(query);
  if (count == 0) return std::nullopt;
  const core::SimilarityModel model;
  std::vector<NodeIndex> predictions;
  std::vector<double> differences;
  std::vector<double> covariances;
  const core::Pose here = searched.graph.node(query).pose;
  core::VisitDifferenceCovariances<3>(
      searched.graph, model.correlation, query, count,
      [&](NodeIndex i, const core::StateMatrix<3>& gamma) {
        if (i % kStride != 0) return;
        predictions.push_back(i);
        const core::StateVector<3> d = core::ToVector<3>(
            core::Difference(searched.graph.node(i).pose, here));
        const core::StateMatrix<3> sum =
            core::ToleratedCovariance<3>(model, gamma);
        differences.insert(differences.end(), d.data(), d.data() + 3);
        covariances.insert(covariances.end(), sum.data(), sum.data() + 9);
      });
  const std::optional<std::size_t> found =
      AssociateNearest<3>(differences, covariances, metric, kGateProbability);
  if (!found) return std::nullopt;
  return predictions[*found];
}

// Poses of the recent path that are observed: the end, and these nodes before
// it.
constexpr NodeIndex kObservedBefore[] = {0, 25, 50};
// Branch and bound grows with the power of its observations: more predictions
// than these for each observation are left out, the least likely first.
constexpr std::size_t kMostForEach = 40;
struct JointResult {
  std::optional<NodeIndex> matched;
  // Predictions that passed the gate alone and were left out all the same.
  bool thinned = false;
  std::size_t nodes_explored = 0;
};

JointResult JointByMrpt(const Searched& searched, NodeIndex query) {
  JointResult result;
  const core::PoseGraph& graph = searched.graph;
  const core::SimilarityModel model;
  const core::Gate gate(core::StateSpace::kPlanar, kGateProbability);
  const core::Pose here = graph.node(query).pose;
  // Headings as seen from the query's: what differs from it by half a turn is
  // no rival, and nothing else needs wrapping.
  const auto add = [&](const core::Pose& pose, std::vector<double>* states) {
    states->insert(states->end(),
                   {pose.x, pose.y, core::Difference(pose, here).heading});
  };
  std::vector<NodeIndex> kept;
  std::vector<double> observations;
  for (const NodeIndex before : kObservedBefore) {
    const NodeIndex observed = query - before;
    if (observed < 0) return result;
    const core::Pose pose = graph.node(observed).pose;
    add(pose, &observations);
    std::vector<std::pair<double, NodeIndex>> compatible;
    for (NodeIndex i = 0; i < searched.History(query); i += kStride) {
      const core::StateVector<3> d =
          core::ToVector<3>(core::Difference(pose, graph.node(i).pose));
      const auto terms = core::Evaluate<3>(
          core::ToleratedCovariance<3>(
              model, core::DifferenceCovariance<3>(graph, model.correlation,
                                                   observed, i)),
          d);
      if (terms && terms->squared_mahalanobis <= gate.threshold()) {
        compatible.emplace_back(terms->squared_mahalanobis, i);
      }
    }
    std::sort(compatible.begin(), compatible.end());
    if (compatible.size() > kMostForEach) {
      compatible.resize(kMostForEach);
      result.thinned = true;
    }
    for (const auto& entry : compatible) kept.push_back(entry.second);
  }
  std::sort(kept.begin(), kept.end());
  kept.erase(std::unique(kept.begin(), kept.end()), kept.end());
  if (kept.empty()) return result;

  // Errors of history against that of the end, which the recent path shares.
  using Block = core::StateMatrix<3>;
  const auto cross = [&](NodeIndex i, NodeIndex j) -> Block {
    return core::CrossCovariance<3>(graph, model.correlation, i, j);
  };
  const auto size = static_cast<Eigen::Index>(3 * kept.size());
  Eigen::MatrixXd covariance(size, size);
  const Block end = cross(query, query);
  std::vector<Block> with_end;
  for (const NodeIndex i : kept) with_end.push_back(cross(i, query));
  std::vector<double> predictions;
  for (std::size_t a = 0; a < kept.size(); ++a) {
    add(graph.node(kept[a]).pose, &predictions);
    for (std::size_t b = 0; b <= a; ++b) {
      Block block =
          cross(kept[a], kept[b]) - with_end[a] - with_end[b].transpose() + end;
      if (a == b) core::AddTolerance<3>(model.tolerance, &block);
      const auto row = static_cast<Eigen::Index>(3 * a);
      const auto column = static_cast<Eigen::Index>(3 * b);
      covariance.block<3, 3>(row, column) = block;
      covariance.block<3, 3>(column, row) = block.transpose();
    }
  }
  const std::vector<double> entries(covariance.data(),
                                    covariance.data() + covariance.size());
  const JointAssociation joint =
      AssociateJointly(observations, predictions, entries, kGateProbability);
  result.nodes_explored = joint.nodes_explored;
  const bool all =
      std::all_of(joint.predictions.begin(), joint.predictions.end(),
                  [](const auto& p) { return p.has_value(); });
  if (all) result.matched = kept[*joint.predictions.front()];
  return result;
}

// ---- The table

struct Method {
  const char* name;
  std::vector<CheckAnswer> answers;
  std::vector<double> milliseconds;
  std::string note;
};

std::string Share(std::optional<double> value) {
  if (!value) return "-";
  char text[16];
  std::snprintf(text, sizeof(text), "%.3f", *value);
  return text;
}

void Print(const Method& method, const client::Tally& tally) {
  std::vector<double> times = method.milliseconds;
  std::sort(times.begin(), times.end());
  const auto at = [&](double part) {
    return times.empty() ? 0.0
                         : times[static_cast<std::size_t>(
                               part * static_cast<double>(times.size() - 1))];
  };
  std::printf("%-34s%9.3f%9.3f%9lld%7lld%7s%7s%7s  %s\n", method.name, at(0.5),
              at(0.99), static_cast<long long>(tally.accepted),
              static_cast<long long>(tally.accepted_correct),
              Share(tally.precision()).c_str(), Share(tally.recall()).c_str(),
              Share(tally.f1()).c_str(), method.note.c_str());
}

struct Total {
  client::Tally tally;
  std::vector<double> milliseconds;
};

int Run(const std::vector<std::string>& files,
        client::UncertaintyOptions::Source source) {
  std::vector<Method> methods;
  std::vector<Total> totals;
  NodeIndex nodes_of_all = 0;
  for (const std::string& file : files) {
    const auto recorded = client::ReadDriveFile(file, client::ReaderOptions());
    if (!recorded.ok() || recorded->truth.empty()) {
      std::fprintf(stderr, "%s: %s\n", file.c_str(),
                   recorded.ok()
                       ? "no truth"
                       : std::string(recorded.status().message()).c_str());
      return 1;
    }
    client::UncertaintyOptions claimed;
    claimed.source = source;
    const auto uncertainty = client::ClaimUncertainty(*recorded, claimed);
    if (!uncertainty.ok()) {
      std::fprintf(stderr, "%s: %s\n", file.c_str(),
                   std::string(uncertainty.status().message()).c_str());
      return 1;
    }
    const client::Judging judging;
    core::DriveSettings settings;
    core::Drive drive(settings);
    core::SearchOptions composite = settings.search;
    composite.alignment = core::AlignmentKind::kComposite;
    Method relative{"revisit, relative (default)", {}, {}, ""};
    Method paper{"revisit, composite (the paper's)", {}, {}, ""};
    std::vector<NodeIndex> queries;
    for (std::size_t i = 0; i < recorded->samples.size(); ++i) {
      const client::PlanarPose& estimate = recorded->samples[i].estimate;
      core::PoseSample sample;
      sample.sequence = i + 1;
      sample.pose = {estimate.x, estimate.y, 0.0, estimate.heading};
      const auto& [xx, xy, xh, yy, yh, hh] = (*uncertainty)[i].planar;
      sample.covariance.upper = {xx, xy, 0.0, xh, yy, 0.0, yh, 0.0, 0.0, hh};
      const core::AppendResult result = drive.Append({sample}, i + 1);
      for (const NodeIndex query : result.checks_due) {
        queries.push_back(query);
        for (Method* const method : {&relative, &paper}) {
          method->milliseconds.push_back(MillisecondsOf([&] {
            const auto found = core::Search(&drive).At(
                query, method == &relative ? settings.search : composite,
                nullptr);
            method->answers.push_back(
                AnswerOf(*found, query, judging.excluded_nodes));
          }));
        }
      }
    }
    const core::PoseGraph& graph = drive.graph();
    const Searched searched{graph, queries, judging.excluded_nodes};
    Method near{"nanoflann, nearest within 15 m",
                {},
                {},
                "one number for any uncertainty"};
    Method gated{"nanoflann, nearest within own 95 %",
                 {},
                 {},
                 "radius of the query's covariance"};
    Method maha{"MRPT NN, Mahalanobis", {}, {}, "one pose; history at 10 m"};
    Method likely{
        "MRPT NN, matching likelihood", {}, {}, "one pose; history at 10 m"};
    Method joint{"MRPT JCBB, 3 poses over 100 m", {}, {}, ""};
    PositionTree tree(graph);
    double growing = 0.0;
    std::size_t thinned = 0;
    std::size_t explored = 0;
    for (const NodeIndex query : queries) {
      const core::Node node = graph.node(query);
      growing += MillisecondsOf([&] { tree.GrowTo(searched.History(query)); });
      near.milliseconds.push_back(MillisecondsOf([&] {
        near.answers.push_back(
            Only(query, tree.Nearest(node.pose, kFixedRadius)));
      }));
      gated.milliseconds.push_back(MillisecondsOf([&] {
        gated.answers.push_back(
            Only(query, tree.Nearest(node.pose, GateRadius(node.covariance))));
      }));
      maha.milliseconds.push_back(MillisecondsOf([&] {
        maha.answers.push_back(Only(
            query,
            NearestByMrpt(searched, query, AssociationMetric::kMahalanobis)));
      }));
      likely.milliseconds.push_back(MillisecondsOf([&] {
        likely.answers.push_back(
            Only(query, NearestByMrpt(searched, query,
                                      AssociationMetric::kMatchingLikelihood)));
      }));
      joint.milliseconds.push_back(MillisecondsOf([&] {
        const JointResult result = JointByMrpt(searched, query);
        thinned += result.thinned;
        explored = std::max(explored, result.nodes_explored);
        joint.answers.push_back(Only(query, result.matched));
      }));
    }
    joint.note = "history at 10 m; " + std::to_string(thinned) +
                 " queries cut to 40 predictions a pose; at most " +
                 std::to_string(explored) + " hypotheses";
    near.note +=
        "; " +
        std::to_string(growing / static_cast<double>(
                                     std::max<std::size_t>(queries.size(), 1)))
            .substr(0, 5) +
        " ms a query to grow the tree";

    std::vector<GraphNode> judged(static_cast<std::size_t>(graph.size()));
    for (NodeIndex i = 0; i < graph.size(); ++i) {
      const core::Node node = graph.node(i);
      GraphNode& to = judged[static_cast<std::size_t>(i)];
      to.sequence = node.sequence;
      to.fraction = node.fraction;
      to.travelled_meters = node.travelled_meters;
      to.estimate = {node.pose.x, node.pose.y, node.pose.heading};
    }
    const auto truth = client::TruthAtNodes(judged, recorded->truth);
    nodes_of_all += graph.size();
    methods = {relative, paper, near, gated, maha, likely, joint};
    totals.resize(methods.size());
    for (std::size_t m = 0; m < methods.size(); ++m) {
      const client::Tally tally = client::Count(
          client::Judge(judged, truth, methods[m].answers, judging));
      if (m == 0) {
        std::printf(
            "\n%s: %lld nodes, %lld checks, %lld true loops\n%-34s%9s%9s%9s"
            "%7s%7s%7s%7s\n",
            recorded->name.c_str(), static_cast<long long>(graph.size()),
            static_cast<long long>(tally.checks),
            static_cast<long long>(tally.true_loops), "", "ms p50", "ms p99",
            "accepted", "right", "P", "R", "F1");
      }
      Print(methods[m], tally);
      totals[m].tally.Add(tally);
      totals[m].milliseconds.insert(totals[m].milliseconds.end(),
                                    methods[m].milliseconds.begin(),
                                    methods[m].milliseconds.end());
    }
  }
  if (files.size() > 1) {
    std::printf("\nAll: %lld nodes, %lld checks, %lld true loops\n",
                static_cast<long long>(nodes_of_all),
                static_cast<long long>(totals[0].tally.checks),
                static_cast<long long>(totals[0].tally.true_loops));
    for (std::size_t m = 0; m < methods.size(); ++m) {
      methods[m].milliseconds = totals[m].milliseconds;
      methods[m].note.clear();
      Print(methods[m], totals[m].tally);
    }
  }
  return 0;
}

}  // namespace
}  // namespace revisit::bench

int main(int argc, char** argv) {
  using Source = revisit::client::UncertaintyOptions::Source;
  std::vector<std::string> files(argv + 1, argv + argc);
  Source source = Source::kModel;
  if (!files.empty() && files.front() == "--file-uncertainty") {
    source = Source::kFile;
    files.erase(files.begin());
  }
  if (files.empty()) {
    std::fprintf(
        stderr,
        "usage: revisit_peers_bench [--file-uncertainty] DRIVE.csv...\n"
        "Drives with truth, as for `revisit evaluate`; their "
        "covariances by its model, or those of the file.\n");
    return 64;
  }
  return revisit::bench::Run(files, source);
}
