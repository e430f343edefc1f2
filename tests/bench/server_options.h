// What revisit_server_bench is asked to measure.
#ifndef REVISIT_TESTS_BENCH_SERVER_OPTIONS_H_
#define REVISIT_TESTS_BENCH_SERVER_OPTIONS_H_

#include <cstdint>
#include <string>

namespace revisit::bench {

struct Options {
  // Each measurement lasts this long, and all are taken in turn this many
  // times.
  double seconds = 3.0;
  int rounds = 3;
  // Nodes of the vehicle that is asked, and of the one that is asked slowly.
  std::int64_t nodes = 10'000;
  std::int64_t many_nodes = 100'000;
  // Where stores are made.
  std::string directory;
  // If not empty, the URL of a database with tables, to measure streams into
  // beside those into a file.
  std::string shared_store;
  // If not empty, what alone is measured; of streams, only with this many poses
  // a batch, and only of this many vehicles, if not 0.
  std::string only;
  int batch_poses = 0;
  int vehicles = 0;
  // How streams send poses: "messages" or "columns".
  std::string form = "messages";
  // How the vehicle that is asked knows its poses: "reckoned" or "fixes".
  std::string errors = "reckoned";
  // So many vehicles, each with a stream, send poses at this rate together.
  // Where their checks are stored, so many watches look at them, or none.
  int streams = 1000;
  int watchers = 1000;
  double poses_per_second = 40'000.0;
};

}  // namespace revisit::bench

#endif  // REVISIT_TESTS_BENCH_SERVER_OPTIONS_H_
