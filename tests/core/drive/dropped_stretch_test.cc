#include "core/drive/dropped_stretch.h"

#include <gtest/gtest.h>

#include <string>
#include <vector>

#include "core/base/byte_stream.h"
#include "core/drive/distance_resampler.h"
#include "core/geometry/pose.h"

namespace revisit::core {
namespace {

PoseSample SampleAt(std::uint64_t sequence, double x) {
  PoseSample sample;
  sample.sequence = sequence;
  sample.pose.x = x;
  for (int i = 0; i < 4; ++i) sample.covariance(i, i) = 1.0;
  return sample;
}

ErrorTransition TransitionOf(double factor) {
  ErrorTransition transition;
  for (double& value : transition.values) value *= factor;
  return transition;
}

TEST(DroppedStretchTest, KeepsTheWayFromThePoseBeforeToThePoseBehind) {
  DroppedStretchMaker maker({});
  maker.Begin(SampleAt(4, 10.0).pose);
  maker.Add(SampleAt(5, 13.0));
  // Standing still and a jump add nothing.
  maker.Add(SampleAt(6, 13.01));
  maker.Add(SampleAt(7, 500.0));
  maker.Add(SampleAt(8, 504.0));
  maker.End(SampleAt(9, 509.0).pose);
  const DroppedStretch stretch = maker.Take();
  EXPECT_EQ(stretch.first_sequence, 5u);
  EXPECT_EQ(stretch.last_sequence, 8u);
  EXPECT_DOUBLE_EQ(stretch.travelled_meters, 3.0 + 4.0 + 5.0);
  EXPECT_FALSE(stretch.transition);
}

TEST(DroppedStretchTest, IsTheSameWhateverWasDroppedBefore) {
  ResamplerOptions options;
  options.carry_transitions = true;
  const auto sample = [](std::uint64_t sequence) {
    PoseSample made = SampleAt(sequence, 3.0 * static_cast<double>(sequence));
    made.transition = TransitionOf(1.0 + static_cast<double>(sequence) / 8.0);
    return made;
  };
  DroppedStretchMaker at_once(options);
  at_once.Begin(sample(1).pose);
  for (std::uint64_t i = 2; i <= 9; ++i) at_once.Add(sample(i));
  at_once.End(sample(10).pose);

  DroppedStretchMaker middle(options);
  middle.Begin(sample(3).pose);
  middle.Add(sample(4));
  middle.Add(sample(5));
  middle.End(sample(6).pose);
  DroppedStretchMaker around(options);
  around.Begin(sample(1).pose);
  around.Add(sample(2));
  around.Add(sample(3));
  around.Add(middle.Take());
  for (std::uint64_t i = 6; i <= 9; ++i) around.Add(sample(i));
  around.End(sample(10).pose);

  EXPECT_DOUBLE_EQ(around.Take().travelled_meters,
                   at_once.Take().travelled_meters);
  EXPECT_EQ(around.Take().last_sequence, 9u);
  for (std::size_t k : {0u, 5u, 15u}) {
    EXPECT_DOUBLE_EQ(around.Take().transition->values[k],
                     at_once.Take().transition->values[k]);
  }
}

TEST(DroppedStretchTest, ErrorsBeyondAllNumbersHaveDecorrelated) {
  ResamplerOptions options;
  options.carry_transitions = true;
  DroppedStretchMaker maker(options);
  for (std::uint64_t i = 1; i <= 400; ++i) {
    PoseSample sample = SampleAt(i, 1.0);
    sample.transition = TransitionOf(1e6);
    maker.Add(sample);
  }
  EXPECT_EQ(maker.Take().transition->values, TransitionOf(0.0).values);
}

TEST(DroppedStretchTest, SaysWhichSequenceIsKeptNext) {
  DroppedStretches dropped;
  EXPECT_EQ(dropped.KeptFrom(1), 1u);
  dropped.Add({1, 4, 8.0, std::nullopt}, 0);
  dropped.Add({10, 12, 3.0, std::nullopt}, 5);
  // Next to each other: one gap.
  dropped.Add({13, 15, 2.0, std::nullopt}, 5);
  ASSERT_EQ(dropped.gaps().size(), 2u);
  EXPECT_EQ(dropped.count(), 10u);
  EXPECT_EQ(dropped.KeptFrom(1), 5u);
  EXPECT_EQ(dropped.KeptFrom(9), 9u);
  EXPECT_EQ(dropped.KeptFrom(10), 16u);
  EXPECT_EQ(dropped.KeptFrom(15), 16u);
  EXPECT_EQ(dropped.KeptFrom(16), 16u);
  EXPECT_TRUE(dropped.Contains(4));
  EXPECT_FALSE(dropped.Contains(5));
  EXPECT_EQ(dropped.MetersBefore(4), 8.0);
  EXPECT_EQ(dropped.MetersBefore(5), 13.0);
}

TEST(DroppedStretchTest, LoadsOnlyWhatAGraphCanHaveHad) {
  DroppedStretches dropped;
  dropped.Add({3, 4, 8.0, std::nullopt}, 2);
  dropped.Add({10, 12, 3.0, std::nullopt}, 5);
  ByteWriter writer;
  dropped.Save(&writer);
  const std::string bytes = writer.Take();
  const auto loads = [&bytes](NodeIndex nodes, std::uint64_t last) {
    ByteReader reader(bytes);
    DroppedStretches loaded;
    return loaded.Load(nodes, last, &reader) && loaded.count() == 5;
  };
  EXPECT_TRUE(loads(5, 12));
  EXPECT_FALSE(loads(4, 12));
  EXPECT_FALSE(loads(5, 11));
}

}  // namespace
}  // namespace revisit::core
