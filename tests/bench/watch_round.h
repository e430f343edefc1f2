// Measures acknowledgements and memory while stored candidates are watched.
#ifndef REVISIT_TESTS_BENCH_WATCH_ROUND_H_
#define REVISIT_TESTS_BENCH_WATCH_ROUND_H_

#include "nlohmann/json.hpp"
#include "tests/bench/server_options.h"

namespace revisit::bench {

// Measures the same load of vehicles with stored checks on three servers, one
// after the other: "alone" has no watch, in "unwanted" each watch looks at all
// vehicles and lets nothing pass, and in "own" each is told of one vehicle. The
// order depends on the round.
nlohmann::json WatchRound(const Options& options, int round);

}  // namespace revisit::bench

#endif  // REVISIT_TESTS_BENCH_WATCH_ROUND_H_
