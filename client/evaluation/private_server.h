// A revisitd that only this process uses.
#ifndef REVISIT_CLIENT_EVALUATION_PRIVATE_SERVER_H_
#define REVISIT_CLIENT_EVALUATION_PRIVATE_SERVER_H_

#include <sys/types.h>

#include <string>

#include "absl/status/status.h"
#include "core/base/mutex.h"

namespace revisit::client {

// Runs the revisitd that lies beside this program, on a free port of 127.0.0.1,
// with its store in a new directory under TMPDIR (or /tmp). REVISIT_ variables
// of the environment are kept from it. It is in a process group of its own, so
// that Ctrl-C does not reach it before us, and ends by itself if we die.
class PrivateServer {
 public:
  PrivateServer() = default;
  // Calls Stop().
  ~PrivateServer();

  PrivateServer(const PrivateServer&) = delete;
  PrivateServer& operator=(const PrivateServer&) = delete;

  // Starts the server and waits until it takes calls. REQUIRES: called once.
  absl::Status Start();

  // HOST:PORT.
  const std::string& address() const { return address_; }

  // Stops the server, by force if it takes long, and removes its directory. May
  // be called again, and from any thread.
  void Stop();

 private:
  absl::Status Launch(const std::string& directory)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  // Waits for the line that says where the server listens, which comes from
  // `output`.
  absl::Status ReadAddress(const std::string& directory, int output);

  // Written by Start() only.
  std::string address_;
  Mutex mutex_;
  // Empty before Start() and after Stop().
  std::string directory_ ABSL_GUARDED_BY(mutex_);
  pid_t pid_ ABSL_GUARDED_BY(mutex_) = -1;
  // The end of a pipe that is the server's standard input, with which it ends.
  int input_ ABSL_GUARDED_BY(mutex_) = -1;
  // The server's standard output: kept open, so that it may write to it.
  int output_ ABSL_GUARDED_BY(mutex_) = -1;
};

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_EVALUATION_PRIVATE_SERVER_H_
