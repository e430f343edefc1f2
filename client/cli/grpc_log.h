// The log that gRPC writes on standard error by itself.
#ifndef REVISIT_CLIENT_CLI_GRPC_LOG_H_
#define REVISIT_CLIENT_CLI_GRPC_LOG_H_

namespace revisit::client {

// Keeps gRPC's log from standard error, unless the environment has its variable
// GRPC_VERBOSITY: what it says of a failed connection is in the status of the
// call, and its lines come between ours at any moment. Its last words before it
// aborts the process remain. To be called before gRPC is used.
void SilenceGrpcLog();

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_GRPC_LOG_H_
