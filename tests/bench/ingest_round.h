// Durable poses a second, and what they take.
#ifndef REVISIT_TESTS_BENCH_INGEST_ROUND_H_
#define REVISIT_TESTS_BENCH_INGEST_ROUND_H_

#include "nlohmann/json.hpp"
#include "tests/bench/server_options.h"

namespace revisit::bench {

// Measures vehicles that send as fast as their windows allow, beside an empty
// stream and SQLite alone, by numbers of vehicles and of poses a message.
nlohmann::json IngestRound(const Options& options);

// Measures acknowledgements of many vehicles that send at their pace.
nlohmann::json PaceRound(const Options& options);

}  // namespace revisit::bench

#endif  // REVISIT_TESTS_BENCH_INGEST_ROUND_H_
