// Seeds of random tests: fixed unless REVISIT_TEST_SEED is set, and printed, so
// that a failure can be run again.
#ifndef REVISIT_TESTS_RANDOM_H_
#define REVISIT_TESTS_RANDOM_H_

#include <cstdint>
#include <cstdlib>
#include <iostream>
#include <random>

namespace revisit {

inline std::mt19937_64 SeededRandom() {
  const char* given = std::getenv("REVISIT_TEST_SEED");
  const std::uint64_t seed =
      given != nullptr ? std::strtoull(given, nullptr, 10) : 20101015;
  std::cout << "REVISIT_TEST_SEED=" << seed << "\n";
  return std::mt19937_64(seed);
}

inline double Uniform(std::mt19937_64& random, double low, double high) {
  return std::uniform_real_distribution<double>(low, high)(random);
}

inline int UniformInt(std::mt19937_64& random, int low, int high) {
  return std::uniform_int_distribution<int>(low, high)(random);
}

inline double Normal(std::mt19937_64& random, double sigma) {
  return std::normal_distribution<double>(0.0, 1.0)(random) * sigma;
}

}  // namespace revisit

#endif  // REVISIT_TESTS_RANDOM_H_
