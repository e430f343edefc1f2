// Searches in the histories of many other vehicles, on one thread.
#ifndef REVISIT_TESTS_BENCH_GROUP_BENCH_H_
#define REVISIT_TESTS_BENCH_GROUP_BENCH_H_

namespace revisit::bench {

// Adds the rows BM_Search/group to those that are measured.
void RegisterGroupSearches();

}  // namespace revisit::bench

#endif  // REVISIT_TESTS_BENCH_GROUP_BENCH_H_
