// A server in a process of its own, for as long as it is measured.
#ifndef REVISIT_TESTS_BENCH_CHILD_PROCESS_H_
#define REVISIT_TESTS_BENCH_CHILD_PROCESS_H_

#include <sys/types.h>

#include <memory>
#include <string>
#include <vector>

namespace revisit::bench {

class ChildProcess {
 public:
  // Runs a program that says "listening on HOST:PORT" in a line of its standard
  // output, and waits for that. Its standard error goes to the file `log`. Ends
  // this process with a message if it does not start.
  ChildProcess(const std::vector<std::string>& command, std::string log);
  // As Stop().
  ~ChildProcess();

  ChildProcess(const ChildProcess&) = delete;
  ChildProcess& operator=(const ChildProcess&) = delete;

  // HOST:PORT.
  const std::string& address() const { return address_; }
  // CPU time of all its threads, user and system.
  double cpu_seconds() const;
  // The same, of which only the threads with this name are counted.
  double thread_cpu_seconds(const std::string& name) const;
  // Memory that it holds (resident set).
  double resident_bytes() const;
  // Most memory that it ever held (resident set).
  double peak_bytes() const;
  // Tells it to end (SIGTERM) and waits until it has.
  void Stop();
  // The text of its log so far.
  std::string Log() const;

 private:
  const std::string log_;
  std::string address_;
  pid_t pid_ = -1;
  // Kept open, so that it may write on.
  int output_ = -1;
};

// CPU time of this process, user and system.
double OwnCpuSeconds();

// A directory that goes when this does.
class ScratchDirectory {
 public:
  // Under `parent`, or under TMPDIR if that is empty.
  explicit ScratchDirectory(const std::string& parent);
  ~ScratchDirectory();

  ScratchDirectory(const ScratchDirectory&) = delete;
  ScratchDirectory& operator=(const ScratchDirectory&) = delete;

  const std::string& path() const { return path_; }

 private:
  std::string path_;
};

// Ends the process with a message.
[[noreturn]] void Die(const std::string& message);

}  // namespace revisit::bench

#endif  // REVISIT_TESTS_BENCH_CHILD_PROCESS_H_
