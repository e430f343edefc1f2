#include "core/drive/joined_drives.h"

#include <gtest/gtest.h>

#include <memory>
#include <optional>
#include <random>
#include <string>
#include <utility>
#include <vector>

#include "core/drive/block_growth.h"
#include "core/drive/drive.h"
#include "core/drive/frame_relations.h"
#include "core/drive/pose_graph.h"
#include "core/drive/recordings.h"
#include "core/settings.h"
#include "tests/core/drive/drives.h"
#include "tests/core/drive/scoped_drives.h"
#include "tests/core/graphs.h"
#include "tests/random.h"

namespace revisit::core {
namespace {

std::vector<Pose> Part(std::size_t from, std::size_t to) {
  const std::vector<Pose> ring = Ring(static_cast<double>(to));
  return {ring.begin() + static_cast<std::ptrdiff_t>(from),
          ring.begin() + static_cast<std::ptrdiff_t>(to)};
}

// A drive of one recording.
Drive DriveOver(std::size_t from, std::size_t to,
                const std::shared_ptr<const RecordingStart>& start,
                const DriveSettings& settings = {}) {
  Drive drive(settings);
  drive.Append(RecordingOf(Part(from, to), start, 0), 1);
  return drive;
}

SeenFrames SeenBy(const JoinedDrives& joined, const Drive& drive,
                  std::optional<std::size_t> asking,
                  std::optional<NodeIndex> at = std::nullopt) {
  const NodeIndex query = at.value_or(drive.graph().size() - 1);
  return joined.SeenFrom(drive.frame_nodes(), drive.recordings(), query,
                         drive.LoopsAt(query), asking);
}

// The relation of the asking drive's first recording to another drive's.
FrameRelation RelationTo(const JoinedDrives& joined, const Drive& drive,
                         std::optional<std::size_t> asking, std::size_t other,
                         std::optional<NodeIndex> at = std::nullopt) {
  const SeenFrames seen = SeenBy(joined, drive, asking, at);
  return seen.relations.From(
      seen.own)[*joined.FrameOf(other, drive.frame_nodes())];
}

bool AreEqual(const Pose& a, const Pose& b) {
  return a.x == b.x && a.y == b.y && a.z == b.z && a.heading == b.heading;
}

bool AreEqual(const FrameRelation& a, const FrameRelation& b) {
  return a.state == b.state && AreEqual(a.transform, b.transform) &&
         AreEqual(a.place, b.place) && a.fixed == b.fixed &&
         a.drift == b.drift && a.known_drift == b.known_drift &&
         a.links == b.links;
}

TEST(JoinedDrivesTest, ADatumOfOneNameIsWithoutErrorBetweenDrives) {
  const auto site = DatumAt({10.0, 20.0, 0.0, 0.3}, 50.0, 0.1, "site");
  const auto again = DatumAt({-30.0, 5.0, 0.0, -1.0}, 50.0, 0.1, "site");
  const auto other = DatumAt({1.0, 2.0, 0.0, 0.0}, 50.0, 0.1);
  const Drive a = DriveOver(0, 100, site);
  const Drive b = DriveOver(100, 200, again);
  const Drive c = DriveOver(200, 300, other);
  const auto joined = Join({&a, &b, &c});
  const FrameRelation to_b = RelationTo(*joined, a, 0, 1);
  EXPECT_EQ(to_b.state, FrameState::kDatum);
  EXPECT_EQ(to_b.fixed.norm(), 0.0);
  const Pose wanted = Compose(Inverse(site->datum), again->datum);
  EXPECT_NEAR(to_b.transform.x, wanted.x, 1e-9);
  EXPECT_NEAR(to_b.transform.y, wanted.y, 1e-9);
  EXPECT_GE(RelationTo(*joined, a, 0, 2).fixed(0, 0), 2.0 * 2500.0 - 1e-6);
}

// The relations of one drive of three recordings and those of three drives.
TEST(JoinedDrivesTest, DrivesAreTiedAsTheRecordingsOfOneDriveAre) {
  const std::vector<std::shared_ptr<const RecordingStart>> starts = {
      DatumAt({10.0, 20.0, 0.0, 0.3}, 10.0, 0.1, "site"),
      DatumAt({-3.0, 5.0, 0.0, -1.0}, 20.0, 0.2),
      DatumAt({4.0, 7.0, 0.0, 2.0}, 30.0, 0.3, "site")};
  Drive one(DriveSettings{});
  std::vector<Drive> drives;
  for (std::size_t k = 0; k < 3; ++k) {
    one.Append(RecordingOf(Part(100 * k, 100 * k + 100), starts[k],
                           one.last_sequence()),
               k + 1);
    drives.push_back(DriveOver(100 * k, 100 * k + 100, starts[k]));
  }
  const auto joined = Join({&drives[0], &drives[1], &drives[2]});
  const std::vector<FrameRelation> together =
      one.RelationsAt(one.graph().size() - 1).From(2);
  for (std::size_t k = 0; k < 2; ++k) {
    EXPECT_TRUE(AreEqual(RelationTo(*joined, drives[2], 2, k), together[k]))
        << k;
  }
}

// A drive of two recordings: the second one goes on behind the first.
Drive DriveOfTwo(std::size_t from) {
  Drive drive = DriveOver(from, from + 100, nullptr);
  RecordingStart after;
  after.relation = RecordingRelation::kAfter;
  for (int i = 0; i < 4; ++i) after.covariance(i, i) = 0.25;
  drive.Append(RecordingOf(Part(from + 100, from + 200),
                           std::make_shared<const RecordingStart>(after),
                           drive.last_sequence()),
               2);
  return drive;
}

TEST(JoinedDrivesTest, OwnRecordingsAreSeenFromTheLastOneAsByTheDriveItself) {
  const Drive a = DriveOver(0, 100, nullptr);
  const Drive b = DriveOfTwo(100);
  // The scale of a view is for others to see it.
  const JoinedDrives joined({{a.View(3.0)}, {b.View(3.0)}}, {});
  const auto seen = joined.SeenFromLast(1);
  const auto own = b.RelationsAt(b.graph().size() - 1).From(1);
  ASSERT_EQ(seen[1].size(), 2u);
  EXPECT_EQ(seen[1][1].state, FrameState::kSame);
  EXPECT_EQ(seen[1][0].state, FrameState::kAfter);
  for (std::size_t k = 0; k < 2; ++k) {
    EXPECT_TRUE(AreEqual(seen[1][k], own[k])) << k;
  }
  ASSERT_EQ(seen[0].size(), 1u);
  EXPECT_EQ(seen[0][0].state, FrameState::kNone);
}

TEST(JoinedDrivesTest, OthersAreSeenFromTheLastRecordingOverWhatTiesThem) {
  const Drive a = DriveOver(0, 100, nullptr);
  const Drive b = DriveOfTwo(100);
  const Drive c = DriveOfTwo(300);
  DriveSettings spatial;
  spatial.state_space = StateSpace::kSpatial;
  const Drive other = DriveOver(0, 100, nullptr, spatial);
  const Drive empty{DriveSettings{}};
  // The links are of first recordings.
  const auto joined =
      Join({&a, &b, &c, &other, &empty},
           {{0, 1, {40, 30, nullptr}}, {1, 2, {10, 20, nullptr}}});
  const auto seen = joined->SeenFromLast(2);
  EXPECT_EQ(seen[1][0].state, FrameState::kAfter);
  EXPECT_EQ(seen[1][0].links, 0);
  EXPECT_EQ(seen[1].size(), 2u);
  EXPECT_GT(seen[0][0].known_drift.norm(), 0.0);
  // As from one frame to the next.
  const SeenFrames frames = SeenBy(*joined, c, 2);
  EXPECT_TRUE(AreEqual(
      seen[0][0], frames.relations.From(
                      frames.own + 1)[*joined->FrameOf(0, c.frame_nodes())]));
  const auto direct = joined->SeenFromLast(0);
  EXPECT_EQ(direct[1][0].links, 1);
  EXPECT_EQ(direct[1][0].state, FrameState::kProvisional);
  EXPECT_TRUE(seen[3].empty());
  EXPECT_TRUE(seen[4].empty());
  for (const auto& drive : joined->SeenFromLast(4)) EXPECT_TRUE(drive.empty());
}

// Two drives exclude what one drive of both, with a rejection of its own, does.
TEST(JoinedDrivesTest, RejectedPlacesAreNotSoughtAsThoseOfOneDriveAreNot) {
  const auto unknown = [] {
    RecordingStart start;
    start.relation = RecordingRelation::kUnknown;
    return std::make_shared<const RecordingStart>(start);
  };
  const Drive a = DriveOver(0, 100, nullptr);
  const Drive b = DriveOver(100, 200, unknown());
  Drive one = DriveOver(0, 100, nullptr);
  one.Append(RecordingOf(Part(100, 200), unknown(), one.last_sequence()), 2);
  const NodeIndex first = a.graph().size();
  one.AddRejection(150, 30, 3);
  const NodeIndex query = *one.graph().NodeAtOrBefore(150) - first;
  const NodeIndex matched = *one.graph().NodeAtOrBefore(30);
  const JoinedDrives joined({{a.View(1.0)}, {b.View(1.0)}}, {},
                            {{1, 0, {query, matched, nullptr}}});
  std::size_t excluding = 0;
  for (const double separation : {1.0, 25.0}) {
    for (NodeIndex node = 0; node < b.graph().size(); ++node) {
      const auto found =
          joined.NotSought(0, 1, b.graph(), b.recordings(), node, separation);
      // The first one is that of the query itself.
      const auto wanted = one.NotSought(first + node, separation);
      ASSERT_EQ(found.size() + 1, wanted.size()) << node;
      if (found.empty()) continue;
      ++excluding;
      EXPECT_EQ(found[0].first, wanted[1].first);
      EXPECT_EQ(found[0].last, wanted[1].last);
    }
  }
  EXPECT_GT(excluding, 10u);
  // From the other side it is the same place.
  const auto back =
      joined.NotSought(1, 0, a.graph(), a.recordings(), matched, 1.0);
  ASSERT_EQ(back.size(), 1u);
  EXPECT_LE(back[0].first, query);
  EXPECT_GT(back[0].last, query);
  EXPECT_TRUE(
      joined.NotSought(1, 0, a.graph(), a.recordings(), matched + 20, 1.0)
          .empty());
}

TEST(JoinedDrivesTest, ALinkTiesAndARevisedLinkTiesOtherwise) {
  const Drive a = DriveOver(0, 300, nullptr);
  const Drive b = DriveOver(0, 300, nullptr);
  const Drive c = DriveOver(0, 300, nullptr);
  const std::vector<const Drive*> all = {&a, &b, &c};
  EXPECT_EQ(RelationTo(*Join(all), a, 0, 1).state, FrameState::kNone);
  const FrameLink link{0, 1, {40, 30, nullptr}};
  const auto joined = Join(all, {link});
  const FrameRelation tied = RelationTo(*joined, a, 0, 1);
  EXPECT_EQ(tied.state, FrameState::kProvisional);
  EXPECT_NEAR(Compose(tied.transform, b.graph().pose(30)).x,
              a.graph().pose(40).x, 1e-9);
  EXPECT_EQ(RelationTo(*joined, a, 0, 2).state, FrameState::kNone);
  FrameLink revised = link;
  revised.loop.matched = 35;
  EXPECT_FALSE(AreEqual(RelationTo(*Join(all, {revised}), a, 0, 1), tied));
  // From the other side it is the same link.
  const FrameRelation back = RelationTo(*joined, b, 1, 0);
  EXPECT_EQ(back.state, FrameState::kProvisional);
  EXPECT_NEAR(Compose(back.transform, a.graph().pose(40)).x,
              b.graph().pose(30).x, 1e-9);
  // Over a drive between, whose errors come to those of the links.
  const auto chained = Join(all, {link, {1, 2, {90, 80, nullptr}}});
  const FrameRelation far = RelationTo(*chained, a, 0, 2);
  EXPECT_EQ(far.state, FrameState::kProvisional);
  EXPECT_GT(far.known_drift.norm(), 0.0);
  EXPECT_EQ(far.drift.norm(), 0.0);
}

TEST(JoinedDrivesTest, AMeasuredLinkPlacesTheOtherDriveAsMeasured) {
  std::mt19937_64 random = SeededRandom();
  const Drive a = DriveOver(0, 300, nullptr);
  const Drive b = DriveOver(100, 400, nullptr);
  const auto measured = RandomMeasurement(random, EstimateAt(a.graph(), 60),
                                          EstimateAt(b.graph(), 50), 0.5);
  const auto joined = Join({&a, &b}, {{0, 1, {60, 50, measured}}});
  const FrameRelation tied = RelationTo(*joined, a, 0, 1);
  EXPECT_EQ(tied.state, FrameState::kProvisional);
  const Pose query = Compose(Compose(tied.transform, b.graph().pose(50)),
                             measured->measurement.relative);
  EXPECT_NEAR(query.x, a.graph().pose(60).x, 1e-9);
  EXPECT_NEAR(query.y, a.graph().pose(60).y, 1e-9);
}

TEST(JoinedDrivesTest, DriftOfADriveBetweenHasTheScaleOfThatDrive) {
  const Drive a = DriveOver(0, 300, nullptr);
  const Drive b = DriveOver(0, 300, nullptr);
  const Drive c = DriveOver(0, 300, nullptr);
  const auto far = [&](double scale) {
    const JoinedDrives joined(
        {{a.View(1.0)}, {b.View(scale)}, {c.View(1.0)}},
        {{0, 1, {40, 30, nullptr}}, {1, 2, {90, 80, nullptr}}});
    return RelationTo(joined, a, 0, 2);
  };
  const FrameRelation usual = far(1.0);
  const FrameRelation twice = far(2.0);
  EXPECT_LT((twice.known_drift - 4.0 * usual.known_drift).norm(),
            1e-9 * twice.known_drift.norm());
  EXPECT_EQ(twice.fixed, usual.fixed);
}

TEST(JoinedDrivesTest, WhatTheAskingDriveLearnsAfterTheQueryDoesNotCount) {
  const Drive a = DriveOver(0, 300, nullptr);
  const Drive b = DriveOver(0, 300, nullptr);
  const auto joined = Join({&a, &b}, {{0, 1, {100, 30, nullptr}}});
  EXPECT_EQ(RelationTo(*joined, a, 0, 1, 100).state, FrameState::kProvisional);
  EXPECT_EQ(RelationTo(*joined, a, 0, 1, 99).state, FrameState::kNone);
}

TEST(JoinedDrivesTest, LinksToPosesThatAViewDoesNotHaveWaitForAnother) {
  const Drive a = DriveOver(0, 300, nullptr);
  Drive b = DriveOver(0, 300, nullptr);
  const Drive c = DriveOver(0, 300, nullptr);
  const NodeIndex next = b.graph().size();
  const std::vector<FrameLink> links = {{0, 1, {40, next, nullptr}},
                                        {1, 2, {next, 40, nullptr}}};
  const auto before = Join({&a, &b, &c}, links);
  EXPECT_EQ(RelationTo(*before, a, 0, 1).state, FrameState::kNone);
  const SeenFrames of_others = SeenBy(*before, c, 2);
  const auto frame_of = [&](std::size_t d) {
    return *before->FrameOf(d, a.frame_nodes());
  };
  EXPECT_EQ(of_others.relations.From(frame_of(0))[frame_of(1)].state,
            FrameState::kNone);
  EXPECT_EQ(RelationTo(*before, c, 2, 1).state, FrameState::kNone);
  RecordingStart unknown;
  unknown.relation = RecordingRelation::kUnknown;
  b.Append(RecordingOf(Part(300, 400),
                       std::make_shared<const RecordingStart>(unknown),
                       b.last_sequence()),
           2);
  EXPECT_EQ(RelationTo(*before, a, 0, 1).state, FrameState::kNone);
  const auto after = Join({&a, &b, &c}, links);
  const SeenFrames seen = SeenBy(*after, a, 0);
  const std::size_t second = *after->FrameOf(1, a.frame_nodes()) + 1;
  EXPECT_EQ(seen.relations.From(seen.own)[second].state,
            FrameState::kProvisional);
}

// The drive goes on behind its view, in a recording that the view does not
// have.
TEST(JoinedDrivesTest, TheAskingDriveIsSeenAsItIsNow) {
  Drive a = DriveOver(0, 300, DatumAt({}, 10.0, 0.1));
  const Drive b = DriveOver(0, 300, DatumAt({}, 10.0, 0.1));
  const auto joined = Join({&a, &b});
  EXPECT_EQ(joined->view(0).graph.size(), a.graph().size());
  const NodeIndex before = a.graph().size();
  RecordingStart after;
  after.covariance = UsualGap();
  a.Append(
      RecordingOf(Part(300, 400), std::make_shared<const RecordingStart>(after),
                  a.last_sequence()),
      2);
  EXPECT_EQ(joined->view(0).graph.size(), before);
  const SeenFrames seen = SeenBy(*joined, a, 0);
  const std::vector<FrameRelation> ties = seen.relations.From(seen.own + 1);
  EXPECT_EQ(ties[seen.own].state, FrameState::kAfter);
  EXPECT_EQ(ties[*joined->FrameOf(1, a.frame_nodes())].state,
            FrameState::kAfter);
  // Its view is not seen beside it.
  EXPECT_EQ(ties[*joined->FrameOf(0, a.frame_nodes())].state,
            FrameState::kNone);
}

// Drives of one or two recordings, most of which a datum places.
std::vector<Drive> RandomDrives(std::mt19937_64& random, std::size_t count) {
  std::vector<Drive> drives;
  while (drives.size() < count) {
    const auto any_start = [&]() -> std::shared_ptr<const RecordingStart> {
      auto start =
          DatumAt({Uniform(random, -50.0, 50.0), Normal(random, 50.0), 0.0,
                   Uniform(random, -3.0, 3.0)},
                  Uniform(random, 0.1, 30.0), Uniform(random, 0.001, 0.3));
      const int kind = UniformInt(random, 0, 5);
      if (kind == 0) start->relation = RecordingRelation::kUnknown;
      if (kind == 1) start->relation = RecordingRelation::kAfter;
      if (kind == 2) start->datum_id = "datum " + std::to_string(drives.size());
      return start;
    };
    Drive drive{DriveSettings{}};
    for (int k = UniformInt(random, 1, 2); k > 0; --k) {
      drive.Append(
          RecordingOf(Part(0, 100), any_start(), drive.last_sequence()),
          drive.revision() + 1);
    }
    drives.push_back(std::move(drive));
  }
  return drives;
}

// Links of this drive to others, or, where it is nothing, of any two.
std::vector<FrameLink> RandomLinks(std::mt19937_64& random,
                                   const std::vector<Drive>& drives, int most,
                                   std::optional<std::size_t> of) {
  std::vector<FrameLink> links;
  const auto count = static_cast<int>(drives.size());
  const auto node_of = [&](std::size_t drive) {
    return static_cast<NodeIndex>(UniformInt(
        random, 0, static_cast<int>(drives[drive].graph().size()) - 1));
  };
  for (int i = UniformInt(random, 0, most); i > 0; --i) {
    const std::size_t a =
        of ? *of : static_cast<std::size_t>(UniformInt(random, 0, count - 1));
    const std::size_t b =
        (a + static_cast<std::size_t>(UniformInt(random, 1, count - 1))) %
        drives.size();
    links.push_back({a, b, {node_of(a), node_of(b), nullptr}});
    if (UniformInt(random, 0, 1)) {
      FrameLink& link = links.back();
      std::swap(link.query_drive, link.matched_drive);
      std::swap(link.loop.query, link.loop.matched);
    }
  }
  return links;
}

std::vector<const Drive*> PointersTo(const std::vector<Drive>& drives) {
  std::vector<const Drive*> pointers;
  for (const Drive& drive : drives) pointers.push_back(&drive);
  return pointers;
}

TEST(JoinedDrivesTest, FramesAreSeenAsIfTheAskingDriveHadNoView) {
  std::mt19937_64 random = SeededRandom();
  const Drive empty{DriveSettings{}};
  std::size_t tied = 0;
  for (int trial = 0; trial < 40; ++trial) {
    const std::vector<Drive> drives = RandomDrives(random, 5);
    const auto asking = static_cast<std::size_t>(UniformInt(random, 0, 4));
    const Drive& drive = drives[asking];
    // Links between others would be tied over the view too.
    const auto links = RandomLinks(random, drives, 6, asking);
    const auto with_view = Join(PointersTo(drives), links);
    std::vector<const Drive*> others = PointersTo(drives);
    others[asking] = &empty;
    const auto without = Join(others, links);
    const auto query = static_cast<NodeIndex>(
        UniformInt(random, 0, static_cast<int>(drive.graph().size()) - 1));
    const SeenFrames seen = SeenBy(*with_view, drive, asking, query);
    const SeenFrames wanted = SeenBy(*without, drive, asking, query);
    const std::size_t own = drive.recordings().Of(query);
    const auto ties = seen.relations.From(seen.own + own);
    const auto wanted_ties = wanted.relations.From(wanted.own + own);
    for (std::size_t d = 0; d < drives.size(); ++d) {
      const std::size_t recordings =
          d == asking ? own + 1 : drives[d].recordings().size();
      for (std::size_t k = 0; k < recordings; ++k) {
        const auto frame = [&](const JoinedDrives& joined,
                               const SeenFrames& frames) {
          return k + (d == asking ? frames.own
                                  : *joined.FrameOf(d, drive.frame_nodes()));
        };
        const FrameRelation& tie = ties[frame(*with_view, seen)];
        EXPECT_TRUE(AreEqual(tie, wanted_ties[frame(*without, wanted)]))
            << trial << ": " << d << ", " << k;
        if (tie.is_tied()) ++tied;
      }
    }
    // The view is tied to nothing, and no links lead to it.
    const std::size_t of_view =
        *with_view->FrameOf(asking, drive.frame_nodes());
    EXPECT_FALSE(ties[of_view].is_tied());
    for (std::size_t frame = 0; frame < ties.size(); ++frame) {
      EXPECT_TRUE(seen.relations.LinksBetween(of_view, frame).empty());
      EXPECT_TRUE(seen.relations.LinksBetween(frame, of_view).empty());
    }
  }
  EXPECT_GT(tied, 100u);
}

TEST(JoinedDrivesTest, RelationsToSomeFramesAreThoseAmongRelationsToAll) {
  std::mt19937_64 random = SeededRandom();
  std::size_t tied = 0;
  for (int trial = 0; trial < 40; ++trial) {
    const std::vector<Drive> drives = RandomDrives(random, 7);
    const auto joined =
        Join(PointersTo(drives), RandomLinks(random, drives, 8, std::nullopt));
    const SeenFrames seen = SeenBy(*joined, drives[2], 2);
    const std::size_t frames = seen.relations.From(0).size();
    const auto any = [&] {
      return static_cast<std::size_t>(
          UniformInt(random, 0, static_cast<int>(frames) - 1));
    };
    const std::size_t from = any();
    std::vector<std::size_t> others;
    for (int i = UniformInt(random, 1, 4); i > 0; --i) others.push_back(any());
    const auto all = seen.relations.From(from);
    const auto some = seen.relations.From(from, others);
    ASSERT_EQ(some.size(), others.size());
    for (std::size_t i = 0; i < others.size(); ++i) {
      EXPECT_TRUE(AreEqual(some[i], all[others[i]])) << trial << ": " << i;
      if (others[i] != from && some[i].is_tied()) ++tied;
    }
  }
  EXPECT_GT(tied, 20u);
}

TEST(JoinedDrivesTest, GrowthFromFirstNodesIsFoundOnceForEachView) {
  const Drive two = DriveOfTwo(0);
  DriveSettings settings;
  settings.search.correlation_model = CorrelationModel::kIndependent;
  const Drive fixes = DriveOver(0, 100, nullptr, settings);
  const std::vector<JoinedDrive> views = {
      {fixes.View(1.0)}, {two.View(1.0)}, {two.View(1.0)}};
  const JoinedDrives joined(views, {});
  EXPECT_EQ(joined.GrowthFromFirst(0, 0), nullptr);
  const DriveView& view = *views[1].view;
  for (std::size_t k = 0; k < 2; ++k) {
    const NodeRange nodes = view.recordings.NodesOf(k, view.graph.size());
    const Growth* const growth = joined.GrowthFromFirst(1, k);
    ASSERT_NE(growth, nullptr);
    const auto blocks =
        BlocksGrowing(view.state_space, view.graph, nodes, nodes.first);
    EXPECT_EQ(growth->blocks, blocks);
    EXPECT_EQ(growth->all_grow, AllGrow(view.state_space, view.graph, nodes,
                                        nodes.first, blocks));
    EXPECT_TRUE(growth->all_grow);
  }
  const JoinedDrives again({views[2], {two.View(1.0)}}, {}, {}, &joined);
  EXPECT_EQ(again.GrowthFromFirst(0, 1), joined.GrowthFromFirst(2, 1));
  EXPECT_NE(again.GrowthFromFirst(1, 1), joined.GrowthFromFirst(1, 1));
}

TEST(JoinedDrivesTest, AMembersDatumPlacesItsFirstRecording) {
  const Drive a = DriveOver(0, 300, nullptr);
  const Drive b = DriveOver(0, 300, DatumAt({9.0, 9.0, 0.0, 0.0}, 1.0, 0.1));
  const auto place_a = DatumAt({3.0, 0.0, 0.0, 0.0}, 10.0, 0.1);
  const auto place_b = DatumAt({1.0, 0.0, 0.0, 0.0}, 10.0, 0.1);
  const JoinedDrives joined({{a.View(1.0), place_a}, {b.View(1.0), place_b}},
                            {});
  const FrameRelation tied = RelationTo(joined, a, 0, 1);
  EXPECT_EQ(tied.state, FrameState::kDatum);
  EXPECT_NEAR(tied.transform.x, -2.0, 1e-9);
  EXPECT_NEAR(tied.transform.y, 0.0, 1e-9);
}

TEST(JoinedDrivesTest, DrivesOfAnotherKindOrWithoutNodesAreNotTied) {
  DriveSettings spatial;
  spatial.state_space = StateSpace::kSpatial;
  DriveSettings fixes;
  fixes.search.correlation_model = CorrelationModel::kIndependent;
  const auto datum = DatumAt({}, 1.0, 0.1, "site");
  const Drive a = DriveOver(0, 100, datum);
  const Drive b = DriveOver(0, 100, datum, spatial);
  const Drive c = DriveOver(0, 100, datum, fixes);
  const Drive none(DriveSettings{});
  const auto joined = Join({&a, &b, &c, &none}, {{0, 1, {3, 3, nullptr}},
                                                 {2, 0, {3, 3, nullptr}},
                                                 {0, 3, {3, 0, nullptr}}});
  for (std::size_t d = 1; d < 4; ++d) {
    EXPECT_FALSE(joined->FrameOf(d, a.frame_nodes()).has_value()) << d;
  }
  EXPECT_TRUE(joined->FrameOf(1, b.frame_nodes()).has_value());
  const SeenFrames seen = SeenBy(*joined, a, 0);
  EXPECT_EQ(seen.relations.From(seen.own)[seen.own].state, FrameState::kSame);
}

}  // namespace
}  // namespace revisit::core
