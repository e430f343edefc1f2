// The same service with nothing behind it: the limit that gRPC sets.
#ifndef REVISIT_TESTS_BENCH_EMPTY_SERVER_H_
#define REVISIT_TESTS_BENCH_EMPTY_SERVER_H_

namespace revisit::bench {

// Serves until SIGTERM: streams of poses are read and each batch is answered by
// an acknowledgement at once, unary calls are answered with nothing. Says
// "listening on HOST:PORT" on standard output. Answers the exit code.
int RunEmptyServer();

}  // namespace revisit::bench

#endif  // REVISIT_TESTS_BENCH_EMPTY_SERVER_H_
