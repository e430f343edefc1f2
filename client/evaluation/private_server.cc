#include "client/evaluation/private_server.h"

#include <fcntl.h>
#include <poll.h>
#include <sys/wait.h>
#include <unistd.h>

#include <cerrno>
#include <chrono>
#include <csignal>
#include <cstdlib>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <system_error>
#include <thread>
#include <vector>

#include "absl/status/statusor.h"

extern char** environ;

namespace revisit::client {
namespace {

using Clock = std::chrono::steady_clock;

absl::Status SystemError(const std::string& what) {
  return absl::UnknownError(what + ": " + std::strerror(errno));
}

// The path of revisitd, which is expected in the directory of this program.
absl::StatusOr<std::string> FindServer() {
  std::error_code error;
  const auto self = std::filesystem::read_symlink("/proc/self/exe", error);
  if (error) {
    return absl::UnknownError("/proc/self/exe: " + error.message());
  }
  const std::string path = (self.parent_path() / "revisitd").string();
  if (access(path.c_str(), X_OK) != 0) {
    return absl::NotFoundError(
        path +
        ": there is no server to start; name a running one with --server, or "
        "install revisit-server");
  }
  return path;
}

// Waits until the process has ended and returns whether it did in time.
bool WaitForExit(pid_t pid, std::chrono::milliseconds limit) {
  const auto deadline = Clock::now() + limit;
  for (;;) {
    const pid_t ended = waitpid(pid, nullptr, WNOHANG);
    if (ended == pid || (ended < 0 && errno == ECHILD)) return true;
    if (Clock::now() >= deadline) return false;
    std::this_thread::sleep_for(std::chrono::milliseconds(5));
  }
}

std::string LogTail(const std::string& directory) {
  constexpr std::size_t kMost = 2000;
  std::ifstream log(directory + "/log", std::ios::binary);
  const std::string text{std::istreambuf_iterator<char>(log), {}};
  return text.size() <= kMost ? text : text.substr(text.size() - kMost);
}

}  // namespace

PrivateServer::~PrivateServer() { Stop(); }

absl::Status PrivateServer::Start() {
  std::error_code error;
  std::string pattern =
      (std::filesystem::temp_directory_path(error) / "revisit-").string() +
      std::string(6, 'X');
  int output;
  {
    const MutexLock lock(&mutex_);
    if (error || mkdtemp(pattern.data()) == nullptr) {
      return SystemError("a temporary directory, " + pattern);
    }
    directory_ = pattern;
    if (absl::Status status = Launch(pattern); !status.ok()) return status;
    // Stop() may close output_ at any time.
    output = fcntl(output_, F_DUPFD_CLOEXEC, 0);
    if (output < 0) return SystemError("dup");
  }
  absl::Status status = ReadAddress(pattern, output);
  close(output);
  return status;
}

absl::Status PrivateServer::Launch(const std::string& directory) {
  const auto program = FindServer();
  if (!program.ok()) return program.status();
  const std::string log = directory + "/log";
  // Everything that the child needs is allocated before the fork.
  std::vector<std::string> words = {
      *program,  "--listen",           "127.0.0.1:0",
      "--store", directory + "/store", "--end-with-input",
      "on"};
  std::vector<char*> arguments;
  for (std::string& word : words) arguments.push_back(word.data());
  arguments.push_back(nullptr);
  std::vector<char*> environment;
  for (char** entry = environ; *entry != nullptr; ++entry) {
    if (std::strncmp(*entry, "REVISIT_", 8) != 0) environment.push_back(*entry);
  }
  environment.push_back(nullptr);
  int input[2];
  if (pipe2(input, O_CLOEXEC) != 0) return SystemError("pipe");
  input_ = input[1];
  int pipe_ends[2];
  if (pipe2(pipe_ends, O_CLOEXEC) != 0) {
    const absl::Status failed = SystemError("pipe");
    close(input[0]);
    return failed;
  }
  const int log_file =
      open(log.c_str(), O_WRONLY | O_CREAT | O_CLOEXEC | O_TRUNC, 0600);
  const pid_t pid = log_file < 0 ? -1 : fork();
  if (pid == 0) {
    sigset_t none;
    sigemptyset(&none);
    sigprocmask(SIG_SETMASK, &none, nullptr);
    signal(SIGPIPE, SIG_DFL);
    setpgid(0, 0);
    dup2(input[0], STDIN_FILENO);
    dup2(pipe_ends[1], STDOUT_FILENO);
    dup2(log_file, STDERR_FILENO);
    execve(arguments[0], arguments.data(), environment.data());
    _exit(127);
  }
  const absl::Status failed = SystemError("starting " + *program);
  close(input[0]);
  close(pipe_ends[1]);
  if (log_file >= 0) close(log_file);
  if (pid < 0) {
    close(pipe_ends[0]);
    return failed;
  }
  pid_ = pid;
  output_ = pipe_ends[0];
  return absl::OkStatus();
}

absl::Status PrivateServer::ReadAddress(const std::string& directory,
                                        int output) {
  constexpr char kAnnouncement[] = "listening on ";
  constexpr auto kLimit = std::chrono::seconds(30);
  const auto deadline = Clock::now() + kLimit;
  std::string text;
  for (;;) {
    const std::size_t begin = text.find(kAnnouncement);
    const std::size_t end =
        begin == std::string::npos ? begin : text.find('\n', begin);
    if (end != std::string::npos) {
      const std::size_t address = begin + std::strlen(kAnnouncement);
      address_ = text.substr(address, end - address);
      return absl::OkStatus();
    }
    const auto left = std::chrono::duration_cast<std::chrono::milliseconds>(
        deadline - Clock::now());
    pollfd poll_output = {output, POLLIN, 0};
    if (left.count() <= 0 ||
        poll(&poll_output, 1, static_cast<int>(left.count())) == 0) {
      return absl::DeadlineExceededError(
          "the private server takes no calls after 30 s; its log ends:\n" +
          LogTail(directory));
    }
    char buffer[256];
    const ssize_t size = read(output, buffer, sizeof(buffer));
    if (size > 0) {
      text.append(buffer, static_cast<std::size_t>(size));
    } else if (size == 0 || errno != EINTR) {
      return absl::UnknownError(
          "the private server did not start; its log "
          "ends:\n" +
          LogTail(directory));
    }
  }
}

void PrivateServer::Stop() {
  constexpr auto kPatience = std::chrono::milliseconds(5'000);
  const MutexLock lock(&mutex_);
  if (pid_ > 0) {
    kill(pid_, SIGTERM);
    if (!WaitForExit(pid_, kPatience)) {
      kill(pid_, SIGKILL);
      WaitForExit(pid_, kPatience);
    }
    pid_ = -1;
  }
  for (int* end : {&input_, &output_}) {
    if (*end >= 0) close(*end);
    *end = -1;
  }
  if (directory_.empty()) return;
  std::error_code error;
  std::filesystem::remove_all(directory_, error);
  directory_.clear();
}

}  // namespace revisit::client
