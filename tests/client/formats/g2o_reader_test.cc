#include "client/formats/g2o_reader.h"

#include <array>
#include <cmath>
#include <string>

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "tests/client/formats/reading.h"

namespace revisit::client {
namespace {

using ::testing::DoubleNear;
using ::testing::HasSubstr;
using ::testing::Pointwise;

// Two metres ahead, twice, with a quarter turn between.
constexpr char kPlanar[] =
    "# a graph\n"
    "VERTEX_SE2 0 0 0 0\n"
    "VERTEX_SE2 2 2 2 1.5707963267948966\n"
    "VERTEX_SE2 1 2 0 1.5707963267948966\n"
    "FIX 0\n"
    "EDGE_SE2 0 1 2 0 1.5707963267948966 4 0 0 25 0 100\n"
    "EDGE_SE2 1 2 2 0 0 4 0 0 25 0 100\n"
    "EDGE_SE2 0 2 2 2 1.57 1 0 0 1 0 1\n";

TEST(G2oReaderTest, ComposesTheInformationOfNeighboursInTheOrderOfIds) {
  const auto samples = ReadText(kPlanar);
  ASSERT_TRUE(samples.ok()) << samples.status();
  ASSERT_EQ(samples->size(), 3u);
  EXPECT_THAT(*(*samples)[0].covariance, ::testing::Each(0.0));
  // The axes of vertex 1 are turned: its x is y of the frame.
  EXPECT_THAT(*(*samples)[1].covariance,
              Pointwise(DoubleNear(1e-12),
                        std::array<double, 6>{0.04, 0, 0, 0.25, 0, 0.01}));
  EXPECT_EQ((*samples)[2].estimate.y, 2.0);
  // The heading error at vertex 1 swings the 2 m to vertex 2 sideways.
  EXPECT_THAT(*(*samples)[2].covariance,
              Pointwise(DoubleNear(1e-12),
                        std::array<double, 6>{0.08 + 4 * 0.01, 0, -2 * 0.01,
                                              0.5, 0, 0.02}));
  EXPECT_FALSE((*samples)[0].time_nanoseconds.has_value());
}

TEST(G2oReaderTest, HalvesOfRotationVectorsAreRotations) {
  const auto samples = ReadText(
      "VERTEX_SE3:QUAT 5 0 0 0 0 0 0 1\n"
      "VERTEX_SE3:QUAT 7 1 0 0.5 0 0 0 1\n"
      "EDGE_SE3:QUAT 5 7 1 0 0.5 0 0 0 1 "
      "4 0 0 0 0 0 5 0 0 0 0 10 0 0 0 100 0 0 100 0 400\n");
  ASSERT_TRUE(samples.ok()) << samples.status();
  const auto& covariance = *(*samples)[1].covariance_36;
  EXPECT_NEAR(covariance[0], 0.25, 1e-12);
  EXPECT_NEAR(covariance[7], 0.2, 1e-12);
  EXPECT_NEAR(covariance[14], 0.1, 1e-12);
  // The variance of half the angle is 1 / 400.
  EXPECT_NEAR(covariance[35], 4.0 / 400.0, 1e-12);
  EXPECT_EQ((*samples)[1].z, 0.5);
}

TEST(G2oReaderTest, BehindAMissingEdgeNothingIsKnown) {
  std::string text = kPlanar;
  text.erase(text.find("EDGE_SE2 0 1"),
             text.find("EDGE_SE2 1 2") - text.find("EDGE_SE2 0 1"));
  const auto samples = ReadText(text);
  ASSERT_TRUE(samples.ok()) << samples.status();
  EXPECT_TRUE((*samples)[0].covariance.has_value());
  EXPECT_FALSE((*samples)[1].covariance.has_value());
  EXPECT_FALSE((*samples)[2].covariance.has_value());
}

TEST(G2oReaderTest, EdgesAloneAreComposedToThePosesThatVerticesHave) {
  std::string edges = kPlanar;
  edges.erase(edges.find("VERTEX"), edges.find("FIX") - edges.find("VERTEX"));
  const auto expected = ReadText(kPlanar);
  const auto samples = ReadText(edges);
  ASSERT_TRUE(samples.ok()) << samples.status();
  ASSERT_EQ(samples->size(), 3u);
  for (std::size_t i = 0; i < 3; ++i) {
    const Sample& is = (*samples)[i];
    const Sample& should = (*expected)[i];
    EXPECT_NEAR(is.estimate.x, should.estimate.x, 1e-12);
    EXPECT_NEAR(is.estimate.y, should.estimate.y, 1e-12);
    EXPECT_NEAR(is.estimate.heading, should.estimate.heading, 1e-12);
    EXPECT_THAT(*is.covariance,
                Pointwise(DoubleNear(1e-12), *should.covariance));
  }
}

TEST(G2oReaderTest, SpatialEdgesAloneTurnTheStepsBehindThem) {
  const std::string information =
      " 1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1\n";
  // Up the x axis after a quarter turn about y.
  const auto samples =
      ReadText("EDGE_SE3:QUAT 3 4 1 0 0 0 -0.70710678118 0 0.70710678118" +
               information + "EDGE_SE3:QUAT 4 5 2 0 0 0 0 0 1" + information);
  ASSERT_TRUE(samples.ok()) << samples.status();
  ASSERT_EQ(samples->size(), 3u);
  EXPECT_NEAR((*samples)[2].estimate.x, 1.0, 1e-9);
  EXPECT_NEAR((*samples)[2].z, 2.0, 1e-9);
  EXPECT_NEAR((*(*samples)[2].quaternion)[1], -std::sqrt(0.5), 1e-9);
}

TEST(G2oReaderTest, SaysWhereAFileIsWrong) {
  EXPECT_EQ(MessageOf(ReadText("VERTEX_SE2 0 0 0\n")),
            "a.txt:1: expected 5 fields of VERTEX_SE2, got 4");
  EXPECT_EQ(MessageOf(ReadText("VERTEX_SE2 0 0 0 0\nVERTEX_SE2 0 0 0 0\n")),
            "a.txt:2: vertex 0 stands twice");
  EXPECT_THAT(MessageOf(ReadText("VERTEX_SE2 0 0 0 0\nhello 1 2\n")),
              HasSubstr("a.txt:2: expected an element such as VERTEX_SE2"));
  EXPECT_THAT(MessageOf(ReadText("FIX 0\n")),
              HasSubstr("expected at least one VERTEX_SE2"));
  EXPECT_THAT(MessageOf(ReadText("EDGE_SE2 0 1 0 0 0 1 0 0 1 0 1\n"
                                 "EDGE_SE2 2 3 0 0 0 1 0 0 1 0 1\n")),
              HasSubstr("a.txt:2: the file has no vertices, and no edges that "
                        "lead from vertex 0 to vertex 2"));
  EXPECT_EQ(MessageOf(ReadText("VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 0 0 0\n"
                               "EDGE_SE2 0 1 0 0 0 1 0 0 -1 0 1\n")),
            "a.txt:3: expected a positive definite information matrix");
}

}  // namespace
}  // namespace revisit::client
