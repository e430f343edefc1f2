#include "core/drive/frame_relation.h"

#include <gtest/gtest.h>

#include <Eigen/Core>
#include <Eigen/LU>
#include <cmath>
#include <memory>
#include <optional>
#include <random>
#include <vector>

#include "core/drive/frame_relations.h"
#include "core/drive/pose_graph.h"
#include "core/drive/recordings.h"
#include "core/geometry/frame_transform.h"
#include "core/geometry/heading.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/dead_reckoning.h"
#include "tests/core/graphs.h"
#include "tests/random.h"

namespace revisit::core {
namespace {

// Recordings of a few nodes each, with what each one's errors are made of, so
// that any covariance can be added up from independent errors: each is a column
// of a matrix, by the coordinates of the error that it causes.
class Chains {
 public:
  static constexpr int kNodes = 6;

  explicit Chains(std::mt19937_64& random, int recordings) {
    for (int k = 0; k < recordings; ++k) {
      StateMatrix<3> covariance = StateMatrix<3>::Identity() * 1e-3;
      Pose pose = Planar(random, 200.0);
      for (int i = 0; i < kNodes; ++i) {
        if (i > 0) {
          Pose next = Planar(random, 30.0);
          next.x += pose.x;
          next.y += pose.y;
          const StateMatrix<3> psi = DeadReckoningTransition<3>(pose, next);
          covariance = (psi * covariance * psi.transpose()).eval() +
                       Anything(random, 0.3);
          pose = next;
        }
        Node node;
        node.sequence = static_cast<std::uint64_t>(graph_.size()) + 1;
        node.travelled_meters = 30.0 * static_cast<double>(graph_.size());
        node.pose = pose;
        node.covariance = ToCovariance<3>(covariance);
        graph_.AddNode(node, i == 0, std::nullopt);
      }
    }
  }

  static StateMatrix<3> Anything(std::mt19937_64& random, double deviation) {
    StateMatrix<3> factor;
    for (int r = 0; r < 3; ++r) {
      for (int c = 0; c < 3; ++c) factor(r, c) = Normal(random, deviation);
    }
    factor.row(2) *= 0.02;
    return factor * factor.transpose() +
           StateVector<3>(1e-4, 1e-4, 1e-8).asDiagonal().toDenseMatrix();
  }
  static Pose Planar(std::mt19937_64& random, double meters) {
    return {Normal(random, meters), Normal(random, meters), 0.0,
            WrapHeading(Normal(random, 2.0))};
  }

  const PoseGraph& graph() const { return graph_; }
  FrameNodes nodes() const {
    return {graph_, StateSpace::kPlanar, CorrelationModel::kDeadReckoning};
  }
  static NodeIndex NodeOf(int recording, int i) {
    return static_cast<NodeIndex>(recording) * kNodes + i;
  }

 private:
  PoseGraph graph_;
};

StateMatrix<4> Wide(const StateMatrix<3>& matrix) {
  return ToMatrix<4>(ToCovariance<3>(matrix));
}

// A relation of two recordings at random nodes.
FrameRelation RandomRelation(std::mt19937_64& random, const Chains& chains,
                             int asking, int other) {
  FrameRelation relation;
  relation.state = FrameState::kDatum;
  relation.transform = Chains::Planar(random, 50.0);
  relation.fixed = Wide(Chains::Anything(random, 1.0));
  relation.asking_node =
      Chains::NodeOf(asking, UniformInt(random, 0, Chains::kNodes - 1));
  relation.other_node =
      Chains::NodeOf(other, UniformInt(random, 0, Chains::kNodes - 1));
  relation.place = chains.graph().pose(*relation.other_node);
  return relation;
}

// The relation of recordings that refers to nodes c and m, and by which node m
// lies at this pose.
FrameRelation RelationOf(const Chains& chains, NodeIndex c, NodeIndex m,
                         const Pose& matched) {
  FrameRelation relation;
  relation.state = FrameState::kDatum;
  relation.transform = Compose(matched, Inverse(chains.graph().pose(m)));
  relation.place = chains.graph().pose(m);
  relation.asking_node = c;
  relation.other_node = m;
  return relation;
}

// The error of node i in the frame of its recording, as a rigid motion of all
// that is seen from the reference: drawn step by step along the chain, away
// from the reference.
//
// A step from a to b along the chain has the noise N; seen from a, b errs by
// it, and all beyond b swings about b. Seen from b, a errs by its opposite.
StateMatrix<3> ErrorByWalking(const PoseGraph& graph, NodeIndex reference,
                              NodeIndex i) {
  StateMatrix<3> sum = StateMatrix<3>::Zero();
  const int way = i > reference ? 1 : -1;
  for (NodeIndex at = reference; at != i; at += way) {
    const NodeIndex next = at + way;
    const NodeIndex earlier = std::min(at, next);
    const NodeIndex later = std::max(at, next);
    const StateMatrix<3> psi =
        DeadReckoningTransition<3>(graph.pose(earlier), graph.pose(later));
    const StateMatrix<3> noise =
        ToMatrix<3>(graph.covariance(later)) -
        psi * ToMatrix<3>(graph.covariance(earlier)) * psi.transpose();
    // The noise is an error of the pose at `later` as seen from `earlier`; it
    // moves all on the far side as one rigid body, the near side of which, for
    // a walk back, is what moves the other way.
    const StateMatrix<3> lever =
        DeadReckoningTransition<3>(graph.pose(later), graph.pose(i));
    sum += lever * noise * lever.transpose();
  }
  return sum;
}

TEST(FrameRelationTest, GammaIsThatOfAllThatErrsBetweenTheTwoNodes) {
  std::mt19937_64 random = SeededRandom();
  for (int trial = 0; trial < 200; ++trial) {
    const Chains chains(random, 2);
    const PoseGraph& graph = chains.graph();
    const FrameRelation relation = RandomRelation(random, chains, 1, 0);
    const NodeIndex q =
        Chains::NodeOf(1, UniformInt(random, 0, Chains::kNodes - 1));
    const NodeIndex j =
        Chains::NodeOf(0, UniformInt(random, 0, Chains::kNodes - 1));
    const double scale = Uniform(random, 0.3, 3.0);
    const FramePair<3> pair(chains.nodes(), relation, q, scale);
    const StateMatrix<3> gamma =
        pair.Covariance(j, graph.pose(j), ToMatrix<3>(graph.covariance(j)));

    // In the axes of the asking frame.
    const StateMatrix<3> turn = TurnAbout<3>(relation.transform.heading);
    const Pose at = Compose(relation.transform, graph.pose(j));
    const Pose place = Compose(relation.transform, relation.place);
    const StateMatrix<3> lever = DeadReckoningTransition<3>(place, at);
    StateMatrix<3> fixed;
    fixed << relation.fixed(0, 0), relation.fixed(0, 1), relation.fixed(0, 3),
        relation.fixed(1, 0), relation.fixed(1, 1), relation.fixed(1, 3),
        relation.fixed(3, 0), relation.fixed(3, 1), relation.fixed(3, 3);
    const StateMatrix<3> wanted =
        lever * fixed * lever.transpose() +
        scale * scale *
            (ErrorByWalking(graph, *relation.asking_node, q) +
             turn * ErrorByWalking(graph, *relation.other_node, j) *
                 turn.transpose());
    const StateMatrix<3> actual = turn * gamma * turn.transpose();
    EXPECT_LT((actual - wanted).norm(), 1e-9 * wanted.norm()) << trial;
    const Pose query = Compose(relation.transform, pair.query());
    EXPECT_NEAR(query.x, graph.pose(q).x, 1e-9);
    EXPECT_NEAR(WrapHeading(query.heading - graph.pose(q).heading), 0.0, 1e-9);
  }
}

TEST(FrameRelationTest, SeenFromTheOtherSideItIsTheSame) {
  std::mt19937_64 random = SeededRandom();
  for (int trial = 0; trial < 100; ++trial) {
    const Chains chains(random, 2);
    const PoseGraph& graph = chains.graph();
    const FrameRelation relation = RandomRelation(random, chains, 1, 0);
    const FrameRelation back =
        Reversed(chains.nodes(), Reversed(chains.nodes(), relation));
    EXPECT_NEAR(back.transform.x, relation.transform.x, 1e-9);
    EXPECT_NEAR(back.place.x, relation.place.x, 1e-9);
    EXPECT_LT((back.fixed - relation.fixed).norm(),
              1e-9 * relation.fixed.norm());
    // Where the two nodes are at one place, so is Gamma.
    const NodeIndex q = *relation.asking_node;
    const NodeIndex j = *relation.other_node;
    FrameRelation together = relation;
    together.transform = Compose(graph.pose(q), Inverse(graph.pose(j)));
    const FramePair<3> there(chains.nodes(), together, q, 1.0);
    const FramePair<3> here(chains.nodes(), Reversed(chains.nodes(), together),
                            j, 1.0);
    const StateMatrix<3> turn = TurnAbout<3>(together.transform.heading);
    const StateMatrix<3> seen_there =
        there.Covariance(j, graph.pose(j), ToMatrix<3>(graph.covariance(j)));
    const StateMatrix<3> seen_here =
        here.Covariance(q, graph.pose(q), ToMatrix<3>(graph.covariance(q)));
    EXPECT_LT((turn * seen_there * turn.transpose() - seen_here).norm(),
              1e-9 * seen_here.norm());
  }
}

TEST(FrameRelationTest, AChainHasTheErrorsOfItsPartsAndOfWhatLiesBetween) {
  std::mt19937_64 random = SeededRandom();
  for (int trial = 0; trial < 100; ++trial) {
    const Chains chains(random, 3);
    const PoseGraph& graph = chains.graph();
    const FrameRelation to_v = RandomRelation(random, chains, 2, 1);
    const FrameRelation from_v = RandomRelation(random, chains, 1, 0);
    const FrameRelation chain = Compose(chains.nodes(), to_v, from_v);
    EXPECT_EQ(chain.asking_node, to_v.asking_node);
    EXPECT_EQ(chain.other_node, from_v.other_node);
    const Pose m = graph.pose(*from_v.other_node);
    const Pose at = Compose(to_v.transform, Compose(from_v.transform, m));
    EXPECT_NEAR(Compose(chain.transform, m).x, at.x, 1e-9);

    const auto reduced = [](const StateMatrix<4>& p) {
      return ToMatrix<3>(ToCovariance<4>(p));
    };
    const StateMatrix<3> turn = TurnAbout<3>(to_v.transform.heading);
    const Pose through = Compose(to_v.transform, to_v.place);
    const Pose out = Compose(to_v.transform, graph.pose(*from_v.asking_node));
    const StateMatrix<3> first = DeadReckoningTransition<3>(through, at);
    const StateMatrix<3> between = DeadReckoningTransition<3>(out, at);
    const StateMatrix<3> fixed =
        first * reduced(to_v.fixed) * first.transpose() +
        turn * reduced(from_v.fixed) * turn.transpose();
    const StateMatrix<3> drift =
        between * turn *
        ErrorByWalking(graph, *to_v.other_node, *from_v.asking_node) *
        turn.transpose() * between.transpose();
    EXPECT_LT((reduced(chain.fixed) - fixed).norm(), 1e-9 * fixed.norm());
    EXPECT_LT((reduced(chain.drift) - drift).norm(),
              1e-9 * (1.0 + drift.norm()));
  }
}

TEST(FrameRelationTest, AMeasuredClosureAloneIsTheRelation) {
  std::mt19937_64 random = SeededRandom();
  for (int trial = 0; trial < 100; ++trial) {
    const Chains chains(random, 2);
    const PoseGraph& graph = chains.graph();
    const NodeIndex c = Chains::NodeOf(1, 3);
    const NodeIndex m = Chains::NodeOf(0, 2);
    const auto measured = RandomMeasurement(random, EstimateAt(graph, c),
                                            EstimateAt(graph, m), 0.5);
    const FrameRelation tied =
        TiedBy(chains.nodes(), FrameRelation(), {c, m, measured}, 1.0);
    EXPECT_EQ(tied.state, FrameState::kProvisional);
    // The query lies where it was measured from the match.
    const Pose query = Compose(Compose(tied.transform, graph.pose(m)),
                               measured->measurement.relative);
    EXPECT_NEAR(query.x, graph.pose(c).x, 1e-9);
    EXPECT_NEAR(query.y, graph.pose(c).y, 1e-9);
    EXPECT_NEAR(WrapHeading(query.heading - graph.pose(c).heading), 0.0, 1e-9);
    // Errors of the measurement, one after the other, move the matched pose as
    // the covariance says.
    const Pose matched = Compose(tied.transform, graph.pose(m));
    StateMatrix<3> moves;
    constexpr double kStep = 1e-6;
    for (int k = 0; k < 3; ++k) {
      Pose relative = measured->measurement.relative;
      (k == 0 ? relative.x : k == 1 ? relative.y : relative.heading) -= kStep;
      const Pose moved = Compose(graph.pose(c), Inverse(relative));
      moves.col(k) = ToVector<3>(Difference(moved, matched)) / kStep;
    }
    const StateMatrix<3> wanted =
        moves * ToMatrix<3>(measured->measurement.covariance) *
        moves.transpose();
    EXPECT_LT((ToMatrix<3>(ToCovariance<4>(tied.fixed)) - wanted).norm(),
              1e-4 * wanted.norm());
  }
}

TEST(FrameRelationTest, AFurtherClosureIsWeighedAgainstWhatWasKnown) {
  std::mt19937_64 random = SeededRandom();
  const Chains chains(random, 2);
  const PoseGraph& graph = chains.graph();
  const NodeIndex c = Chains::NodeOf(1, 3);
  const NodeIndex m = Chains::NodeOf(0, 2);
  FrameRelation relation = RelationOf(chains, c, m, graph.pose(c));
  // The relation is as sure as the closure, which says that the two are 2 m
  // closer to each other in x.
  StateMatrix<3> p = StateMatrix<3>::Zero();
  p.diagonal() << 25.0, 25.0, 0.0225;
  relation.fixed = Wide(p);
  relation.transform.x += 2.0;
  const FrameRelation tied = TiedBy(chains.nodes(), relation, {c, m}, 1.0);
  EXPECT_EQ(tied.links, 1);
  EXPECT_NEAR(Compose(tied.transform, graph.pose(m)).x, graph.pose(c).x + 1.0,
              1e-9);
  EXPECT_NEAR(tied.fixed(0, 0), 12.5, 1e-9);
  EXPECT_NEAR(tied.fixed(3, 3), 0.01125, 1e-9);
  EXPECT_EQ(tied.drift.norm(), 0.0);
}

TEST(FrameRelationTest,
     APassTheOtherWayIsKnownOnlyWhereTheScaledHeadingIsSure) {
  std::mt19937_64 random = SeededRandom();
  const Chains chains(random, 2);
  const PoseGraph& graph = chains.graph();
  const NodeIndex c = Chains::NodeOf(1, 3);
  const NodeIndex m = Chains::NodeOf(0, 2);
  // The relation says that the two poses look in opposite directions.
  Pose matched = graph.pose(c);
  matched.heading = WrapHeading(matched.heading + kPi);
  FrameRelation relation = RelationOf(chains, c, m, matched);
  StateMatrix<3> p = StateMatrix<3>::Zero();
  p.diagonal() << 1.0, 1.0, 0.1;
  relation.fixed = Wide(p);
  relation.drift = Wide(p);
  const auto heading_off = [&](double drift_scale) {
    const Pose placed =
        Compose(TiedBy(chains.nodes(), relation, {c, m}, drift_scale).transform,
                graph.pose(m));
    return std::abs(WrapHeading(placed.heading - matched.heading));
  };
  EXPECT_NEAR(heading_off(1.0), 0.0, 1e-9);
  EXPECT_GT(heading_off(3.0), 0.5 * kPi);
}

TEST(FrameRelationTest, AClosureThatContradictsADatumReplacesIt) {
  std::mt19937_64 random = SeededRandom();
  const Chains chains(random, 2);
  const PoseGraph& graph = chains.graph();
  const NodeIndex c = Chains::NodeOf(1, 3);
  const NodeIndex m = Chains::NodeOf(0, 2);
  FrameRelation relation = RelationOf(chains, c, m, graph.pose(c));
  relation.fixed = Wide(StateMatrix<3>::Identity() * 0.01);
  relation.transform.x += 500.0;
  for (const FrameState state : {FrameState::kDatum, FrameState::kKnown}) {
    relation.state = state;
    const FrameRelation tied = TiedBy(chains.nodes(), relation, {c, m}, 1.0);
    const bool is_replaced = state == FrameState::kDatum;
    EXPECT_EQ(tied.state,
              is_replaced ? FrameState::kProvisional : FrameState::kKnown);
    EXPECT_NEAR(Compose(tied.transform, graph.pose(m)).x,
                graph.pose(c).x + (is_replaced ? 0.0 : 500.0), 1e-6);
  }
}

TEST(FrameRelationsTest, DatumsOfOneNameErrTogetherAndOthersByThemselves) {
  std::mt19937_64 random = SeededRandom();
  const Chains chains(random, 4);
  const auto datum = [&](const char* id, double deviation) {
    RecordingStart start;
    start.relation = RecordingRelation::kDatum;
    start.datum = Chains::Planar(random, 100.0);
    start.datum_id = id;
    start.covariance =
        ToCovariance<4>(StateMatrix<4>::Identity() * (deviation * deviation));
    return std::make_shared<const RecordingStart>(start);
  };
  Recordings recordings;
  recordings.Begin(1, 0, datum("site", 10.0), {});
  for (int k = 1; k < 4; ++k) {
    recordings.Begin(static_cast<std::uint64_t>(Chains::NodeOf(k, 0)) + 1,
                     Chains::NodeOf(k, 0), datum(k == 2 ? "site" : "", 10.0),
                     {});
  }
  const FrameRelations relations(chains.nodes(), recordings,
                                 chains.graph().size() - 1, {});
  const std::vector<FrameRelation> from = relations.From(2);
  ASSERT_EQ(relations.size(), 4u);
  EXPECT_EQ(from[2].state, FrameState::kSame);
  EXPECT_EQ(from[0].fixed.norm(), 0.0);
  EXPECT_EQ(from[0].state, FrameState::kDatum);
  // Two datums, in position at least.
  EXPECT_GE(from[1].fixed(0, 0), 200.0 - 1e-6);
  const Pose wanted =
      Compose(Inverse(recordings[2].start->datum), recordings[1].start->datum);
  EXPECT_NEAR(from[1].transform.x, wanted.x, 1e-9);
  EXPECT_NEAR(from[1].transform.y, wanted.y, 1e-9);
}

TEST(FrameRelationsTest, RecordingsOneAfterTheOtherAreTiedByTheirGaps) {
  std::mt19937_64 random = SeededRandom();
  const Chains chains(random, 4);
  Recordings recordings;
  for (int k = 1; k < 4; ++k) {
    RecordingStart start;
    start.relation =
        k == 3 ? RecordingRelation::kUnknown : RecordingRelation::kAfter;
    start.covariance = UsualGap();
    recordings.Begin(static_cast<std::uint64_t>(Chains::NodeOf(k, 0)) + 1,
                     Chains::NodeOf(k, 0),
                     std::make_shared<const RecordingStart>(start),
                     chains.graph().pose(Chains::NodeOf(k - 1, 5)));
  }
  const FrameRelations relations(chains.nodes(), recordings,
                                 chains.graph().size() - 1, {});
  const PoseGraph& graph = chains.graph();
  const std::vector<FrameRelation> from = relations.From(2);
  EXPECT_EQ(from[1].state, FrameState::kAfter);
  const Pose end = Compose(from[1].transform, graph.pose(Chains::NodeOf(1, 5)));
  EXPECT_NEAR(end.x, graph.pose(Chains::NodeOf(2, 0)).x, 1e-9);
  EXPECT_EQ(from[0].state, FrameState::kAfter);
  EXPECT_GT(from[0].drift.norm(), 0.0);
  EXPECT_EQ(from[3].state, FrameState::kNone);
  // A closure with the last one reaches all.
  const FrameRelations linked(
      chains.nodes(), recordings, graph.size() - 1,
      {{Chains::NodeOf(3, 2), Chains::NodeOf(0, 1), nullptr}});
  EXPECT_EQ(linked.From(3)[0].state, FrameState::kProvisional);
  EXPECT_EQ(linked.From(3)[2].state, FrameState::kAfter);
}

}  // namespace
}  // namespace revisit::core
