// The memory that a node takes, found by counting every allocation of the
// process.
#include <gtest/gtest.h>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <memory>
#include <new>
#include <random>
#include <vector>

#include "core/drive/drive.h"
#include "core/drive/pose_graph.h"
#include "core/geometry/pose.h"
#include "core/geometry/state_matrix.h"
#include "core/settings.h"
#include "tests/core/graphs.h"
#include "tests/random.h"

namespace {

std::int64_t allocated_bytes = 0;

// The bytes that malloc holds for a request: 8 in front of it, and a multiple
// of 16 in all. malloc_usable_size() would depend on what was freed before,
// since a remainder too small for a chunk of its own is given away with it.
std::int64_t HeldBytes(std::size_t size) {
  return static_cast<std::int64_t>(
      std::max<std::size_t>((size + 8 + 15) / 16 * 16, 32));
}

// Every request remembers its size in front of the memory that it gets.
void* Allocate(std::size_t size, std::size_t alignment) {
  const std::size_t front = std::max(alignment, alignof(std::max_align_t));
  void* const memory =
      std::aligned_alloc(front, (front + size + front - 1) / front * front);
  if (memory == nullptr) std::abort();
  allocated_bytes += HeldBytes(size);
  char* const given = static_cast<char*>(memory) + front;
  std::memcpy(given - sizeof(size), &size, sizeof(size));
  return given;
}

void Free(void* given, std::size_t alignment) {
  if (given == nullptr) return;
  const std::size_t front = std::max(alignment, alignof(std::max_align_t));
  std::size_t size = 0;
  std::memcpy(&size, static_cast<char*>(given) - sizeof(size), sizeof(size));
  allocated_bytes -= HeldBytes(size);
  std::free(static_cast<char*>(given) - front);
}

}  // namespace

void* operator new(std::size_t size) { return Allocate(size, 1); }
void* operator new(std::size_t size, std::align_val_t alignment) {
  return Allocate(size, static_cast<std::size_t>(alignment));
}
void operator delete(void* memory) noexcept { Free(memory, 1); }
void operator delete(void* memory, std::size_t) noexcept { Free(memory, 1); }
void operator delete(void* memory, std::align_val_t alignment) noexcept {
  Free(memory, static_cast<std::size_t>(alignment));
}
void operator delete(void* memory, std::size_t,
                     std::align_val_t alignment) noexcept {
  Free(memory, static_cast<std::size_t>(alignment));
}

namespace revisit::core {
namespace {

// The memory per node that is promised to operators.
constexpr double kMostBytesPerNode = 250.0;

struct Vehicle {
  StateSpace space;
  CorrelationModel correlation;
  // Error transitions without a structure; else those of a filter that carries
  // errors by the heading's lever arm.
  bool dense_transitions = false;
};

PoseSample RandomSample(std::mt19937_64& random, const Vehicle& vehicle,
                        std::uint64_t sequence) {
  PoseSample sample;
  sample.sequence = sequence;
  // About ten poses per second, with the jitter of a real clock.
  sample.stamp_ns = 1600000000000000000 +
                    static_cast<std::int64_t>(sequence) * 100000000 +
                    UniformInt(random, -2000000, 2000000);
  sample.pose = RandomPose(random, 1.0);
  // About one node per pose, at no round position.
  sample.pose.x += 2.7 * static_cast<double>(sequence);
  sample.covariance = RandomCovariance(random, 2.0);
  if (vehicle.correlation == CorrelationModel::kFilter && sequence > 1) {
    Eigen::Matrix4d transition = Eigen::Matrix4d::Identity();
    if (vehicle.dense_transitions) {
      for (int k = 0; k < 16; ++k) transition(k) += Normal(random, 0.05);
    } else {
      transition(0, 3) = Normal(random, 2.0);
      transition(1, 3) = Normal(random, 2.0);
    }
    sample.transition = vehicle.space == StateSpace::kPlanar
                            ? ToErrorTransition<3>(
                                  ToMatrix<3>(ToErrorTransition<4>(transition)))
                            : ToErrorTransition<4>(transition);
  }
  return sample;
}

struct Cost {
  NodeIndex nodes = 0;
  double bytes = 0.0;
  // The same as the graph states it.
  double stated_bytes = 0.0;
};

Cost CostOf(std::mt19937_64& random, const Vehicle& vehicle, NodeIndex nodes) {
  DriveSettings settings;
  settings.state_space = vehicle.space;
  settings.search.correlation_model = vehicle.correlation;
  const std::int64_t before = allocated_bytes;
  const auto drive = std::make_unique<Drive>(settings);
  std::uint64_t sequence = 0;
  while (drive->graph().size() < nodes) {
    ++sequence;
    drive->Append({RandomSample(random, vehicle, sequence)}, sequence);
  }
  Cost cost;
  cost.nodes = drive->graph().size();
  cost.bytes = static_cast<double>(allocated_bytes - before);
  cost.stated_bytes = static_cast<double>(drive->bytes());
  return cost;
}

class NodeMemoryTest : public ::testing::Test {
 protected:
  // The state space, the correlation model, and whether transitions are dense.
  const std::vector<Vehicle> kVehicles = {
      {StateSpace::kPlanar, CorrelationModel::kIndependent},
      {StateSpace::kPlanar, CorrelationModel::kDeadReckoning},
      {StateSpace::kPlanar, CorrelationModel::kFilter, false},
      {StateSpace::kPlanar, CorrelationModel::kFilter, true},
      {StateSpace::kSpatial, CorrelationModel::kIndependent},
      {StateSpace::kSpatial, CorrelationModel::kDeadReckoning},
      {StateSpace::kSpatial, CorrelationModel::kFilter, false},
      {StateSpace::kSpatial, CorrelationModel::kFilter, true},
  };
};

TEST_F(NodeMemoryTest, ANodeOfAnyKindOfVehicleTakesAtMostWhatIsPromised) {
  std::mt19937_64 random = SeededRandom();
  for (const Vehicle& vehicle : kVehicles) {
    for (const NodeIndex nodes : {1000, 20000}) {
      const Cost cost = CostOf(random, vehicle, nodes);
      const double each = cost.bytes / static_cast<double>(cost.nodes);
      SCOPED_TRACE(
          ::testing::Message()
          << (vehicle.space == StateSpace::kPlanar ? "planar" : "spatial")
          << ", model " << static_cast<int>(vehicle.correlation)
          << (vehicle.dense_transitions ? ", dense" : ""));
      EXPECT_LE(each, kMostBytesPerNode);
      // The stated memory is the real one, up to the allocator's overhead.
      EXPECT_LE(cost.stated_bytes, cost.bytes);
      EXPECT_GE(cost.stated_bytes, 0.9 * cost.bytes);
      std::printf("%s model %d%s: %.1f bytes a node of %lld\n",
                  vehicle.space == StateSpace::kPlanar ? "planar " : "spatial",
                  static_cast<int>(vehicle.correlation),
                  vehicle.dense_transitions ? " dense" : "      ", each,
                  static_cast<long long>(cost.nodes));
    }
  }
}

TEST_F(NodeMemoryTest, ACopyOfAGraphTakesAPointerPerBlockAndTheLastBlock) {
  std::mt19937_64 random = SeededRandom();
  for (const Vehicle& vehicle : kVehicles) {
    DriveSettings settings;
    settings.state_space = vehicle.space;
    settings.search.correlation_model = vehicle.correlation;
    Drive drive(settings);
    for (std::uint64_t sequence = 1; drive.graph().size() < 20'000;
         ++sequence) {
      drive.Append({RandomSample(random, vehicle, sequence)}, sequence);
    }
    const std::int64_t before = allocated_bytes;
    const PoseGraph copy = drive.graph();
    const double blocks = static_cast<double>(BlocksOf(copy.size()));
    const double last = static_cast<double>(drive.bytes()) / blocks;
    EXPECT_LE(static_cast<double>(allocated_bytes - before),
              17.0 * blocks + 2.0 * last);
  }
}

TEST_F(NodeMemoryTest, AVehicleOfOneNodeTakesAtMostFourKilobytes) {
  std::mt19937_64 random = SeededRandom();
  for (const Vehicle& vehicle : kVehicles) {
    EXPECT_LE(CostOf(random, vehicle, 1).bytes, 4096.0);
  }
}

}  // namespace
}  // namespace revisit::core
