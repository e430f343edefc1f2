// How far figures of an evaluation may be off by the drives that happened to be
// at hand: the moving-block bootstrap, Künsch (1989), The jackknife and the
// bootstrap for general stationary observations, Annals of Statistics 17.
//
// Checks that follow each other share the road and the errors that the vehicle
// made on it, so single checks drawn with replacement would vary too little.
// Drawn are blocks of consecutive checks, around the drive's end to its
// beginning, until there are as many as the drive has. Seeds of one drive share
// its roads: the same blocks are drawn of all of them. An interval holds 95 of
// 100 figures of kDraws such draws. The draws are the same each time.
//
// Where precision or recall is 1, or 0, it is so in all draws. The interval is
// then that of Clopper and Pearson (1934), Biometrika 26, of as many successes,
// or failures, as there are blocks that tell of it: from .025^(1/m) to 1 for m.
#ifndef REVISIT_CLIENT_EVALUATION_BOOTSTRAP_H_
#define REVISIT_CLIENT_EVALUATION_BOOTSTRAP_H_

#include <cstddef>
#include <optional>
#include <vector>

#include "client/evaluation/evaluation.h"

namespace revisit::client {

// Checks of a block: 500 m of road at the usual interval, about as long as the
// path that a search compares; a fifth of the drive at most.
inline constexpr std::size_t kBlockChecks = 10;
inline constexpr int kDraws = 1000;

struct Interval {
  double low = 0.0;
  double high = 0.0;
};

// Absent where the figure is absent, of all checks or of more than one in
// twenty draws.
struct FigureIntervals {
  std::optional<Interval> precision;
  std::optional<Interval> recall;
  std::optional<Interval> f1;
  std::optional<Interval> positive_calibration_error;
};

// The checks of one drive, for each of its seeds.
using ChecksOfSeeds = std::vector<const std::vector<JudgedCheck>*>;

// The intervals of the figures that Count() has of all these checks.
FigureIntervals Bootstrap(const std::vector<ChecksOfSeeds>& drives);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_EVALUATION_BOOTSTRAP_H_
