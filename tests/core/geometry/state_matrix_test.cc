#include "core/geometry/state_matrix.h"

#include <gtest/gtest.h>

#include <random>

#include "core/geometry/heading.h"
#include "tests/random.h"

namespace revisit::core {
namespace {

// Without Eigen, which fuses multiplications and additions where it knows that
// the machine can.
template <int D>
StateMatrix<D> Product(const StateMatrix<D>& a, const StateMatrix<D>& b) {
  StateMatrix<D> product = StateMatrix<D>::Zero();
  for (int r = 0; r < D; ++r) {
    for (int c = 0; c < D; ++c) {
      for (int k = 0; k < D; ++k) product(r, c) += a(r, k) * b(k, c);
    }
  }
  return product;
}

// The slow twin: whole products.
template <int D>
void ExpectProducts(std::mt19937_64& random) {
  StateMatrix<D> m;
  for (int r = 0; r < D; ++r) {
    for (int c = 0; c < D; ++c) m(r, c) = Normal(random, 1.0);
  }
  const double angle = Uniform(random, -kPi, kPi);
  const StateMatrix<D> turn = TurnAbout<D>(angle);
  const StateMatrix<D> turned =
      Product<D>(Product<D>(turn, m), turn.transpose());
  EXPECT_EQ(Turned<D>(m, angle), turned);
  StateMatrix<D> lever = StateMatrix<D>::Identity();
  lever(0, D - 1) = Normal(random, 100.0);
  lever(1, D - 1) = Normal(random, 100.0);
  const StateMatrix<D> swung =
      Product<D>(Product<D>(lever, m), lever.transpose());
  EXPECT_EQ(Swung<D>(m, lever(0, D - 1), lever(1, D - 1)), swung);
}

TEST(StateMatrixTest, TurnsAndSwingsAreProductsToTheLastBit) {
  std::mt19937_64 random = SeededRandom();
  for (int k = 0; k < 1000; ++k) {
    ExpectProducts<3>(random);
    ExpectProducts<4>(random);
  }
}

}  // namespace
}  // namespace revisit::core
