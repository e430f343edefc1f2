// What SQLite alone does with the rows that the server stores.
#ifndef REVISIT_TESTS_BENCH_SQLITE_LOOP_H_
#define REVISIT_TESTS_BENCH_SQLITE_LOOP_H_

#include <string>

namespace revisit::bench {

// Opens a store that the server has made and inserts batches of the benchmark's
// poses into its table, one thread, one prepared statement, in WAL mode with
// synchronous=FULL, `rows_a_commit` to a transaction. Answers poses a second.
double SqliteLoop(const std::string& store, int batch_poses, int rows_a_commit,
                  double seconds);

}  // namespace revisit::bench

#endif  // REVISIT_TESTS_BENCH_SQLITE_LOOP_H_
