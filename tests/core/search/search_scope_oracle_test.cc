// Searches over other drives, against all nodes one by one: the differences and
// Gamma of frame_relation.h in long double, one mixture after the other, and
// all ends against one new place. Paths are of one node, so that nothing but
// the ends counts.
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <map>
#include <memory>
#include <optional>
#include <random>
#include <utility>
#include <vector>

#include "core/drive/drive.h"
#include "core/drive/joined_drives.h"
#include "core/drive/pose_graph.h"
#include "core/drive/recordings.h"
#include "core/search/alignment/chance.h"
#include "core/search/alignment/relative_model.h"
#include "core/search/search.h"
#include "core/search/search_scope.h"
#include "core/settings.h"
#include "tests/core/drive/wandering.h"
#include "tests/core/graphs.h"
#include "tests/oracle/frames.h"
#include "tests/random.h"

namespace revisit::core {
namespace {

using oracle::FrameWith;
using oracle::Placed;
using oracle::Wide;
using oracle::WideFrames;
using oracle::WideMatrix;
using oracle::WidePose;
using oracle::WidePoseOf;
using oracle::WideTie;

std::shared_ptr<RecordingStart> RandomDatum(std::mt19937_64& random,
                                            double meters) {
  auto start = std::make_shared<RecordingStart>();
  start->relation = RecordingRelation::kDatum;
  start->datum = RandomPose(random, 50.0);
  start->datum.z = 0.0;
  start->covariance = RandomCovariance(random, meters);
  for (int i : {0, 1, 2}) start->covariance(i, i) += meters * meters;
  start->covariance(3, 3) += meters * meters / 400.0;
  return start;
}

std::shared_ptr<RecordingStart> Nowhere() {
  auto start = std::make_shared<RecordingStart>();
  start->relation = RecordingRelation::kUnknown;
  return start;
}

// Two recordings, of which the last one ends with a jump.
template <int D>
void Drove(std::mt19937_64& random,
           const std::shared_ptr<const RecordingStart>& first,
           const std::shared_ptr<const RecordingStart>& second, Drive* drive) {
  std::uint64_t sequence = 0;
  for (const auto& start : {first, second}) {
    std::vector<PoseSample> samples =
        WanderingSamples<D>(random, UniformInt(random, 30, 60));
    PoseSample jumped = samples.back();
    const StateMatrix<D> before = ToMatrix<D>(jumped.covariance);
    jumped.pose.x += Uniform(random, 40.0, 60.0);
    jumped.pose.heading = Uniform(random, -kPi, kPi);
    const StateMatrix<D> psi =
        DeadReckoningTransition<D>(samples.back().pose, jumped.pose);
    jumped.covariance =
        ToCovariance<D>(psi * before * psi.transpose() +
                        ToMatrix<D>(RandomCovariance(random, 2.0)));
    if (start == second) samples.push_back(jumped);
    for (PoseSample& sample : samples) sample.sequence = ++sequence;
    samples.front().recording_start = start;
    drive->Append(samples, sequence);
  }
}

// A search that asks at the newest node, as the definitions have it.
template <int D>
class Brute {
 public:
  Brute(const Drive& asking, const SearchScope& scope)
      : asking_(asking), graph_(asking.graph()), scope_(scope) {
    tolerance_ = Diagonal(asking.settings().search.place_tolerance);
    confirmed_ = Diagonal(kConfirmedTolerance);
  }

  // ln of the odds of each node that is sought, by drive. `starts` are those of
  // the two recordings of each drive; the asking one is the second.
  std::map<std::pair<std::size_t, NodeIndex>, Wide> LogOdds(
      const std::vector<std::vector<std::shared_ptr<const RecordingStart>>>&
          starts,
      const std::vector<FrameLink>& links) {
    std::map<std::pair<std::size_t, NodeIndex>, Wide> odds;
    const std::size_t self = *scope_.asking;
    for (std::size_t d = 0; d < starts.size(); ++d) {
      if (d == self ? scope_.exclude_own : !scope_.Searches(d)) continue;
      const bool is_own = d == self;
      const PoseGraph& graph = is_own ? graph_ : scope_.drives->view(d).graph;
      const Recordings& recordings =
          is_own ? asking_.recordings() : scope_.drives->view(d).recordings;
      std::optional<Wide> scale;
      if (!is_own) scale = scope_.drives->view(d).scale;
      const WideFrames frames(graph_, graph, scale, true, D);
      for (std::size_t k = 0; k < (is_own ? 1 : 2); ++k) {
        std::optional<WideTie> tie =
            ByDatums(*starts[self][1], asking_.recordings()[1].first_node,
                     *starts[d][k], recordings[k].first_node, graph);
        bool is_linked = false;
        for (const FrameLink& link : links) {
          if (link.matched_drive != d ||
              recordings.Of(link.loop.matched) != k) {
            continue;
          }
          tie = frames.KnownBy(tie, is_linked, link.loop.query,
                               link.loop.matched, 1.0L, confirmed_);
          is_linked = true;
        }
        const NodeRange nodes = recordings.NodesOf(k, graph.size());
        for (NodeIndex j = nodes.first; j < nodes.last; ++j) {
          odds[{d, j}] = LogOddsOf(frames, tie, is_linked, j);
          if (tie) CountHeading(frames, *tie, j);
        }
      }
    }
    if (elsewhere_ > 0.0L) {
      const Wide log_heading = std::log(std::max<Wide>(
          1.0L, 2.0L * oracle::kWidePi * headings_ / elsewhere_));
      for (auto& [node, log_odds] : odds) log_odds -= log_heading;
    }
    AddOwn(&odds);
    return odds;
  }

 private:
  NodeIndex query() const { return graph_.size() - 1; }

  // Both were placed in one frame, in which each errs by itself.
  std::optional<WideTie> ByDatums(const RecordingStart& u, NodeIndex c,
                                  const RecordingStart& v, NodeIndex m,
                                  const PoseGraph& other) const {
    if (u.relation != RecordingRelation::kDatum ||
        v.relation != RecordingRelation::kDatum) {
      return std::nullopt;
    }
    const WidePose origin;
    const WidePose to_u = FrameWith(origin, WidePoseOf(u.datum));
    WideTie tie;
    tie.frame = Placed(to_u, WidePoseOf(v.datum));
    tie.place = WidePoseOf(other.pose(m));
    tie.asking_node = c;
    tie.other_node = m;
    const WidePose at = Placed(tie.frame, tie.place);
    const WidePose start = WidePoseOf(graph_.pose(c));
    const WideMatrix turn = oracle::WideTurn(to_u.heading, D);
    const WideMatrix lever =
        oracle::WideLever(at.x - start.x, at.y - start.y, D);
    const auto error = [&](const RecordingStart& of) {
      return WideMatrix(turn * oracle::WideCovarianceOf(of.covariance, D) *
                        turn.transpose());
    };
    tie.covariance = lever * error(u) * lever.transpose() + error(v);
    return tie;
  }

  Wide LogOddsOf(const WideFrames& frames, const std::optional<WideTie>& tie,
                 bool is_linked, NodeIndex j) const {
    const SearchOptions& options = asking_.settings().search;
    const Wide roads = 2.0L / options.road_spacing_meters /
                       asking_.settings().node_spacing_meters;
    if (!tie) return -std::log(2.0L * roads * 1e8L);
    // One in twenty datums errs three times as much.
    Wide density = 0.0L;
    for (const auto& [share, variance] :
         is_linked ? std::vector<std::pair<Wide, Wide>>{{1.0L, 1.0L}}
                   : std::vector<std::pair<Wide, Wide>>{{0.95L, 1.0L},
                                                        {0.05L, 9.0L}}) {
      WideTie lies = *tie;
      lies.covariance *= variance;
      density += share * Density(frames, lies, j);
    }
    return std::log(density) - std::log(NewPlaceDensity());
  }

  Wide Density(const WideFrames& frames, const WideTie& tie,
               NodeIndex j) const {
    const auto form =
        oracle::EvaluateWide(frames.Gamma(tie, query(), j, 1.0L) + tolerance_,
                             frames.Difference(tie, query(), j));
    return std::exp(-0.5L * (form->log_determinant + form->squared) -
                    0.5L * D * std::log(2.0L * oracle::kWidePi));
  }

  // Adds the density at the query's heading of the heading of a node where the
  // vehicle is not.
  void CountHeading(const WideFrames& frames, const WideTie& tie, NodeIndex j) {
    const WideMatrix gamma = frames.Gamma(tie, query(), j, 1.0L) + tolerance_;
    const auto difference = frames.Difference(tie, query(), j);
    const Wide half = (gamma(0, 0) + gamma(1, 1)) / 2.0L;
    const Wide most =
        half + std::sqrt((half - gamma(0, 0)) * (half - gamma(0, 0)) +
                         gamma(0, 1) * gamma(0, 1));
    if (difference(0) * difference(0) + difference(1) * difference(1) <=
        static_cast<Wide>(kSquaredElsewhere) * most) {
      return;
    }
    const Wide variance = gamma(D - 1, D - 1);
    const Wide heading = difference(D - 1);
    headings_ += std::exp(-0.5L * heading * heading / variance) /
                 std::sqrt(2.0L * oracle::kWidePi * variance);
    ++elsewhere_;
  }

  Wide NewPlaceDensity() const {
    const DriveSettings& settings = asking_.settings();
    const Wide roads = 2.0L / settings.search.road_spacing_meters /
                       settings.node_spacing_meters;
    const Wide density = 2.0L * roads / (2.0L * oracle::kWidePi);
    return D == 4 ? density / kRoadHeightRange : density;
  }

  static WideMatrix Diagonal(const PlaceTolerance& tolerance) {
    return oracle::WideDiagonal(tolerance.position_meters,
                                tolerance.heading_radians, D);
  }

  // The past of the query's recording, in one frame with it: beside what is
  // added from the node on, the node's own error swings the query.
  void AddOwn(std::map<std::pair<std::size_t, NodeIndex>, Wide>* odds) const {
    if (scope_.exclude_own) return;
    const WideFrames frames(graph_, true, D);
    for (NodeIndex j = asking_.recordings()[1].first_node; j < query(); ++j) {
      if (IsNearer(graph_, query(), 10.0, j)) continue;
      WideTie same;
      same.place = WidePoseOf(graph_.pose(j));
      const WidePose end = WidePoseOf(graph_.pose(query()));
      const WideMatrix swing =
          oracle::WideLever(end.x - same.place.x, end.y - same.place.y, D) -
          WideMatrix::Identity(D, D);
      same.covariance = swing *
                        oracle::WideCovarianceOf(graph_.covariance(j), D) *
                        swing.transpose();
      same.asking_node = j;
      same.other_node = j;
      (*odds)[{*scope_.asking, j}] =
          std::log(Density(frames, same, j)) - std::log(NewPlaceDensity());
    }
  }

  const Drive& asking_;
  const PoseGraph& graph_;
  const SearchScope& scope_;
  WideMatrix tolerance_;
  WideMatrix confirmed_;
  Wide headings_ = 0.0L;
  Wide elsewhere_ = 0.0L;
};

// How a drive's two recordings and links place it.
struct Member {
  std::vector<std::shared_ptr<const RecordingStart>> starts;
  double scale = 1.0;
};

template <int D>
void ExpectAgreement(std::mt19937_64& random) {
  DriveSettings settings;
  settings.state_space = D == 3 ? StateSpace::kPlanar : StateSpace::kSpatial;
  settings.max_step_meters = 20.0;
  settings.search.sequence_length_meters = settings.node_spacing_meters;
  settings.search.use_belief = false;
  settings.search.exhaustive = true;
  settings.search.max_candidates = 50;
  const std::size_t count = 3;
  const auto self = static_cast<std::size_t>(UniformInt(random, 0, 2));
  std::vector<Member> members(count);
  std::vector<Drive> drives;
  for (std::size_t d = 0; d < count; ++d) {
    for (int k = 0; k < 2; ++k) {
      const bool is_asking = d == self && k == 1;
      // The asking recording's is so sure that no way over another drive is
      // surer, and the others so unsure that a link is.
      members[d].starts.push_back(is_asking ? RandomDatum(random, 2.0)
                                  : UniformInt(random, 0, 3) > 0
                                      ? RandomDatum(random, 20.0)
                                      : Nowhere());
    }
    members[d].scale = Uniform(random, 0.4, 2.5);
    drives.emplace_back(settings);
    Drove<D>(random, members[d].starts[0], members[d].starts[1], &drives[d]);
  }
  const Drive& asking = drives[self];
  const NodeIndex query = asking.graph().size() - 1;
  ASSERT_EQ(asking.graph().SegmentStart(query), query);
  std::vector<FrameLink> links;
  for (int i = UniformInt(random, 0, 3); i > 0; --i) {
    const std::size_t other =
        (self + static_cast<std::size_t>(UniformInt(random, 1, 2))) % count;
    const auto node_of = [&](const Drive& drive, std::size_t from) {
      return static_cast<NodeIndex>(UniformInt(
          random, static_cast<int>(drive.recordings()[from].first_node),
          static_cast<int>(drive.graph().size()) - 1));
    };
    links.push_back(
        {self, other, {node_of(asking, 1), node_of(drives[other], 0)}});
  }
  std::vector<JoinedDrive> joined;
  std::vector<std::vector<std::shared_ptr<const RecordingStart>>> starts;
  for (std::size_t d = 0; d < count; ++d) {
    joined.push_back({drives[d].View(members[d].scale)});
    starts.push_back(members[d].starts);
  }
  // One of the others is left out now and then.
  std::vector<bool> searched;
  if (UniformInt(random, 0, 2) == 0) {
    searched.resize(count, true);
    searched[(self + static_cast<std::size_t>(UniformInt(random, 1, 2))) %
             count] = false;
  }
  const SearchScope scope{std::make_shared<const JoinedDrives>(joined, links),
                          self, UniformInt(random, 0, 1) == 1, searched};
  const auto set = Search(&asking).At(query, settings.search, scope, nullptr);
  ASSERT_TRUE(set.ok());
  const auto odds = Brute<D>(asking, scope).LogOdds(starts, links);
  Wide sum = 1.0L;
  for (const auto& [node, log_odds] : odds) sum += std::exp(log_odds);
  ASSERT_FALSE(set->candidates.empty());
  // Passes of one place share its odds (Rivals::AverageOverPasses()), and no
  // place has more passes than there are places.
  EXPECT_GE(std::log(*set->new_place_probability),
            static_cast<double>(-std::log(sum)) - 1e-9);
  const Wide shared =
      1.0L + (sum - 1.0L) / static_cast<Wide>(set->candidates.size());
  EXPECT_LE(std::log(*set->new_place_probability),
            static_cast<double>(-std::log(shared)) + 1e-9);
  for (const Candidate& candidate : set->candidates) {
    const auto wanted =
        odds.find({candidate.drive.value_or(self), candidate.matched});
    ASSERT_NE(wanted, odds.end());
    EXPECT_NEAR(candidate.score, static_cast<double>(wanted->second),
                1e-9 * (1.0 + std::abs(candidate.score)));
  }
}

TEST(SearchScopeOracleTest, OddsAreThoseOfAllNodesOneByOne) {
  std::mt19937_64 random = SeededRandom();
  for (int trial = 0; trial < 60; ++trial) {
    SCOPED_TRACE(trial);
    ExpectAgreement<3>(random);
    ExpectAgreement<4>(random);
  }
}

}  // namespace
}  // namespace revisit::core
